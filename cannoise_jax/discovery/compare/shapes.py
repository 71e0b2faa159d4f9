"""Spectra as few recordings show them: noise out of maps, shapes told from the chance of frequencies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft, ndimage, stats

from cannoise_jax.physics.robust import robust_std

_WIDE = 7
"""Frequencies over which a broad shape is averaged: of 49 it is known to a seventh of one, of 7 along a line
to 0.38."""
SURE, LIKELY = 3.0, 2.0
"""Standard errors from which a part of a spectrum is not what it is elsewhere: of fixed maps, of redrawn
noise."""


class Pattern(NamedTuple):
    """What stays in the recorded mean and in the simulator's, DN, and their variance by noise, DN^2."""

    recorded: Float[np.ndarray, "h w"]
    simulated: Float[np.ndarray, "h w"]
    noise: float
    simulated_noise: float

    def combined(self, others: Sequence[Pattern], weights: Float[np.ndarray, "k"]) -> Pattern:
        """Sum of this and others, each times its weight."""
        every = (self, *others)
        return Pattern(
            np.tensordot(weights, np.stack([p.recorded for p in every]), 1),
            np.tensordot(weights, np.stack([p.simulated for p in every]), 1),
            float(weights**2 @ np.array([p.noise for p in every])),
            float(weights**2 @ np.array([p.simulated_noise for p in every])),
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
    values, noise = pattern.recorded - pattern.simulated, pattern.noise + pattern.simulated_noise
    centre = float(np.median(values))
    away = values - centre
    # Pixels that stand out of a pattern would count as power of all.
    out = np.any([_far(v, noise) for v in (values, pattern.recorded, pattern.simulated)], 0)
    waves, recorded, simulated = (
        fft.fft2(np.where(out, 0.0, v - np.median(v))) for v in (values, pattern.recorded, pattern.simulated)
    )
    power, ours, theirs = (np.abs(v) ** 2 / values.size for v in (waves, recorded, simulated))
    beyond = np.maximum(smooth(power - noise, 1, noise, SURE), 0)
    share = beyond / (beyond + noise)
    # Patterns scatter by their own power too.
    level = noise + float(theirs[1:, 1:].mean())
    more = smooth(ours - pattern.noise - (theirs - pattern.simulated_noise), 1, level, SURE)
    had = np.maximum(smooth(theirs - pattern.simulated_noise, 1, level, SURE), 0)
    stays = _stays(share, beyond, more, had, pattern)
    open_part = fft.fft2(np.random.default_rng(seed).standard_normal(values.shape))
    drawn = np.sqrt((1 - share) * np.maximum(more, 0)) * open_part
    rest = fft.ifft2(share * waves - (1 - share - stays) * simulated + drawn).real
    return centre + np.where(out, away, rest)


def _far(values: Float[np.ndarray, "h w"], noise: float) -> Bool[np.ndarray, "h w"]:
    return np.abs(values - np.median(values)) > 5 * max(robust_std(values), np.sqrt(noise))


def _stays(share: np.ndarray, beyond: np.ndarray, more: np.ndarray, had: np.ndarray, pattern: Pattern):
    """Share a of the simulator's own pattern that stays beside a share s of the recorded one: 1 - s, less
    where the simulator has too much, so that the sum has the recorded power X (nearest where none has):

        a^2 Q + 2 a s C + s^2 (X + N) + (1 - a)^2 M = X

    beyond: X + Q - 2 C; more: X - Q; had: Q; N, M: noise of both means.
    """
    recorded = np.maximum(had + more, 0)
    common = (recorded + had - beyond) / 2
    two, one = had + pattern.simulated_noise, share * common - pattern.simulated_noise
    none = share**2 * (recorded + pattern.noise) + pattern.simulated_noise - recorded
    root = np.sqrt(np.maximum(one**2 - two * none, 0))
    best = (root - one) / np.maximum(two, 1e-30)
    return np.where(more < 0, np.clip(best, 0, 1 - share), 1 - share)


def smooth(power: np.ndarray, n: int, level: float, errors: float) -> np.ndarray:
    """A spectrum (of `n` fields together) as white as it may be.

    Broad shapes, rows, columns, those of odd against even pixels, frequencies along rows (or down columns)
    whose phase is another one in each, and single frequencies depart from white only where they stand out of
    their scatter.
    White that does not stand out either is no power at all.
    level: power that is not in `power`, but that it scatters by.
    errors: standard errors from which it stands out.
    """
    h, w = power.shape
    own_rows, own_columns = ([0, m // 2] if m % 2 == 0 else [0] for m in (h, w))
    plane = power.copy()
    for i in own_rows:
        plane[i] = (power[(i + 2) % h] + power[i - 2]) / 2
    for j in own_columns:
        plane[:, j] = (plane[:, (j + 2) % w] + plane[:, j - 2]) / 2
    chance = level + max(float(plane.mean()), -0.9 * level)
    lines = [
        _narrow(np.delete(plane, own, axis).mean(axis), errors * chance / np.sqrt(n * m))
        for axis, own, m in ((0, own_rows, h), (1, own_columns, w))
    ]
    narrow = lines[0][None, :] + lines[1][:, None]
    plane = plane - narrow
    white = float(plane.mean())
    white = white if abs(white) > errors * level / np.sqrt(n * power.size) else 0.0
    scatter = max(level + white, 0.1 * level)

    def sure(values: np.ndarray, count: int) -> np.ndarray:
        return np.where(np.abs(values - white) > errors * scatter / np.sqrt(n * count), values, white)

    out = sure(ndimage.uniform_filter(plane, _WIDE, mode="wrap"), _WIDE**2) + narrow
    for i in own_rows:
        out[i, 1:] = sure(_along(power[i, 1:]), _WIDE)
    for j in own_columns:
        out[1:, j] = sure(_along(power[1:, j]), _WIDE)
    limit = stats.chi2.isf(0.05 / power.size, 2 * n) / (2 * n) - 1
    beside = np.maximum(out + level, 0.1 * level)
    out = np.where(power - out > limit * beside, power, out)
    out[0, 0] = power[0, 0] if power[0, 0] > 4 * scatter else white
    return out


def _narrow(line: np.ndarray, least: float) -> np.ndarray:
    """What stands out of the broad shape of a line by more than `least`, and nothing else of it."""
    away = line - ndimage.median_filter(line, 2 * _WIDE + 1, mode="wrap")
    return np.where(np.abs(away) > least, away, 0.0)


def _along(line: np.ndarray) -> np.ndarray:
    """A line of a spectrum smoothed, single frequencies aside."""
    local = ndimage.median_filter(line, 9, mode="wrap")
    spread = robust_std(line - local, 0)
    return ndimage.uniform_filter1d(np.where(line - local > 6 * spread, local, line), _WIDE, mode="wrap")
