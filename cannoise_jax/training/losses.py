"""The losses of Chang et al. 2020, Sec. 3.3: Wasserstein with gradient penalty, feature matching, triplet.

Each is a function of arrays (or of a critic as a function of its noise input), so that it can be checked
against plain NumPy; `step` puts them together.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def critic_loss(real: Float[Array, "b y x 1"], fake: Float[Array, "b y x 1"]) -> Float[Array, ""]:
    """The Wasserstein part of the critic's loss, E[D(fake)] - E[D(real)]: negative when D can tell."""
    return jnp.mean(fake) - jnp.mean(real)


def generator_loss(fake: Float[Array, "b y x 1"]) -> Float[Array, ""]:
    """The adversarial loss of the generator, -E[D(fake)]."""
    return -jnp.mean(fake)


def interpolate(
    real: Float[Array, "b h w c"], fake: Float[Array, "b h w c"], weight: Float[Array, "b"]
) -> Float[Array, "b h w c"]:
    """Points between paired samples, one weight a sample: weight 0 is real, 1 is fake."""
    return real + weight[:, None, None, None] * (fake - real)


def slopes(
    scores: Callable[[Float[Array, "b h w c"]], Float[Array, "b y x 1"]], noise: Float[Array, "b h w c"]
) -> Float[Array, "b"]:
    """Euclidean norm, per sample and over all its axes, of the gradient of the summed score.

    Samples are independent, so one gradient of the total gives every sample's own. Its derivative is finite
    where a gradient vanishes.
    """
    gradient = jax.grad(lambda n: jnp.sum(scores(n)))(noise)
    return safe_norm(gradient.reshape(gradient.shape[0], -1))


def gradient_penalty(
    scores: Callable[[Float[Array, "b h w c"]], Float[Array, "b y x 1"]],
    noise: Float[Array, "b h w c"],
    target: float = 1.0,
) -> Float[Array, ""]:
    """Mean squared distance of the critic's slope from `target`, not yet weighted.

    One: Gulrajani et al. 2017, eq. 3, and the paper. Zero: a critic that flattens as the distributions meet,
    so that generator and critic come to rest (Mescheder et al. 2018).
    """
    return jnp.mean(jnp.square(slopes(scores, noise) - target))


def feature_matching_loss(fake: Float[Array, "b y x c"], target: Float[Array, "b y x c"]) -> Float[Array, ""]:
    """Mean absolute difference of the critic's features. The target's features are constants."""
    return jnp.mean(jnp.abs(fake - jax.lax.stop_gradient(target)))


def triplet_loss(
    anchor: Float[Array, "b l"],
    positive: Float[Array, "b l"],
    negative: Float[Array, "b l"],
    margin: float = 0.2,
) -> Float[Array, ""]:
    """Mean of max(|a - p| - |a - n| + margin, 0) on un-squared distances; safe at distance zero."""
    near, far = safe_norm(anchor - positive), safe_norm(anchor - negative)
    return jnp.mean(jnp.maximum(near - far + margin, 0))


def safe_norm(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean norm over the last axis whose derivatives at zero are zero instead of NaN."""
    square = jnp.sum(jnp.square(x), -1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
