"""What stays in means of few frames, told from the noise that they hold by how much the frames scatter.

The power of a mean of T frames less a T-th of that of their contrasts is the mean product of two different
frames: whatever spectrum the noise has that is redrawn, it has no part in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft, stats

from cannoise_jax.discovery.compare.pixel_noise import stand_out
from cannoise_jax.discovery.compare.shapes import LIKELY, SURE, smooth
from cannoise_jax.discovery.compare.view import bulk_variance
from cannoise_jax.physics.robust import median, robust_std

_FAR = 5.0
"""Standard errors from which a pixel stands out of a pattern: of a million one does by chance."""
_CERTAIN = 1e6
"""Contrasts of noise that is stated, not measured."""


class Mean(NamedTuple):
    """A mean of frames, DN.

    power: of the noise in it by spatial frequency, DN^2, its mean the variance of a pixel, those aside that
    stand out; measured in `contrasts` contrasts and not smoothed.
    own: variance by noise of every pixel, DN^2.
    """

    values: Float[np.ndarray, "h w"]
    power: Float[np.ndarray, "h w"]
    own: Float[np.ndarray, "h w"]
    contrasts: float

    @property
    def noise(self) -> float:
        """Variance by noise, DN^2."""
        return float(self.power.mean(dtype=float))

    def smoothed(self) -> Float[np.ndarray, "h w"]:
        """Power of the noise as white as it may be."""
        level = max(self.noise, 1e-30)
        return np.maximum(level + smooth(self.power - level, self.contrasts, level, LIKELY), 0.01 * level)


def combined(means: Sequence[Mean], weights: Float[np.ndarray, "k"]) -> Mean:
    """Sum of means, each times its weight."""
    values, power, own = (
        np.tensordot(w, np.stack([m[k] for m in means]), 1)
        for k, w in enumerate((weights, weights**2, weights**2))
    )
    parts = weights**2 * np.array([m.noise for m in means])
    known = float(np.sum(parts**2 / np.array([m.contrasts for m in means])))
    return Mean(values, power, own, float(np.clip(parts.sum() ** 2 / max(known, 1e-300), 1.0, _CERTAIN)))


def mean_of(
    values: Float[np.ndarray, "h w"],
    contrasts: Float[np.ndarray, "n h w"],
    usable: Bool[np.ndarray, "h w"],
    frames: int,
    typical: float,
) -> Mean:
    """The mean of so many frames beside their contrasts, DN; typical: variance of the noise of a frame where
    there are none."""
    n = len(contrasts)
    if not n:
        noise = np.full(values.shape, typical / frames, np.float32)
        return Mean(values, noise, noise, _CERTAIN)
    own = _own(contrasts, usable) / frames
    kept = usable & ~_apart(values, own)
    power = np.zeros(values.shape)
    for c in contrasts:
        power += np.abs(fft.fft2(c * kept)) ** 2
    power /= n * values.size * max(float(kept.mean()), 1e-6) * frames
    power = np.maximum(power, 1e-6 * typical / frames)  # pixels of far less than a code stand still
    return Mean(values, power.astype(np.float32), own.astype(np.float32), n)


def of_other_frames(one: Mean, values: Float[np.ndarray, "h w"], times: float) -> Mean:
    """Another mean with the noise of one, times a factor: of a single frame it is what the simulator says."""
    return Mean(values, one.power * times, one.own * times, one.contrasts)


def _own(contrasts: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """Variance of every pixel as few contrasts tell it: that of the bulk, of its column or of its row, and
    its own where it stands out."""
    n = len(contrasts)
    square = np.mean(contrasts**2, 0, dtype=float)
    bulk = max(bulk_variance(square[usable] if usable.any() else square.ravel(), n), 1e-30)
    ratio, middle = square / bulk, float(stats.chi2.median(n)) / n
    lines = [median(ratio, axis, keepdims=True) / middle for axis in (0, 1)]
    common = np.maximum(np.maximum(*lines), 1.0)
    return bulk * np.where(stand_out(ratio, n), np.maximum(ratio, common), common)


def _far(values: Float[np.ndarray, "h w"], own: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that stand out of a pattern, and not by their noise alone."""
    return np.abs(values - median(values)) > _FAR * np.maximum(robust_std(values), np.sqrt(own))


