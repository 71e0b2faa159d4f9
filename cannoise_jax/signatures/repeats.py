"""A pattern of pixels that stays and repeats every few rows and columns: of a converter, a multiplexer or a
correction that works through small tiles.

The darks are folded: pixels that lie whole periods apart are averaged. What rows, columns, and columns and
rows of one parity share is taken out first, so that their own patterns fold to nothing; what is left of the
fold varies along both sides of the tile. Of a map of pixels that have nothing to do with each other a fold
keeps as many parts of the power as it has values. The colour of a map is told by all other folds.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import placed
from cannoise_jax.signatures.carriers import refined
from cannoise_jax.signatures.group_sums import LineSums
from cannoise_jax.signatures.handed import Many, Predicted
from cannoise_jax.signatures.means import less_offsets
from cannoise_jax.signatures.patterns import beside_lines, pixel_sums
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, chi2_log_sf, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NOT_SIMULATED,
    OFFSETS,
    STATIC,
    Axes,
    Signature,
)

SHORTEST, LONGEST = 3, 32
"""Pixels of a period. Every second row or column is a parity's, which the mosaic and the electronics of lines
share."""
TILES = 4
"""Periods in the frame, at least, along each side."""
_FAR = 4.0
"""Robust standard deviations at which a pixel is cut: hot ones would stand for their place in the tile."""
_STANDS_OUT = 3.0
"""Power of a value of the fold, in that of others, from which on it is more than the colour of a map: of maps
whose neighbours correlate by 0.2 frequencies differ by up to 2.3."""
_BESIDE_A_WAVE = 0.15
"""Share of what repeats that one sinusoid, of whatever frequency, does not explain, below which it is left to
interference."""
_PAD = 2
"""Frequencies from which a sinusoid is refined are so many times closer than those of the frame."""


class Tile(NamedTuple):
    """The pattern of one tile, DN, mean 0, and the variance that the darks leave open."""

    values: Float[np.ndarray, "p q"]
    doubt: Float[np.ndarray, "p q"]

    def image(self, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """The pattern of every pixel."""
        return repeated(self.values, size)


class _Folded(NamedTuple):
    """A fold: power beside lines, in that of pixels, and how many values that is of."""

    rows: int
    columns: int
    power: float
    number: int

    def gain(self, level: float) -> float:
        """Nats that values of more variance gain on those of the level of all folds."""
        ratio = max(self.power / level / self.number, 1.0)
        return 0.5 * self.number * (ratio - 1 - float(np.log(ratio)))


def repeated(values: Float[np.ndarray, "p q"], size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    rows, columns = (np.arange(n) % k for n, k in zip(size, values.shape, strict=True))
    return values[rows[:, None], columns]


def folded(values: Float[np.ndarray, "h w"], period: int) -> Float[np.ndarray, "p w"]:
    """Sums over rows that lie whole periods apart."""
    short = -len(values) % period
    return np.pad(values, ((0, short), (0, 0))).reshape(-1, period, values.shape[1]).sum(0)


def free(period: int) -> int:
    """Values along one side of a tile beside their mean and what even ones have apart from odd ones."""
    return period - 1 - (period % 2 == 0)


def _without_turns(z: Float[np.ndarray, "h w"], root: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Less what columns share in rows of one parity, and rows in columns of one parity."""
    out = z.copy()
    for at in (np.s_[::2], np.s_[1::2]):
        for part, weight in ((out[at], root[at]), (out.T[at], root.T[at])):
            shared = np.sum(part * weight, 0) / np.maximum(np.sum(weight**2, 0), 1e-30)
            part -= weight * shared
    return out


def _cut(z: Float[np.ndarray, "h w"], seen: np.ndarray) -> Float[np.ndarray, "h w"]:
    limit = _FAR * max(robust_std(z[seen], 0), 1.0)
    return np.clip(z, -limit, limit)


def _beside_lines(sums: LineSums) -> tuple[Float[np.ndarray, "h w"], float]:
    """What pixels score beside all that lines share, far ones cut, and its mean square."""
    root = np.sqrt(sums.information)
    seen = root > 0
    z = _without_turns(_cut(beside_lines(sums), seen), root)
    return z, float(np.mean(z[seen] ** 2))


