"""How wide a map of pixels is with those that are far out of it."""

from __future__ import annotations

import numpy as np

from cannoise_jax.recordings.recording import KINDS
from cannoise_jax.signatures.fields import Fields, quoted_at
from cannoise_jax.signatures.patterns import FAR_OUT, beside_lines, pixel_sums

_WIDER = 1.15
"""Standard deviation of all pixels over that of most, from which on those far out are worth a word."""
_SURE = 3.0
"""And standard errors by which it is larger."""


def spread_of_all(fields: tuple[Fields, ...], scaling: str, sigma: float) -> tuple[float, float] | None:
    """Standard deviation of a map with the pixels that are no part of its law, beside what lines share, in
    the unit of `sigma`, which is that of the others, and its standard error; None where none is far out, or
    it is hardly larger."""
    sums, seconds = pixel_sums(fields, scaling, KINDS), quoted_at(fields, scaling)
    if sums is None or not seconds or not (seen := sums.information > 0).any():
        return None
    z, information = beside_lines(sums)[seen], sums.information[seen]
    if not (np.abs(z) > FAR_OUT * np.sqrt(1 + (sigma / seconds) ** 2 * information)).any():
        return None
    squares = z**2 / information
    variance = float(np.mean(squares) - np.mean(1 / information))
    if not variance > 0:
        return None
    rms = float(np.sqrt(variance)) * seconds
    error = float(np.std(squares)) / np.sqrt(squares.size) / (2 * variance) * rms
    return (rms, error) if rms > max(_WIDER * sigma, sigma + _SURE * error) > 0 else None
