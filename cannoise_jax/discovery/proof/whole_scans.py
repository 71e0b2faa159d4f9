"""Whether noise along the scan is as strong all along the rows, as a name for it says.

Such noise runs on from row to row: pixels side by side share as much of it at the start of a row as at its
end. Rows that settle from a level of their own, or a disturbance at one edge, have as much power at the low
frequencies of a scan, all of it in a few columns.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.proof.whole_lines import of_parts
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.signatures.fields import Fields

_STRIPS = 12
"""Strips of columns that are told apart: an e-fold of a tenth of the row then fills two."""
_LAGS = (2, 3, 4)
"""Pixels apart: those next to each other share charge."""
_TYPICAL = 0.5
"""Of what strips share on average, below which a typical strip has next to nothing. Simulated 1/f noise of
0.2 to 1 standard deviation of a pixel has 0.8 to 1.4, levels that settle over 6 % of the rows 0.16."""
_CHANCE = 1e-6
"""Probability that strips of such noise differ as much."""


def in_places(step: Step) -> Doubt | None:
    """What speaks against a step that names noise of a power law along the scan, new in every frame; None:
    nothing does, or it names none."""
    axes = step.named.signature.axes
    along = (axes.varies_over, axes.time, axes.law) == ("raster", "redrawn", "1/f")
    if step.named.mechanism == UNKNOWN or not along:
        return None
    parts = of_parts(step, _products)
    if parts is None or parts.mean <= 0 or parts.typical > _TYPICAL * parts.mean or parts.chance > _CHANCE:
        return None
    edges = np.linspace(0, step.before[0].mean.shape[1], _STRIPS + 1).astype(int)
    most = int(np.argmax(parts.each))
    where = f"columns {edges[most]} to {edges[most + 1] - 1}"
    said = f"most of it lies in few columns, about {where}: rows that settle or are disturbed there"
    return Doubt(1 - max(parts.typical, 0.0) / parts.mean, (said,), instead=True)


def _products(field: Fields) -> Float[np.ndarray, "12 k"]:
    """Mean products of pixels side by side in every strip of every row, DN^2."""
    out = []
    for contrast in field.contrasts[: field.frames - 1]:
        off = np.where(field.usable, contrast * field.sigma, 0.0)
        shared = sum(off[:, : -max(_LAGS)] * np.roll(off, -lag, 1)[:, : -max(_LAGS)] for lag in _LAGS)
        strips = np.array_split(np.asarray(shared) / len(_LAGS), _STRIPS, axis=1)
        out.append([s.mean(1) for s in strips])
    return np.concatenate(out, 1)