def _folds(sums: LineSums) -> Iterator[_Folded]:
    """Folds of all periods that the frame holds often enough."""
    root = np.sqrt(sums.information)
    z, scale = _beside_lines(sums)
    periods = [range(SHORTEST, min(LONGEST, n // TILES) + 1) for n in z.shape]
    for p in periods[0] if scale > 0 else ():
        score, information = folded(z * root, p), folded(sums.information, p)
        for q in periods[1]:
            own, weight = folded(score.T, q), folded(information.T, q)
            power = float(np.sum(own**2 / np.maximum(weight, 1e-30))) / scale
            yield _Folded(p, q, power, free(p) * free(q))


def _tile(sums: LineSums, periods: tuple[int, int]) -> Tile:
    """The whole pattern of these periods, with what lines have of it."""
    root = np.sqrt(sums.information)
    seen = root > 0
    level = float(sums.score.sum() / sums.information.sum())
    z = _cut(np.where(seen, sums.score / np.maximum(root, 1e-15) - root * level, 0.0), seen)
    score, information = (folded(folded(v, periods[0]).T, periods[1]).T for v in (z * root, root**2))
    values = score / np.maximum(information, 1e-30)
    scale = float(np.mean((z - root * repeated(values, z.shape))[seen] ** 2))
    return Tile(values - values.mean(), scale / np.maximum(information, 1e-30))


def _one_wave(sums: LineSums) -> float:
    """Power of the strongest sinusoid, in that of a pixel."""
    z, scale = _beside_lines(sums)
    h, w = (_PAD * n for n in z.shape)
    i, j = divmod(int(np.argmax(np.abs(fft.rfft2(z.astype(np.float32), (h, w))))), w // 2 + 1)
    fy, fx = refined([z[None].astype(np.float32)], (float(fft.fftfreq(h)[i]), j / w))
    y, x = (np.exp(-2j * np.pi * f * np.arange(n)) for f, n in zip((fy, fx), z.shape, strict=True))
    return 2 * float(np.abs(y @ z @ x) ** 2) / np.count_nonzero(sums.information) / scale


def _told(fields: Many) -> LineSums | None:
    sums = pixel_sums(fields, "additive", DARK)
    return None if sums is None or not (sums.information > 0).any() else sums


def _scored(sums: LineSums, fold: _Folded, level: float, trials: int) -> Score[Tile]:
    """level: power of a value of the other folds, in that of pixels."""
    tile, power = _tile(sums, (fold.rows, fold.columns)), fold.power / level
    chance = level * fold.number
    left = power < _STANDS_OUT * fold.number or (
        fold.power - chance - _one_wave(sums) < _BESIDE_A_WAVE * (fold.power - chance)
    )
    noise = float(np.mean(tile.doubt))
    amplitude = float(np.sqrt(max(float(np.mean(tile.values**2)) - noise, 0.0)))
    error = float(np.sqrt(noise / tile.values.size))
    return Score(
        log_p=0.0 if left else sidak(chi2_log_sf(power, fold.number), trials),
        gain=0.0 if left else fold.gain(level),
        penalty=ONE_PARAMETER + float(np.log(trials)),
        amplitude=amplitude,
        error=error,
        shift=float(np.sqrt(noise)) * (2 / tile.values.size) ** 0.25,
        power=2,
        parameters={
            "sigma": (amplitude, "DN", error),
            "period_y": (float(fold.rows), "px", 0.0),
            "period_x": (float(fold.columns), "px", 0.0),
        },
        where={"axis": "pixel", "index": None},
        payload=tile,
        spot={"period_y": (float(fold.rows), 0.5), "period_x": (float(fold.columns), 0.5)},
    )


def repeat_score(fields: Many) -> Score[Tile] | None:
    """What repeats in the darks, of the periods of most evidence. Amplitude: rms over the tile."""
    sums = _told(fields)
    folds = [] if sums is None else list(_folds(sums))
    if sums is None or not folds:
        return None
    level = max(float(median([f.power / f.number for f in folds])), 1.0)
    best = max(folds, key=lambda f: f.gain(level))
    return _scored(sums, best, level, len(folds))


def repeat_again(fields: Many, found: Score[Tile]) -> Score[Tile] | None:
    """The pattern of the same periods on other frames."""
    sums = _told(fields)
    folds = [] if sums is None else list(_folds(sums))
    same = next((f for f in folds if (f.rows, f.columns) == found.payload.values.shape), None)
    if sums is None or same is None:
        return None
    return _scored(sums, same, max(float(median([f.power / f.number for f in folds])), 1.0), 1)


def repeat_absorb(fields: Many, score: Score[Tile]) -> Many:
    """Subtracts the pattern from what stays in every recording."""
    return less_offsets(fields, score.payload.image(fields[0].mean.shape))


def staying(*, name: str, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """A pattern that repeats and stays. before: signatures of lines, waves, areas and maps, which it would be
    cut into."""

    def predict(fields: Many, score: Score[Tile]) -> Predicted | None:
        sums = _told(fields)
        if sums is None:
            return None
        size, tile = fields[0].mean.shape, _tile(sums, score.payload.values.shape)
        return Predicted("additive", tile.image(size), repeated(tile.doubt, size))

    def pattern(fields: Many, score: Score[Tile], rng: np.random.Generator) -> np.ndarray:
        return score.payload.image(fields[0].mean.shape)

    def kind(score: Score[Tile]) -> str:
        rows, columns = score.payload.values.shape
        return f"a pattern that repeats every {rows} rows and {columns} columns"

    return Signature(
        name=name,
        kin="repeats",
        axes=Axes("readout", "pixel", "frozen", "additive", "periodic"),
        reads=STATIC,
        score=repeat_score,
        again=repeat_again,
        absorb=repeat_absorb,
        covers=covers,
        before=lambda score: before,
        predict=predict,
        pattern=pattern,
        simulate=NOT_SIMULATED,
        place=placed(OFFSETS),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        kind=kind,
    )
