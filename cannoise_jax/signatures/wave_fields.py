"""One plane wave in the fields: its phasors, whether it was taken out, and taking it out."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.phasors import orthonormal, projected_out, without_beside
from cannoise_jax.signatures.score import Score

_LEAST_REST = 0.01
"""Share of a field's power that is taken to be no wave's, at least."""
_NONE_LEFT = 0.02
"""Power of contrasts, in that of the noise, below which a wave was taken out of them: one contrast has less
by chance in one of fifty cases."""
_BANDS = (4, 8)
"""Bands of rows and of columns between which offsets may step."""


class Wave(NamedTuple):
    """Cycles a pixel along the columns and the rows, its share of what whole rows or columns share, and that
    of all that is alike between pixels."""

    fy: float
    fx: float
    of_lines: float
    of_all: float = 0.0


def turn_of(fy: float, fx: float, size: tuple[int, int]) -> Complex[np.ndarray, "h w"]:
    """A wave of cycles per pixel, turning backwards."""
    y, x = np.arange(size[0])[:, None], np.arange(size[1])[None, :]
    return np.exp(-2j * np.pi * (fy * y + fx * x)).astype(np.complex64)


def taken(chosen: list[Fields], turn: Complex[np.ndarray, "h w"]) -> bool:
    """Whether a wave of this frequency and of a new phase in every frame was taken out: the contrasts then
    have no power there. What maps that are taken out after it bring back in what stays is no wave."""
    told = [centred(f, f.contrasts, turn) for f in chosen if len(f.contrasts)]
    if not told:
        return False
    own, _, rest = (np.concatenate(parts) for parts in zip(*told, strict=True))
    return bool(np.mean(np.abs(own) ** 2) < _NONE_LEFT * np.mean(rest))


def centred(
    field: Fields, values: np.ndarray, turn: np.ndarray
) -> tuple[Complex[np.ndarray, "n"], Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Of each field the phasor at one frequency, of mean power 1 under the null; the field's own power that
    this was divided by, over that of the modelled noise; and what is left of that without the wave."""
    w = field.weight.astype(np.float32)
    total = float(np.sum(w.astype(np.float64) ** 2))
    weighted = values * w
    level = np.einsum("nij->n", weighted) / total
    centred = weighted - level[:, None, None] * w**2
    own = np.maximum(np.einsum("nij,nij->n", centred, centred, dtype=np.float64), 1e-30)
    phasor = np.einsum("nij,ij->n", centred, turn) / np.sqrt(own)
    of_wave = np.minimum(2 * np.abs(phasor) ** 2 / max(np.count_nonzero(w), 1), 1 - _LEAST_REST)
    return phasor, own / total, own / total * (1 - of_wave)


def wave_absorb(fields: tuple[Fields, ...], score: Score[Wave], *, stays: bool) -> tuple[Fields, ...]:
    """Projects the wave out of every field, and its near neighbours on the frequency grid; not the mean of a
    field, which is no wave's. What stays holds steps between regions as well, of which a wave has a share
    that is not taken. stays: out of what stays alone, for the same phase in all frames is in no contrast."""
    fy, fx = score.payload.fy, score.payload.fx
    waves, regions = _neighbours(fy, fx, fields[0].mean.shape), _regions(fields[0].mean.shape)
    out = []
    for f in fields:
        weight = f.weight.ravel().astype(np.float64)
        total = max(float(np.sum(weight**2)), 1e-30)
        q = orthonormal((waves - (waves @ weight**2 / total)[:, None]) * weight)
        left = f if stays else map_contrasts(f._replace(static=None), partial(projected_out, q=q))
        static = None if f.static is None else without_beside(f.static, q, regions * weight)
        out.append(left._replace(static=static))
    return tuple(out)


def _regions(size: tuple[int, int]) -> Float[np.ndarray, "k p"]:
    """Bands of rows and of columns that amplifiers may read, each 1 in its own, at every pixel."""
    rows, columns = (np.eye(k)[:, np.arange(n) * k // n] for n, k in zip(size, _BANDS, strict=True))
    return np.concatenate([np.kron(rows, np.ones(size[1])), np.tile(columns, size[0])])


def _neighbours(fy: float, fx: float, size: tuple[int, int]) -> Float[np.ndarray, "18 p"]:
    """Both phases of a plane wave and of those half a frequency of the frame away, at every pixel."""
    h, w = size
    out = []
    for dy in (-0.5 / h, 0.0, 0.5 / h):
        for dx in (-0.5 / w, 0.0, 0.5 / w):
            turn = np.exp(2j * np.pi * (fy + dy) * np.arange(h))[:, None]
            wave = turn * np.exp(2j * np.pi * (fx + dx) * np.arange(w))
            out += [wave.real.ravel(), wave.imag.ravel()]
    return np.array(out)
