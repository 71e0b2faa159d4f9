"""Whether the noise of loud rows or columns is that of their pixels, each by itself, as a name for read noise
of lines says.

A line whose amplifier jumps between levels, or wanders, is louder than the others as well; its pixels are
alike from one to the next then. That is told from what all lines have, as by neighbours that are blended, by
the lines that are quiet.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.proof.white_maps import NOISE
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.transfer.noise_of_lines import within_lines
from cannoise_jax.signatures.fields import Fields

_LOUD, _QUIET = 0.1, 0.5
"""Shares of the lines that are taken for loud ones, and for quiet ones."""
_FEWEST = 4
"""Loud lines from which on they are asked."""
_ALIKE = 0.05
"""Correlation of pixels of loud lines with the next, beyond that of quiet lines, that matters."""
_SURE = 5.0
"""Standard errors by which it must stand out."""


def pixels_alike(step: Step) -> Doubt | None:
    """What speaks against a step that names a read noise of every row or column; None: nothing does, or it
    names none."""
    axes = step.named.signature.axes
    if step.named.mechanism == UNKNOWN or axes.law != NOISE or axes.varies_over not in ("row", "column"):
        return None
    told = [_along(f, axes.varies_over) for f in step.before if not f.lit and f.frames > 1]
    if not told:
        return None
    power, product, count = np.sum(told, axis=0)
    shown = (count > 0.5 * np.max(count)) & (power > 0)
    power, product = power[shown], product[shown]
    number, order = len(power), np.argsort(-power / count[shown])
    loud, quiet = order[: max(int(_LOUD * number), 1)], order[-max(int(_QUIET * number), 1) :]
    if len(loud) < _FEWEST:
        return None
    alike = product / power
    more = float(np.mean(alike[loud]) - np.mean(alike[quiet]))
    error = float(np.std(alike[quiet], ddof=1)) * np.sqrt(1 / len(loud) + 1 / len(quiet))
    if more < max(_ALIKE, _SURE * error):
        return None
    said = f"along the loudest {axes.varies_over}s pixels are alike from one to the next: {more:+.2f}"
    return Doubt(more, (said,), instead=True)


def _along(field: Fields, axis: str) -> Float[np.ndarray, "3 k"]:
    """Of every line the sum of squares of its pixels about its mean, that of products with the next, and how
    many tell."""
    values = field.contrasts[: field.frames - 1] * field.usable
    values = within_lines(values, field.usable, "row" if axis == "row" else "column")
    values = values if axis == "row" else np.swapaxes(values, 1, 2)
    products = np.einsum("nkl,nkl->k", values[..., 1:], values[..., :-1])
    count = (field.frames - 1.0) * field.usable.sum(1 if axis == "row" else 0)
    return np.stack([np.einsum("nkl,nkl->k", values, values), products, count])
