"""Detection against strength, and whether p-values of effect-free sets are uniform."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import stats

LEAST_SETS = 20
"""Sets from which a mechanism gets a curve of its own."""
_HALF = np.geomspace(0.1, 30, 240)
_SLOPE = np.geomspace(0.5, 30, 60)


def uniformity(p_values: list[float]) -> dict[str, Any]:
    """Kolmogorov-Smirnov test against the uniform law; tied values are spread evenly down to the next one.

    Two-sided, and one-sided against p-values that are too small, which is what raises false alarms.
    """
    p = np.sort(np.asarray(p_values, float))
    if p.size < 5:
        return {"sets": int(p.size), "ks_p": None, "too_small_p": None}
    spread, below = np.empty_like(p), 0.0
    for value in np.unique(p):
        tied = np.flatnonzero(p == value)
        steps = (np.arange(tied.size) + 0.5) / tied.size
        spread[tied] = value if tied.size == 1 else below + (value - below) * steps
        below = value
    return {
        "sets": int(p.size),
        "ks_p": float(stats.kstest(spread, "uniform").pvalue),
        "too_small_p": float(stats.kstest(spread, "uniform", alternative="greater").pvalue),
    }


def half_power(multiples: list[float], seen: list[bool]) -> dict[str, Any]:
    """Logistic fit of detection in log strength: the multiple of the MDE seen in half of the sets.

    95 % interval by the profile likelihood; a bound is null where the data do not give it.
    """
    x, y = np.log(np.asarray(multiples, float)), np.asarray(seen, bool)
    out: dict[str, Any] = {
        "sets": int(x.size),
        "points": [[float(m), bool(s)] for m, s in zip(multiples, seen, strict=True)],
        "half_at": None,
        "ci95": [None, None],
        "slope": None,
    }
    if x.size < 5 or y.all() or not y.any():
        return out
    sign = np.where(y, -1.0, 1.0)
    margin = _SLOPE[None, :, None] * (x[None, None, :] - np.log(_HALF)[:, None, None])
    table = -np.logaddexp(0, sign * margin).sum(2)
    profile = table.max(1)
    best = int(profile.argmax())
    inside = np.flatnonzero(profile >= profile[best] - 0.5 * stats.chi2.isf(0.05, 1))
    low = float(_HALF[inside[0]]) if inside[0] > 0 else None
    high = float(_HALF[inside[-1]]) if inside[-1] < _HALF.size - 1 else None
    slope = float(_SLOPE[table[best].argmax()])
    return {**out, "half_at": float(_HALF[best]), "ci95": [low, high], "slope": slope}


def chance(multiple: np.ndarray, half_at: float, slope: float) -> np.ndarray:
    """Fitted probability of detection."""
    return 1 / (1 + (half_at / multiple) ** slope)


def limit(multiple: np.ndarray, alpha: float = 0.01) -> np.ndarray:
    """Power at level alpha of the likelihood-ratio test that knows the effect: shift 5 x multiple."""
    return stats.norm.sf(stats.norm.isf(alpha) - 5 * np.asarray(multiple))
