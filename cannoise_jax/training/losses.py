"""The losses of Chang et al. 2020, Sec. 3.3: Wasserstein with gradient penalty, feature matching, triplet.

Each is a function of arrays (or of a critic as a function of its noise input), so that it can be checked
against plain NumPy; `step` puts them together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


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


def statistics_loss(
    fake: Float[Array, "b h w c"], real: Float[Array, "b h w c"], clean: Float[Array, "b h w c"]
) -> Float[Array, ""]:
    """Mean squared difference of the noise statistics of paired images, see `Statistics`.

    Feature matching with features that are known to matter: not in the paper. A critic finds a level that is
    a few per cent off only slowly, because one image shows it no better than that.
    """
    difference = Statistics(
        *(a - b for a, b in zip(noise_moments(fake, clean), noise_moments(real, clean), strict=True))
    )
    square = Statistics(*(jnp.mean(jnp.square(d)) for d in difference))
    # An image has far fewer rows than pixels: its row term is that much noisier, and weighs a tenth.
    return square.levels + square.means + square.neighbours + 0.1 * square.rows


class Statistics(NamedTuple):
    """What the statistics loss compares, per image; in units in which the noise does not move their scatter.

    levels: logs of mean size and mean square of the noise, below and above the image's mean signal, by
    channel. means: of the noise, likewise: black-level errors. neighbours: Fisher's z of the correlation of
    vertical and of horizontal neighbours of one channel. rows: log mean square of the means of sensor rows.
    """

    levels: Float[Array, "b 2 2 c"]
    means: Float[Array, "b 2 c"]
    neighbours: Float[Array, "b 2"]
    rows: Float[Array, "b"]


def noise_moments(noise: Float[Array, "b h w c"], clean: Float[Array, "b h w c"]) -> Statistics:
    """The statistics of packed noise (channels in pairs that share a sensor row) in units of the initial
    noise's sigma."""
    bright = jnp.asarray(clean > jnp.mean(clean, (1, 2), keepdims=True), noise.dtype)
    shares = jnp.stack([1 - bright, bright], 1)  # b 2 h w c
    size = jnp.sqrt(jnp.square(noise) + 1e-6)  # smooth at zero
    moments = jnp.stack([size, jnp.square(size), noise], 1)
    count = jnp.sum(shares, (2, 3))[:, :, None]
    sums = jnp.einsum("bshwc,bmhwc->bsmc", shares, moments)
    levels = jnp.log((sums[:, :, :2] + 1e-3) / (count + 1e-3))
    neighbours = jnp.stack([_fisher_z(noise, 1), _fisher_z(noise, 2)], -1)
    rows = jnp.mean(noise.reshape(*noise.shape[:3], -1, 2), (2, 4))
    return Statistics(
        levels, sums[:, :, 2] / (count[:, :, 0] + 1e-3), neighbours,
        jnp.log(jnp.mean(jnp.square(rows), (1, 2)) + 1e-6),
    )  # fmt: skip


def _fisher_z(noise, axis):
    """atanh of the correlation of neighbours along an axis: squares of their sums against differences."""
    first, second = (jax.lax.slice_in_dim(noise, k, noise.shape[axis] - 1 + k, axis=axis) for k in (0, 1))
    sums, differences = (jnp.mean(jnp.square(x), (1, 2, 3)) + 1e-6 for x in (first + second, first - second))
    return 0.5 * jnp.log(sums / differences)


def triplet_loss(
    anchor: Float[Array, "b l"],
    positive: Float[Array, "b l"],
    negative: Float[Array, "b l"],
    margin: float = 0.2,
) -> Float[Array, ""]:
    """Mean of max(|a - p| - |a - n| + margin, 0) on un-squared distances; safe at distance zero."""
    near, far = safe_norm(anchor - positive), safe_norm(anchor - negative)
    return jnp.mean(jnp.maximum(near - far + margin, 0))


def batch_triplet_loss(
    latents: Float[Array, "n l"], camera: Int[Array, "n"], margin: float = 0.2
) -> Float[Array, ""]:
    """`triplet_loss` averaged over all triplets that the images of a batch form (Hermans et al. 2017, "batch
    all"): a pair of one camera and any image of another. Zero where there are none."""
    distance = safe_norm(latents[:, None] - latents[None])
    same = camera[:, None] == camera[None]
    pairs = same & ~jnp.eye(len(camera), dtype=bool)
    triplets = pairs[:, :, None] & ~same[:, None, :]
    terms = jnp.maximum(distance[:, :, None] - distance[:, None, :] + margin, 0)
    return jnp.sum(jnp.where(triplets, terms, 0)) / jnp.maximum(jnp.sum(triplets), 1)


def safe_norm(x: Float[Array, "*b n"]) -> Float[Array, "*b"]:
    """Euclidean norm over the last axis whose derivatives at zero are zero instead of NaN."""
    square = jnp.sum(jnp.square(x), -1)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
