"""A lamp that flickers far above the noise, on both sides: what is compared is the rest.

Its phase is drawn anew in every frame. Of a few frames, waves a hundred times the noise leave what they
happen to leave in every energy, and hide the noise of pixels. Where recordings and draws both have such
waves, and of like power, they are taken out of every row of every site: light that flickers varies from row
to row, in proportion to the signal along the row.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.compare.view import Raw
from cannoise_jax.recordings.packing import SITES

FAR_ABOVE = 1.0
"""Variance of rows, in units of that of their pixels, from which on a lamp hides them."""
_LIKE, _FEWEST = 4.0, 4
"""Ratio of the powers of such waves up to which they count as alike, and contrasts from which on that is
asked: of fewer, whose phases are random, it is larger in one case of ten and more; of six, in one of
a hundred."""
_DEGREE = 4
"""Of the course of the light over the rows beside the wave."""


def without_wave(
    mean: Float[np.ndarray, "h w"], contrasts: Float[np.ndarray, "n h w"], black: Sequence[float]
) -> Float[np.ndarray, "h w"]:
    """The mean of lit frames without what it holds of the waves of a lamp far above the noise; as it is where
    there are none. black: level of every site, DN."""
    if not len(contrasts) or _rows_over_pixels(contrasts, _above(mean, black)) < FAR_ABOVE:
        return mean
    return _even(mean, black)


def steadied(
    real: Raw, drawn: Sequence[Raw], light: Float[np.ndarray, "h w"], black: Sequence[float]
) -> tuple[Raw, list[Raw]]:
    """Recording and draws without the waves of a lamp, where all have them; as they are where one has none.

    light: the fitted mean of the recording, DN; black: level of every site, DN."""
    as_they_are = real, list(drawn)
    signal = _above(light, black)
    own = _rows_over_pixels(real.contrasts, signal) if len(real.contrasts) else 0.0
    if own < FAR_ABOVE:  # under steady light the draws are not looked at
        return as_they_are
    powers = [_rows_over_pixels(raw.contrasts, signal) for raw in drawn]
    alike = len(real.contrasts) < _FEWEST or 1 / _LIKE < float(np.mean(powers)) / own < _LIKE
    if min(powers) < FAR_ABOVE or not alike:
        return as_they_are

    def steady(raw: Raw) -> Raw:
        contrasts = raw.contrasts.copy()
        for at in SITES:
            share = _shares(contrasts[:, *at], signal[at])
            share -= share.mean(1, keepdims=True)  # the level of a frame stays
            contrasts[:, *at] -= (share[:, :, None] * signal[at]).astype(np.float32)
        return raw._replace(contrasts=contrasts, mean=_even(raw.mean, black))

    return steady(real), [steady(raw) for raw in drawn]


def _above(mean: Float[np.ndarray, "h w"], black: Sequence[float]) -> Float[np.ndarray, "h w"]:
    out = np.array(mean, np.float32)
    for at, level in zip(SITES, black, strict=True):
        out[at] -= level
    return out


def _shares(values: Float[np.ndarray, "n a b"], signal: Float[np.ndarray, "a b"]) -> Float[np.ndarray, "n a"]:
    """Of every row, by how much of the signal it is off."""
    square = np.maximum(np.sum(signal.astype(np.float64) ** 2, 1), 1e-30)
    return np.einsum("nij,ij->ni", values, signal) / square


def _rows_over_pixels(contrasts: Float[np.ndarray, "n h w"], signal: Float[np.ndarray, "h w"]) -> float:
    """Variance that rows share, in units of that of the pixels within them; what whole frames share aside."""
    shared = own = 0.0
    for at in SITES:
        share = _shares(contrasts[:, *at], signal[at])
        waves = share[:, :, None] * signal[at]
        shared += float(np.mean(((share - share.mean(1, keepdims=True))[:, :, None] * signal[at]) ** 2))
        own += float(np.mean((contrasts[:, *at] - waves) ** 2))
    return shared / max(own, 1e-30)


def _even(mean: Float[np.ndarray, "h w"], black: Sequence[float]) -> Float[np.ndarray, "h w"]:
    """Every row of every site at the smooth course of the light over the rows."""
    out = np.array(mean, np.float32)
    for at, level in zip(SITES, black, strict=True):
        rows = out[at].mean(1, dtype=np.float64) - level
        along = np.linspace(-1, 1, rows.size)
        course = np.polynomial.legendre.Legendre.fit(along, rows, min(_DEGREE, rows.size - 1))(along)
        factor = np.where((rows > 0) & (course > 0), course / np.where(rows > 0, rows, 1.0), 1.0)
        out[at] = (out[at] - level) * factor[:, None] + level
    return out
