"""The gain of a response that bends.

Photon transfer fits a straight line of variance over mean. Where the mean signal is y = x (1 - a x / S) of
the linear signal x (DN, S from black to white, `nonlinearity`), the variance is K x (1 - 2 a x / S)^2: the
slope of the line is smaller than K, the gain of small signals, which a camera model with that mechanism has.
Curves of a higher order p are y = x (1 - a (x / S)^p), whose slope is 1 - (p + 1) a (x / S)^p.
Where pixels differ in sensitivity by a share p, y differs by the share p (1 - 2 a x / S) / (1 - a x / S).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import Estimate
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.rails import LINEAR

_STEPS = 20
"""Of a root of a curve: next to its top, where each halves what is left, a millionth is."""
_EXACT = 1e-10
"""Share of the range by which a step ends it."""
_FLAT = 1e-3
"""Slope of a curve that counts as its top."""


def slope_at(
    signal: Float[np.ndarray, "n"] | float, loss: float, span: Float[np.ndarray, "n"] | float
) -> np.ndarray:
    """Slope of the response at a recorded signal y, 1 - 2 a x / S: the root of 1 - 4 a y / S."""
    return np.sqrt(np.maximum(1 - 4 * loss * np.asarray(signal) / span, 0.0))


def linear_signal(signal: Float[np.ndarray, "n"], loss: float, span: float) -> Float[np.ndarray, "n"]:
    """The signal of a straight response, DN, for the recorded one: x of y = x (1 - a x / S)."""
    return 2 * signal / (1 + slope_at(signal, loss, span))


def signal_of_order(
    signal: Float[np.ndarray, "n"], loss: float, span: float, order: float
) -> Float[np.ndarray, "n"]:
    """The signal of a straight response, DN, for the recorded one of a curve of an order of 1 or more, on the
    side of its top on which small signals are."""
    if order == 1:
        return linear_signal(signal, loss, span)
    share = np.asarray(signal, np.float64) / span
    linear = share
    for _ in range(_STEPS):  # Newton's, which nears the root from one side, for the curve bends one way only
        lost = loss * linear**order
        away = (linear * (1 - lost) - share) / np.maximum(1 - (order + 1) * lost, _FLAT)
        linear = linear - away
        if np.max(np.abs(away), initial=0.0) < _EXACT:
            break
    return linear * span


def of_straight(
    statistics: Sequence[FrameStatistics], baseline: Baseline, estimates: Mapping[str, Estimate]
) -> float:
    """By what factor sensitivities differ more than the brightest flat shows, on which they are measured."""
    flat, loss = brightest_flat(statistics), estimates["loss"].value
    if flat is None:
        return 1.0
    share = float(np.mean(np.asarray(flat.level) / (baseline.white_level - baseline.black_level)))
    slope = max(float(slope_at(share, loss, 1.0)), 0.1)
    return (1 + slope) / 2 / slope


def small_signal(
    baseline: Baseline, statistics: Sequence[FrameStatistics], estimates: Mapping[str, Estimate]
) -> Baseline:
    """The baseline with the gain of small signals; estimates: `loss`, the share of the signal that is missing
    at white."""
    loss = estimates["loss"].value
    flats = [s for s in statistics if s.recording.kind == "flat" and s.variance is not None]
    span = baseline.white_level - baseline.black_level
    gain, error = baseline.gain.copy(), baseline.gain_stderr.copy()
    for c in range(len(gain)):
        level = np.array([s.level[c] for s in flats], np.float64)
        level = level[level > 0]
        level = level[level < LINEAR * span[c]] if (level < LINEAR * span[c]).any() else level
        if not len(level):
            continue
        slope = slope_at(level, loss, span[c])
        # Variance over mean in units of K. Every flat tells it with the same relative error.
        factor = 1 / float(np.mean(slope**2 / ((1 + slope) / 2)))
        gain[c], error[c] = factor * gain[c], factor * error[c]
    return dataclasses.replace(baseline, gain=gain, gain_stderr=error)
