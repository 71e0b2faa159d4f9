"""Codes of a table: further apart where there is more light, as those that a square root was drawn from are.

Rounding to them adds their local spacing^2 / 12 to the variance of a pixel (Sheppard), which grows with the
light as shot noise does, and would be taken for gain. It holds for noise of half a spacing and more.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.views import usual_variance
from cannoise_jax.recordings.codes import Spacing
from cannoise_jax.recordings.recording import DARK

_WIDER = 1.5
"""Times the spacing of one lattice from which that of a table is another."""
_SHOWN = 0.01
"""Of the variance of a flat, that of rounding from which it is said."""
_HALF = 0.5
"""Noise in units of the spacing from which rounding adds what is said above, to 3 % of the noise."""

MOSTLY_ROUNDING = "more than twice their noise, so that their variance is mostly that of rounding"


def table_of(s: FrameStatistics, step: float) -> Spacing | None:
    """The spacing of the codes of a recording where it is wider than `step`, DN; None where it is not."""
    found = s.spacing
    wider = found is not None and float(median(found.cells)) >= _WIDER * max(step, 1.0)
    return found if wider else None


def rounding_beyond(
    s: FrameStatistics, mean: Float[np.ndarray, "h w"], step: float
) -> Float[np.ndarray, "h w"] | float:
    """Variance that rounding to the codes of a table adds beyond that of a lattice of `step`, DN^2, at pixels
    of these means."""
    found = table_of(s, step)
    if found is None:
        return 0.0
    return np.maximum(found.at(mean) ** 2 - step**2, 0.0) / 12


def own_step(s: FrameStatistics, step: float) -> float:
    """The spacing of the codes of a dark, DN: its own where a table has put them further apart."""
    found = table_of(s, step) if s.recording.kind in DARK else None
    return step if found is None else float(found.at(median(s.mean)))


def spacing_line(statistics: Sequence[FrameStatistics], step: float, c: int) -> str:
    """How far apart the codes of flats lie where the variance of rounding to them matters, and whether it is
    known; empty where it does not."""
    said, coarse = [], False
    for s in statistics:
        if s.recording.kind != "flat" or s.variance is None or (found := table_of(s, step)) is None:
            continue
        apart, variance = float(found.at(median(s.mean))), usual_variance(s, c)
        if apart**2 / 12 < _SHOWN * variance:
            continue
        said.append(apart)
        coarse |= variance < (_HALF**2 + 1 / 12) * apart**2
    if not said:
        return ""
    ends = (
        f"{min(said):.0f}" if round(min(said)) == round(max(said)) else f"{min(said):.0f} to {max(said):.0f}"
    )
    known = "as of a table: the variance of rounding to them is taken out of that of the flats"
    return f"codes of the flats lie {ends} DN apart, {MOSTLY_ROUNDING if coarse else known}"
