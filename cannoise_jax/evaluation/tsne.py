"""t-SNE (van der Maaten and Hinton 2008), exact, for some hundred points; and how well groups part."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

_EXAGGERATION, _EARLY, _STEPS, _RATE = 12.0, 150, 600, 50.0


def tsne(points: Float[np.ndarray, "n d"], perplexity: float = 20.0) -> Float[np.ndarray, "n 2"]:
    """A map of points in the plane that keeps neighbours. Starts from the principal components, so that the
    same points give the same map."""
    points = np.asarray(points, np.float64)
    count = len(points)
    wanted = neighbour_shares(points, min(perplexity, (count - 1) / 3))
    wanted = np.maximum((wanted + wanted.T) / (2 * count), 1e-12)
    centred = points - points.mean(0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    place = np.zeros((count, 2))
    place[:, : min(2, len(axes))] = centred @ axes[:2].T
    place *= 1e-2 / max(place.std(), 1e-30)
    speed, gains = np.zeros_like(place), np.ones_like(place)
    for step in range(_STEPS):
        near = 1 / (1 + squares(place))
        np.fill_diagonal(near, 0)
        pull = (wanted * (_EXAGGERATION if step < _EARLY else 1) - near / near.sum()) * near
        slope = 4 * (np.diag(pull.sum(1)) - pull) @ place
        gains = np.where((slope > 0) == (speed > 0), np.maximum(0.8 * gains, 0.01), gains + 0.2)
        speed = (0.5 if step < _EARLY else 0.8) * speed - _RATE * gains * slope
        place = place + speed
        place -= place.mean(0)
    return place


def neighbour_shares(points: Float[np.ndarray, "n d"], perplexity: float) -> Float[np.ndarray, "n n"]:
    """Gaussian weights of the neighbours of each point, rows of sum one and of this perplexity."""
    distance = squares(np.asarray(points, np.float64))
    np.fill_diagonal(distance, np.inf)
    distance -= distance.min(1, keepdims=True)
    count = len(points)
    # Precisions by bisection of their logarithms, all points at once.
    scale = np.median(distance[np.isfinite(distance)]) or 1.0
    low, high = np.full(count, np.log(1e-6 / scale)), np.full(count, np.log(1e9 / scale))
    for _ in range(60):
        middle = (low + high) / 2
        weights = np.exp(-np.exp(middle)[:, None] * distance)
        shares = weights / weights.sum(1, keepdims=True)
        entropy = -np.sum(shares * np.log(np.maximum(shares, 1e-300)), 1)
        wide = entropy > np.log(perplexity)
        low, high = np.where(wide, middle, low), np.where(wide, high, middle)
    return shares


def same_among_nearest(
    points: Float[np.ndarray, "n d"], group: Int[np.ndarray, "n"], count: int = 5
) -> Float[np.ndarray, "n"]:
    """Of each point's `count` nearest the share that is of its group."""
    distance = squares(np.asarray(points, np.float64))
    np.fill_diagonal(distance, np.inf)
    nearest = np.argsort(distance, axis=1, kind="stable")[:, :count]
    group = np.asarray(group)
    return (group[nearest] == group[:, None]).mean(1)


def squares(points: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "n n"]:
    """Squared distances of all pairs."""
    return np.square(points[:, None] - points[None]).sum(-1)
