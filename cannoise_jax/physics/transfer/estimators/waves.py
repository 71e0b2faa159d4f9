"""One sinusoid along the rows of repeated frames, its phase free in every frame."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.estimate import Estimate, normal_estimate
from cannoise_jax.physics.transfer.estimators.circle import circle, of_largest

_HIGHEST = 0.48  # cycles per row: at 0.5 sine and cosine are one


class Wave(NamedTuple):
    """The strongest sinusoid of rows: amplitude (peak, in the unit of the rows, with the chance of the
    largest of all frequencies), frequency (cycles per row), and the sum of squares that it leaves of them."""

    amplitude: Estimate
    frequency: Estimate
    left: float


def strongest_wave(rows: Float[np.ndarray, "T H"]) -> Wave:
    """Least squares of a constant, sine and cosine on the rows of every frame less the average frame."""
    rest = rows - rows.mean(0)
    frames, height = rest.shape
    grid = np.arange(2, int(_HIGHEST * 8 * height)) / (8 * height)
    power = np.array([_explained(rest, f) for f in grid])
    frequency, step = float(grid[np.argmax(power)]), 1 / (8 * height)
    for _ in range(5):
        near = np.clip(frequency + step * np.linspace(-1, 1, 9), 0.2 / height, _HIGHEST)
        frequency, step = float(near[np.argmax([_explained(rest, f) for f in near])]), step / 4
    total, explained = float(np.sum((rest - rest.mean(1, keepdims=True)) ** 2)), _explained(rest, frequency)
    # Per frame: a constant and two amplitudes fitted to `height` rows; the averages cost one frame.
    noise = max(total - explained, 0.0) / ((frames - 1) * (height - 3))
    waves = _waves(height, frequency)
    coefficients = (rows - rows.mean()) @ np.linalg.pinv(waves - waves.mean(0)).T
    amplitude, stderr = circle(coefficients[:, 0] + 1j * coefficients[:, 1], np.sqrt(2 * noise / height))
    bound = np.sqrt(24 * noise / (max(amplitude, stderr) ** 2 * height**3 * (frames - 1))) / (2 * np.pi)
    chance = of_largest(explained / (2 * noise), frames - 1, height)
    return Wave(
        dataclasses.replace(normal_estimate(amplitude, stderr), chance=chance),
        normal_estimate(frequency, float(bound)),
        max(total - explained, 0.0),
    )


def _explained(rest: Float[np.ndarray, "T n"], frequency: float) -> float:
    """Sum of squares that a sinusoid of free phase in every row explains beyond a constant."""
    waves = _waves(rest.shape[1], frequency)
    wave, _ = np.linalg.qr(waves - waves.mean(0))
    return float(np.sum((rest @ wave) ** 2))


def _waves(count: int, frequency: float) -> Float[np.ndarray, "n 2"]:
    at = 2 * np.pi * frequency * (np.arange(count) - (count - 1) / 2)
    return np.stack([np.cos(at), np.sin(at)], -1)
