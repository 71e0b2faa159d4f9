"""What the statistics see: each recording as standardised residual fields, and how they are corrected.

A recording of T frames becomes T - 1 orthonormal contrasts between frames (Helmert), in which everything that
stays put cancels, and one static field, the mean over frames minus the fitted mean. Under Poisson-Gaussian
noise all of them are independent and, divided by the fitted standard deviation, standard normal.

Frames that were held back have one contrast more: their mean against that of the frames that were looked at,
independent of every contrast among those. So one frame held back shows what is new in it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import KINDS, LIT
from cannoise_jax.signatures.remembered import remembered


class Answers(NamedTuple):
    """What the static part answers to frozen patterns where others were taken out of it, see
    `signatures.answers`.

    mixed: by place, what a pattern of each scaling looks like as those that are told apart, the same in all
    recordings. kept: by axis, what is left of what lines share in this recording [lines]. apart: by scaling,
    pixels that were no part of a map that was taken out. lines: by axis, the pixels that told of lines that
    were taken out and the variance of those of each beside its offset [lines]. finer: by how much less noise
    there is than was known when the first of them was taken out, as a factor of its inverse [h, w]. steadied:
    pixels whose own charge stays, but in whose contrasts its noise is known already. doubt: standard error of
    the variance that the contrasts of a pixel are in units of, over it.
    """

    mixed: Mapping[str, Float[np.ndarray, "k k h w"]] = MappingProxyType({})
    kept: Mapping[str, Float[np.ndarray, "g"]] = MappingProxyType({})
    apart: Mapping[str, Bool[np.ndarray, "h w"]] = MappingProxyType({})
    lines: Mapping[str, tuple[Bool[np.ndarray, "h w"], Float[np.ndarray, "g"]]] = MappingProxyType({})
    finer: Float[np.ndarray, "h w"] | float = 1.0
    steadied: Bool[np.ndarray, "h w"] | bool = False
    doubt: Float[np.ndarray, "h w"] | float = 0.0


class Fields(NamedTuple):
    """One recording, reduced.

    mean, sigma: model mean and temporal standard deviation, DN; signal: mean above black, DN;
    shot: share of shot noise in sigma^2; usable: pixels that are never at a rail.
    contrasts: standardised differences between frames; static: standardised mean residual over the frames
    (None when its mean cannot be modelled); answers: of the static part to what else stays. step: code step,
    DN; number: place of the recording in its set; group: index of the gain setting. before: frames whose
    mean the last contrast is taken from, 0: none. unit: DN of the recording in one of all that is in DN here,
    see `referred`. charged: level of charge that was taken out of the mean, whose noise was not, DN.
    level: share of what whole frames have in common that is left of it in the contrasts.
    """

    name: str
    kind: str
    frames: int
    number: int
    group: int
    exposure_s: float | None
    step: float
    mean: Float[np.ndarray, "h w"]
    signal: Float[np.ndarray, "h w"]
    sigma: Float[np.ndarray, "h w"]
    shot: Float[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    contrasts: Float[np.ndarray, "n h w"]
    static: Float[np.ndarray, "h w"] | None
    clean: Float[np.ndarray, "h w"] | None
    gain: Float[np.ndarray, "4"]
    black: Float[np.ndarray, "4"]
    before: int = 0
    answers: Answers = Answers()
    unit: float = 1.0
    louder: Float[np.ndarray, "h w"] | float = 1.0
    charged: Float[np.ndarray, "h w"] | float = 0.0
    level: float = 1.0

    @property
    def lit(self) -> bool:
        """Whether light fell on the sensor."""
        return self.kind in LIT

    @property
    def weight(self) -> Float[np.ndarray, "h w"]:
        """1 / sigma where usable, else 0; DN^-1. Read-only."""
        return _weight(self)

    @property
    def relative(self) -> Float[np.ndarray, "h w"]:
        """signal / sigma where usable, else 0: response of the standardised field to a relative change."""
        return self.usable * self.signal / self.sigma


def referred(field: Fields, unit: float) -> Fields:
    """The field with so many DN of its recording in one of all that is in DN, signals counted from black:
    what comes before the gain of a camera then has one strength at all of its gain settings."""
    by = unit / field.unit
    if by == 1:
        return field
    black = field.black[channel_index(field.mean.shape)].astype(np.float32)
    return field._replace(
        mean=black + (field.mean - black) / np.float32(by),
        signal=field.signal / np.float32(by),
        sigma=field.sigma / np.float32(by),
        charged=np.asarray(field.charged, np.float32) / np.float32(by),
        step=field.step / by,
        gain=field.gain / by,
        unit=unit,
    )


def native(field: Fields) -> Fields:
    """The field in DN of its recording."""
    return referred(field, 1.0)


def stays_dn(field: Fields) -> Float[np.ndarray, "h w"]:
    """What the mean of the frames has beyond the one that is expected, DN."""
    assert field.static is not None
    return field.static * field.sigma / np.sqrt(field.frames)


def mean_of_frames(field: Fields) -> Float[np.ndarray, "h w"]:
    """The mean of the frames, DN."""
    return field.mean + stays_dn(field)


@remembered("usable", "sigma")
def _weight(field: Fields) -> Float[np.ndarray, "h w"]:
    out = field.usable / field.sigma
    out.setflags(write=False)
    return out


def longest_exposure(fields: Sequence[Fields]) -> float:
    """Of the recordings, s; one that states none counts as zero."""
    return max((f.exposure_s or 0.0 for f in fields), default=0.0)


def quoted_at(fields: Sequence[Fields], scaling: str) -> float:
    """What a strength is quoted at: of what grows with the exposure the longest, s; of all else one."""
    return longest_exposure(fields) if scaling == "exposure" else 1.0


@lru_cache(maxsize=8)
def channel_index(size: tuple[int, int]) -> np.ndarray:
    """Mosaic site 0..3 of every pixel; read-only."""
    rows, columns = np.indices(size)
    out = 2 * (rows % 2) + columns % 2
    out.setflags(write=False)
    return out


def least_squares(basis: Float[np.ndarray, "n k"], values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "k"]:
    """Coefficients by the normal equations, without a threaded library: long sums, tiny systems."""
    normal = np.einsum("nk,nl->kl", basis, basis)
    return np.linalg.lstsq(normal, np.einsum("nk,n->k", basis, values), rcond=None)[0]


def surfaces(size: tuple[int, int], degree: int, c: int) -> Float[np.ndarray, "n k"]:
    """Products of Legendre polynomials of rows and columns, up to this degree in all, at the pixels of mosaic
    site c in reading order."""
    rows, columns = (a.T for a in legendre(size, degree, c))
    products = [
        np.multiply.outer(rows[i], columns[j]) for i in range(degree + 1) for j in range(degree + 1 - i)
    ]
    return np.stack([p.ravel() for p in products], 1)


def legendre(
    size: tuple[int, int], degree: int, c: int
) -> tuple[Float[np.ndarray, "h k"], Float[np.ndarray, "w k"]]:
    """Legendre polynomials up to a degree at the rows and at the columns of mosaic site c; read-only."""
    rows, columns = (_legendre(degree, n, o) for n, o in zip(size, divmod(c, 2), strict=True))
    return rows, columns


@lru_cache(maxsize=64)
def _legendre(degree: int, size: int, offset: int) -> Float[np.ndarray, "n k"]:
    """Every second place of so many, over the range that all of them span."""
    at = 2 * np.arange(offset, size, 2) / max(size - 1, 1) - 1
    out = np.polynomial.legendre.legvander(at, degree)
    out.setflags(write=False)
    return out


def helmert(frames: int) -> Float[np.ndarray, "n t"]:
    """T - 1 orthonormal contrasts, each orthogonal to a constant."""
    matrix = np.zeros((frames - 1, frames))
    for k in range(1, frames):
        matrix[k - 1, :k] = -1.0
        matrix[k - 1, k] = k
        matrix[k - 1] /= np.sqrt(k * (k + 1.0))
    return matrix


def contrast_matrix(frames: int, before: int = 0) -> Float[np.ndarray, "n t"]:
    """Orthonormal contrasts of frames `[before + frames]`: those among the last `frames`, then, where there
    are frames before, their mean against that of those."""
    inner = np.pad(helmert(frames), ((0, 0), (before, 0)))
    if not before:
        return inner
    outer = np.repeat([-1 / before, 1 / frames], [before, frames])
    return np.concatenate([inner, outer[None] / np.linalg.norm(outer)])


def each_frame(field: Fields, static: bool = True) -> Iterator[Float[np.ndarray, "h w"]]:
    """Standardised residual of every frame: contrasts and, if asked and known, the static part, put together.

    Without the static part the frames are taken from the mean of those before, or from their own, and
    rescaled to unit variance.
    """
    matrix = helmert(field.frames).astype(np.float32)
    shared: np.ndarray = np.zeros(field.mean.shape, np.float32)
    scale = 1.0
    if static and field.static is not None:
        shared = field.static / np.float32(np.sqrt(field.frames))
    elif field.before:
        shared = field.contrasts[-1] * np.float32(np.sqrt(1 / field.frames + 1 / field.before))
        scale = 1 / np.sqrt(1 + 1 / field.before)
    else:
        scale = np.sqrt(field.frames / max(field.frames - 1.0, 1.0))
    for t in range(field.frames):
        inner = np.einsum("n,nij->ij", matrix[:, t], field.contrasts[: field.frames - 1])
        yield (inner + shared) * np.float32(scale)


def frame_fields(field: Fields, static: bool = True) -> Float[np.ndarray, "t h w"]:
    """All residuals of `each_frame` at once."""
    return np.stack(list(each_frame(field, static)))


def stratum(field: Fields) -> int:
    """Number of the recording; for recordings of one frame a negative one for each kind."""
    return field.number if field.frames > 1 else -1 - KINDS.index(field.kind)


def map_contrasts(field: Fields, function) -> Fields:
    """The field with a linear `function` applied to its contrasts and, as one more, to its static part."""
    contrasts = function(field.contrasts) if len(field.contrasts) else field.contrasts  # a single frame
    static = None if field.static is None else function(field.static[None])[0]
    weight = field.weight.astype(np.float32)
    power = float(np.sum(weight**2, dtype=float))
    left = float(np.sum(function(weight[None])[0] * weight, dtype=float)) / power if power else 1.0
    return field._replace(contrasts=contrasts, static=static, level=field.level * left)


def without_pixels(fields: tuple[Fields, ...], out: np.ndarray) -> tuple[Fields, ...]:
    """The fields without some of their pixels."""
    keep = ~out
    return tuple(
        f._replace(
            usable=f.usable & keep,
            contrasts=f.contrasts * keep,
            static=None if f.static is None else f.static * keep,
        )
        for f in fields
    )


def refit(fields: tuple[Fields, ...], before: tuple[Fields, ...] = ()) -> tuple[Fields, ...]:
    """Brings the variance of every channel back to one after something was taken out."""
    out = []
    for f in fields:
        if not len(f.contrasts) or any(f.contrasts is g.contrasts for g in before):
            out.append(f)  # nothing was taken out of the contrasts, so the variance is what it was
            continue
        factor = np.ones(f.mean.shape, np.float32)
        for at in SITES:
            chosen = f.usable[at].ravel()
            if chosen.any():
                values = np.compress(chosen, f.contrasts[:, *at].reshape(len(f.contrasts), -1), 1)
                away = np.abs(values)
                limit = 5 * max(1.0, _median_from(away, 1.0))
                # Of noise far below a step a pixel that changes by a code or two is no outlier.
                weight = f.weight[at].ravel()[chosen]
                limit = max(limit, 2 * f.step * _median_from(weight, limit / max(2 * f.step, 1e-30)))
                power = np.mean(values[away < limit] ** 2)
                if power > 1e-6:  # less is what rounding leaves of a channel that never moves
                    factor[at] = 1 / np.sqrt(power)
        answers = f.answers._replace(finer=f.answers.finer * factor) if f.answers.mixed else f.answers
        out.append(
            f._replace(
                contrasts=f.contrasts * factor,
                sigma=f.sigma / factor,
                static=None if f.static is None else f.static * factor,
                answers=answers,
            )
        )
    return tuple(out)


def _median_from(values: Float[np.ndarray, "..."], least: float) -> float:
    """The median, or 0 where it plainly lies below `least`: to count is much faster than to order."""
    below = 2 * np.count_nonzero(values < np.float32(0.999 * least)) > values.size
    return 0.0 if below else float(median(values))
