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

from cannoise_jax.networks.branches import Physics
from cannoise_jax.physics.core.tukey_lambda import excess_kurtosis


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


class Truth(NamedTuple):
    """What a drawn camera really has: see `networks.branches.Physics`. shot, read: of its whole variance."""

    shot: Float[Array, "b 4"]
    read: Float[Array, "b 4"]
    tail: Float[Array, "b"]
    row: Float[Array, "b"]
    slow_row: Float[Array, "b"]
    column: Float[Array, "b"]
    blend: Float[Array, "b"]


LEAST_TAIL = -0.215
"""Heavier Tukey-lambda tails count as this: a fourth moment that hardly exists is no target."""


def deviance(true: Float[Array, "*b"], found: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """a / b - 1 - log(a / b) for positive numbers: least, in expectation, where b is the mean of a.

    Of variances it is twice the KL divergence of normal noise.
    """
    ratio = true / found
    return ratio - 1 - jnp.log(ratio)


LEVEL_REACH = 0.2
"""Log ratio of variances beyond which an error of the level counts in proportion, no longer squared."""


def level_loss(true: Float[Array, "*b"], found: Float[Array, "*b"]) -> Float[Array, "*b"]:
    """KL of normal noise of these variances, nats, where they are close; less than it where they are not.

    A level that is read off pixels is a ratio with a noisy denominator: where shadows are clipped or noise is
    below a code the estimate may be ten times too low. The mean of such ratios, which the KL itself asks for,
    makes every other camera too loud; their median does not.
    """
    off = jnp.log(true / found) / LEVEL_REACH
    return 0.5 * LEVEL_REACH**2 * (jnp.sqrt(1 + jnp.square(off)) - 1)


def physics_loss(
    variance: Float[Array, "b h w 4"], clean: Float[Array, "b h w 4"], physics: Physics, truth: Truth
) -> dict[str, Float[Array, ""]]:
    """How far parameters that were read off pixels are from those of the camera, where these are known.

    variance: that of the branches at every pixel. `level`: see `level_loss`; the rest: deviances of the
    fourth moment, of the shares of lines, of the weight of neighbours. What of these the pixels do not tell
    costs least at its mean over the cameras that would look alike.
    """
    whole = truth.shot[:, None, None] * jnp.maximum(clean, 0) + truth.read[:, None, None]

    def fourth(tail):
        return excess_kurtosis(jnp.maximum(tail, LEAST_TAIL)) + 1.5

    lines = [
        deviance(getattr(truth, n) + 0.002, getattr(physics, n) + 0.002)
        for n in ("row", "slow_row", "column")
    ]
    return {
        "level": jnp.mean(level_loss(whole, variance)),
        "tails": jnp.mean(deviance(fourth(truth.tail), fourth(physics.tail))),
        "lines": jnp.mean(sum(lines)),
        "neighbours": jnp.mean(deviance(truth.blend + 0.02, physics.blend + 0.02)),
    }


def paired_loss(first: Float[Array, "*s"], second: Float[Array, "*s"], real: Float[Array, "*s"]):
    """Mean of (first - real) (second - real) for statistics of two independent draws of one model.

    Its expectation is the squared distance of the model's mean statistic from the real one, plus a constant.
    The square of one draw's distance holds the draw's own variance too, so that it would favour noise whose
    statistics vary little: light tails, no slow rows.
    """
    return jnp.mean((first - real) * (second - real))


def quantiles(noise: Float[Array, "b h w c"]) -> Float[Array, "b n"]:
    """The sorted values of each image: where a histogram loses its tails, the first and the last."""
    return jnp.sort(noise.reshape(noise.shape[0], -1), -1)


def log_spectra(noise: Float[Array, "b h w 4"], bands: int = 4) -> Float[Array, "b s"]:
    """Log power of row means, of column means, and in two dimensions, in bands of frequency an octave wide.

    noise: packed, in units of its sigma. Rows and columns are those of the mosaic.
    """
    batch, height, width, _ = noise.shape
    rows = jnp.mean(noise.reshape(batch, height, width, 2, 2), (2, 4)).reshape(batch, -1) * (2 * width) ** 0.5
    pairs = noise.reshape(batch, height, width, 2, 2)
    columns = jnp.mean(pairs, (1, 3)).reshape(batch, -1) * (2 * height) ** 0.5
    parts = [
        _log_bands(jnp.square(jnp.abs(jnp.fft.rfft(x)))[:, 1:] / x.shape[1], bands) for x in (rows, columns)
    ]
    plane = jnp.mean(jnp.square(jnp.abs(jnp.fft.rfft2(noise, axes=(1, 2)))), -1) / (height * width)
    y, x = jnp.meshgrid(jnp.abs(jnp.fft.fftfreq(height)), jnp.fft.rfftfreq(width), indexing="ij")
    edges = jnp.array([0.125, 0.25])
    cell = 3 * jnp.searchsorted(edges, y) + jnp.searchsorted(edges, x)
    chosen = jax.nn.one_hot(cell, 9) * ((y + x) > 0)[..., None]
    power = jnp.einsum("byx,yxk->bk", plane, chosen) / jnp.sum(chosen, (0, 1))
    return jnp.concatenate([*parts, jnp.log(power + 1e-3)], -1)


def _log_bands(power, bands):
    """Log of mean power in octaves, the last one up to the highest frequency."""
    ends = [power.shape[1] >> k for k in range(bands - 1, -1, -1)]
    starts = [0, *ends[:-1]]
    means = [jnp.mean(power[:, a:b], 1) for a, b in zip(starts, ends, strict=True)]
    return jnp.log(jnp.stack(means, -1) + 1e-3)


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
