"""The amplitude of a wave whose phase is new in every frame, over a fixed pattern of the same frequency."""

from __future__ import annotations

import numpy as np
from jaxtyping import Complex
from scipy import stats


def circle(points: Complex[np.ndarray, "T"], noise: float) -> tuple[float, float]:
    """Radius and its error of a circle through complex amplitudes, one per frame; its centre is the fixed
    pattern. noise: standard deviation of the real part, and of the imaginary part, of a point.

    Where the points do not stand out of the noise, or fewer than four frames fix a circle: the root of the
    scatter about their mean less that of the noise.
    """
    frames = len(points)
    scatter = float(np.sum(np.abs(points - points.mean()) ** 2)) / max(frames - 1, 1) - 2 * noise**2
    found = _fitted(points, noise) if frames >= 4 and scatter >= 9 * 2 * noise**2 else None
    if found is not None:
        return found
    square = max(scatter, 0.0)
    share = noise**2 / max(square, noise**2 / 4)
    # The mean taken out holds a random part of the wave.
    spread = (2 * noise**2 * (1 + share) + square / max(frames, 2)) / (2 * max(frames - 1, 1))
    return float(np.sqrt(square)), float(np.sqrt(spread))


def of_largest(power: float, frames: int, count: int) -> float:
    """The chance that the largest power among `count` frequencies reaches `power` in white noise.

    power: summed over `frames` frames of free phase, in units of its expectation in one. count: twice the
    frequencies of one period each where the peak is sought between them too.
    """
    return float(min(count * stats.gamma.sf(power, max(frames, 1)), 1.0))


def _fitted(points: Complex[np.ndarray, "T"], noise: float) -> tuple[float, float] | None:
    """Least squares of the distances to a centre; None where the points do not fix a circle (phases that lie
    on one side or on a line)."""
    size = float(np.sqrt(np.mean(np.abs(points) ** 2)))
    centre, radius = 0j, size
    design = np.empty((len(points), 3))
    for _ in range(50):
        away = points - centre
        distance = np.abs(away)
        direction = away / np.maximum(distance, 1e-30)
        design = np.stack([direction.real, direction.imag, np.ones(len(points))], -1)
        # Noise across the radius lengthens every distance.
        rest = distance - noise**2 / (2 * radius) - radius
        move, *_ = np.linalg.lstsq(design, rest, rcond=None)
        centre, radius = centre + complex(move[0], move[1]), radius + float(move[2])
        if not 0.1 * size < radius < 3 * size:
            return None
        if np.abs(move).max() < 1e-6 * radius:
            error = noise * float(np.sqrt(np.linalg.pinv(design.T @ design)[2, 2]))
            return (radius, error) if error < 0.3 * radius else None
    return None
