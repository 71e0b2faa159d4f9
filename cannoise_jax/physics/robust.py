"""The spread of values that a few far ones do not move."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_OF_MEDIAN = 1.4826
"""Standard deviation of a normal law in units of the median of the distances from its centre."""


def robust_std(values: Float[np.ndarray, "..."], centre: float | None = None) -> float:
    """Standard deviation of the bulk of `values`, in their units, from the median of their distances to
    `centre`, by default to their own median."""
    return _OF_MEDIAN * float(np.median(np.abs(values - (np.median(values) if centre is None else centre))))
