"""Whether the parts of a line move together, as a name for noise of whole lines says.

The means of lines are noisier than independent pixels make them where the lines move, but also where pixels
far apart are alike: two halves of a frame that share their noise, amplifiers that read mirrored quadrants at
once. A line that moves does so from end to end: each two of its quarters have the line's variance in common.
Where most pairs of quarters have next to nothing of it, what is alike are places, not lines.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields

_PARTS = 4
"""Quarters: six pairs of parts, of which three are neighbours."""
_SHARED = 0.25
"""Of what pairs of quarters have in common on average, below which a typical pair has next to nothing."""
_CHANCE = 1e-6
"""Probability that pairs of a line that moves as a whole differ as much."""


def in_parts(step: Step) -> Doubt | None:
    """What speaks against a step that names white noise of rows or columns, redrawn in every frame; None:
    nothing does, or it names none."""
    axes = step.named.signature.axes
    white = (axes.time, axes.law, axes.scales) == ("redrawn", "white", "additive")
    if step.named.mechanism == UNKNOWN or not white or axes.varies_over not in ("row", "column"):
        return None
    parts = of_parts(step, partial(_products, axis=0 if axes.varies_over == "row" else 1))
    if parts is None or parts.typical > _SHARED * parts.mean or parts.chance > _CHANCE:
        return None
    share = max(parts.typical, 0.0) / parts.mean if parts.mean > 0 else 0.0
    said = f"most quarters of {axes.varies_over}s have nothing in common: parts far apart are alike, no lines"
    return Doubt(1 - share, (said,), instead=True)


class Parts(NamedTuple):
    """What parts of the frame have in common: of each its mean product, the mean and the median of these, and
    the probability that parts that all have as much differ by as much."""

    each: Float[np.ndarray, "n"]
    mean: float
    typical: float
    chance: float


def of_parts(step: Step, products: Callable[[Fields], Float[np.ndarray, "n k"]]) -> Parts | None:
    """Of the darks that a step was found on, else of all recordings; None where none has two frames.
    products: of each part, as often as they are independent."""
    told = [f for f in step.before if not f.lit] or list(step.before)
    found = [products(f) for f in told if f.frames > 1]
    if not found:
        return None
    values = np.concatenate(found, 1)
    each, variance = values.mean(1), values.var(1) / values.shape[1]
    mean = float(each.mean())
    uneven = float(np.sum((each - mean) ** 2 / np.maximum(variance, 1e-300)))
    return Parts(each, mean, float(median(each)), float(stats.chi2.sf(uneven, len(each) - 1)))


def _products(field: Fields, axis: int) -> Float[np.ndarray, "6 k"]:
    """Products of the means of every two quarters of all lines, DN^2. axis: 0 of rows, 1 of columns."""
    kept = field.usable if axis == 0 else field.usable.T
    parts = np.array_split(np.arange(kept.shape[1]), _PARTS)
    count = [np.maximum(kept[:, part].sum(1), 1) for part in parts]
    out = []
    for contrast in field.contrasts[: field.frames - 1]:
        off = np.where(field.usable, contrast * field.sigma, 0.0)
        off = off if axis == 0 else off.T
        means = [off[:, part].sum(1) / n for part, n in zip(parts, count, strict=True)]
        means = [m - m.mean() for m in means]
        out.append([a * b for a, b in combinations(means, 2)])
    return np.concatenate(out, 1)
