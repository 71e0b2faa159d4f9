"""A pattern of pixels that repeats every few rows and columns of a frame and is another one, or lies
elsewhere, in the next frame: of a converter or multiplexer whose small tile starts anywhere.

The contrasts of the darks are folded, each by itself. Of what repeats every p rows and q columns all power
lies at the frequencies k/p and l/q, so that it would be taken for many waves: of interference it is in one of
them, or in a few harmonics. What rows and columns share, and those of one parity, is taken out first, and the
colour of the noise is told by the frequencies about each. The power of a fold is the sum of the covariance at
all lags of whole periods.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft, ndimage

from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.bank import without_lines
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.repeats import LONGEST, SHORTEST, TILES, folded, free, repeated
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, chi2_log_sf, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    Axes,
    Signature,
)

_AROUND = 11
"""Frequencies, a side, that tell the level of the noise about one."""
_LINE = 2.0
"""Times the level about it, up to which a frequency tells that."""
_STANDS_OUT = 1.25
"""Power of a value of the fold, in that of others, from which on it is no error of that level."""
_HARMONICS, _BESIDE_WAVES = 3, 0.15
"""Frequencies of the fold that interference may have, and the share of what repeats that is left beside them
at least."""
_FAR = 4.0
"""Standard deviations at which a pixel is cut."""


class Periods(NamedTuple):
    """Rows and columns after which it repeats."""

    rows: int
    columns: int


class _Seen(NamedTuple):
    """Contrasts of the darks, white and without what lines share, `[n, h, w]`, and the mean of 1 / sigma^2
    over their pixels, DN^-2."""

    values: Float[np.ndarray, "n h w"]
    information: float


def _of_darks(fields: Many) -> _Seen | None:
    """None where no two darks of a recording show what is new in each."""
    darks = [f for f in fields if f.kind in DARK and len(f.contrasts) and f.usable.any()]
    if not darks:
        return None
    every = np.concatenate([np.clip(f.contrasts, -_FAR, _FAR) * f.usable for f in darks])
    waves = fft.rfft2(np.stack([without_lines(z) for z in every]).astype(np.float32))
    power = np.mean(waves.real**2 + waves.imag**2, 0)
    if not power.any():
        return None
    level = ndimage.uniform_filter(power, _AROUND, mode=("wrap", "mirror"))
    # A line is none of the level about it.
    level = ndimage.uniform_filter(np.minimum(power, _LINE * level), _AROUND, mode=("wrap", "mirror"))
    white = fft.irfft2(waves / np.sqrt(np.maximum(level, 0.05 * float(level.mean()))), every.shape[1:])
    number = [len(f.contrasts) for f in darks]
    told = [float(np.mean(f.weight.astype(np.float64) ** 2)) for f in darks]
    return _Seen(white, float(np.average(told, weights=number)))


def _ratios(seen: _Seen) -> dict[Periods, float]:
    """Power of a value of every fold that the frame holds often enough, in that of white noise."""
    h, w = seen.values.shape[1:]
    power = sum(np.abs(fft.rfft2(z, (2 * h, 2 * w))) ** 2 for z in seen.values)
    lags = fft.irfft2(power, (2 * h, 2 * w))
    out = {}
    for p in range(SHORTEST, min(LONGEST, h // TILES) + 1):
        down = lags[p * np.arange(-((h - 1) // p), (h - 1) // p + 1)]
        for q in range(SHORTEST, min(LONGEST, w // TILES) + 1):
            both = float(down[:, q * np.arange(-((w - 1) // q), (w - 1) // q + 1)].sum())
            out[Periods(p, q)] = both * p * q / (float(lags[0, 0]) * free(p) * free(q))
    return out


def _beside_waves(values: Float[np.ndarray, "n h w"], at: Periods, level: float) -> float:
    """Share of what repeats that lies at other frequencies than the strongest few."""
    fold = np.stack([folded(folded(z, at.rows).T, at.columns).T for z in values])
    power = np.sum(np.abs(fft.fft2(fold)) ** 2, 0)
    beyond = np.sort((power - level * float(np.sum(values**2)))[1:, 1:].ravel())[::-1]
    return 1 - float(beyond[: 2 * _HARMONICS].sum()) / max(float(beyond.sum()), 1e-30)


def _scored(seen: _Seen, at: Periods, ratios: dict[Periods, float], trials: int) -> Score[Periods]:
    level = float(median(list(ratios.values())))
    frames, pixels = len(seen.values), seen.values[0].size
    ratio, number = ratios[at] / level, free(at.rows) * free(at.columns) * frames
    left = ratio < _STANDS_OUT or _beside_waves(seen.values, at, level) < _BESIDE_WAVES
    # Of every value of the fold the noise, DN^2, and what its mean square is beyond that.
    noise = at.rows * at.columns / (pixels * seen.information)
    variance, scatter = noise * (ratio - 1), noise * float(np.sqrt(2 / number))
    shift = float(np.sqrt(scatter))
    amplitude = float(np.sqrt(max(variance, 0.0)))
    error = ratio * scatter / (2 * max(amplitude, shift))
    return Score(
        log_p=0.0 if left else sidak(chi2_log_sf(ratio * number, number), trials),
        gain=0.0 if left else 0.5 * number * max(ratio - 1 - float(np.log(ratio)), 0.0),
        penalty=ONE_PARAMETER + float(np.log(trials)),
        amplitude=amplitude,
        error=error,
        shift=shift,
        power=2,
        parameters={
            "sigma": (amplitude, "DN", error),
            "period_y": (float(at.rows), "px", 0.0),
            "period_x": (float(at.columns), "px", 0.0),
        },
        where={"axis": "pixel", "index": None},
        payload=at,
        spot={"period_y": (float(at.rows), 0.5), "period_x": (float(at.columns), 0.5)},
    )


def moved_score(fields: Many) -> Score[Periods] | None:
    """What repeats within single darks and is new in each, of the periods of most evidence. Amplitude: rms
    over a frame."""
    seen = _of_darks(fields)
    ratios = {} if seen is None else _ratios(seen)
    if seen is None or not ratios:
        return None
    best = max(ratios, key=lambda at: (ratios[at] - 1) * np.sqrt(free(at.rows) * free(at.columns)))
    return _scored(seen, best, ratios, len(ratios))


def moved_again(fields: Many, found: Score[Periods]) -> Score[Periods] | None:
    """What repeats after as many rows and columns on other frames."""
    seen = _of_darks(fields)
    ratios = {} if seen is None else _ratios(seen)
    return _scored(seen, found.payload, ratios, 1) if seen is not None and found.payload in ratios else None


def _less(field: Fields, values: Float[np.ndarray, "h w"], at: Periods) -> Float[np.ndarray, "h w"]:
    """Without what repeats in it."""
    weight = field.weight.astype(np.float64)
    score, information = (
        folded(folded(v, at.rows).T, at.columns).T for v in (values * weight, weight**2)
    )  # fmt: skip
    return (values - weight * repeated(score / np.maximum(information, 1e-30), values.shape)).astype(
        np.float32
    )


def moved_absorb(fields: Many, score: Score[Periods]) -> Many:
    """Takes what repeats out of every contrast, and of what stays what few frames leave of it."""
    out = []
    for f in fields:
        contrasts = (
            np.stack([_less(f, z, score.payload) for z in f.contrasts]) if len(f.contrasts) else f.contrasts
        )
        static = None if f.static is None else _less(f, f.static, score.payload)
        out.append(f._replace(contrasts=contrasts, static=static))
    return tuple(out)


def moving(*, name: str, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """A pattern that repeats within a frame and is new in every frame. before: signatures of waves, lines,
    areas and neighbours, which it would be cut into."""

    def kind(score: Score[Periods]) -> str:
        return f"a pattern that repeats every {score.payload.rows} rows and {score.payload.columns} columns"

    return Signature(
        name=name,
        kin="repeats",
        axes=Axes("readout", "pixel", "redrawn", "additive", "periodic"),
        reads=CONTRASTS,
        score=moved_score,
        again=moved_again,
        absorb=moved_absorb,
        covers=covers,
        before=lambda score: before,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=NOT_SIMULATED,
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        kind=kind,
    )