def _apart(values: Float[np.ndarray, "h w"], own: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose offset or noise would count as power of all."""
    return _far(values, own) | (own > _FAR**2 * median(own))


class Pattern(NamedTuple):
    """What stays in the recorded mean and in the simulator's."""

    recorded: Mean
    simulated: Mean

    @property
    def noise(self) -> float:
        """Variance of their difference by noise, DN^2."""
        return self.recorded.noise + self.simulated.noise


def weighted(patterns: Sequence[Pattern], weights: Float[np.ndarray, "k"]) -> Pattern:
    """Sum of patterns, each times its weight."""
    return Pattern(
        combined([p.recorded for p in patterns], weights), combined([p.simulated for p in patterns], weights)
    )


def missing(pattern: Pattern, seed: int) -> Float[np.ndarray, "h w"]:
    """The map that is to be added to the simulator's pattern for the recorded one, drawn towards its mean,
    frequency by frequency, by the share s of its power that is noise.

    What the frames leave open is drawn at random, with (1 - s) (X - Q), where X and Q are the powers of the
    recorded and of the simulated pattern: both have the same power then, whether or not the simulator's is
    that of this camera. What they differ by, X + Q - 2 C, would be too much where it is another one: it is
    there already. Where the simulator has too much, that much of its own is taken out. What stands out is
    kept.
    """
    ours, theirs = pattern
    both = combined((ours, theirs), np.array([1.0, -1.0]))
    centre = float(median(both.values))
    away = both.values - centre
    # Pixels that stand out of a pattern would count as power of all; those that are only noisy are not known.
    out = np.any([_far(m.values, both.own) for m in (both, ours, theirs)], 0)
    aside = out | _apart(both.values, both.own)
    waves, recorded, simulated = (
        fft.fft2(np.where(aside, 0.0, m.values - median(m.values))) for m in (both, ours, theirs)
    )
    used = 1 - float(aside.mean())
    power, own, other = (
        np.abs(v) ** 2 / both.values.size - used * m.power
        for v, m in ((waves, both), (recorded, ours), (simulated, theirs))
    )
    floors = ours.smoothed(), theirs.smoothed()
    noise = floors[0] + floors[1]
    # The noise is measured too.
    scatter = noise * np.sqrt(1 + 1 / both.contrasts)
    beyond = np.maximum(smooth(power, 1, scatter, SURE), 0)
    share = beyond / (beyond + noise)
    # Patterns scatter by their own power too.
    level = scatter + max(float(other[1:, 1:].mean()), 0.0)
    more = smooth(own - other, 1, level, SURE)
    had = np.maximum(smooth(other, 1, level, SURE), 0)
    stays = _stays(share, beyond, more, had, floors)
    open_part = fft.fft2(np.random.default_rng(seed).standard_normal(both.values.shape))
    drawn = np.sqrt((1 - share) * np.maximum(more, 0)) * open_part
    rest = fft.ifft2(share * waves - (1 - share - stays) * simulated + drawn).real
    return centre + np.where(out, away, rest)


def _stays(
    share: np.ndarray, beyond: np.ndarray, more: np.ndarray, had: np.ndarray, noise: tuple[np.ndarray, ...]
) -> np.ndarray:
    """Share a of the simulator's own pattern that stays beside a share s of the recorded one: 1 - s, less
    where the simulator has too much, so that the sum has the recorded power X (nearest where none has):

        a^2 Q + 2 a s C + s^2 (X + N) + (1 - a)^2 M = X

    beyond: X + Q - 2 C; more: X - Q; had: Q; noise: N and M, of both means.
    """
    recorded = np.maximum(had + more, 0)
    common = (recorded + had - beyond) / 2
    two, one = had + noise[1], share * common - noise[1]
    none = share**2 * (recorded + noise[0]) + noise[1] - recorded
    root = np.sqrt(np.maximum(one**2 - two * none, 0))
    best = (root - one) / np.maximum(two, 1e-30)
    return np.where(more < 0, np.clip(best, 0, 1 - share), 1 - share)
