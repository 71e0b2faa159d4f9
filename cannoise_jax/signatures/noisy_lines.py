"""Rows or columns that have a read noise of their own each, as of converters that are not alike."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.charge_noise import by_charge, of_noise, own_charge
from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.least import Law, Seen, grows
from cannoise_jax.signatures.line_sums import Line
from cannoise_jax.signatures.pixels import PEAKED, placed_beyond, read_share
from cannoise_jax.signatures.score import Score, chi2_log_sf
from cannoise_jax.signatures.signature import BY_SHIFT, NO_LAW, Axes, Signature
from cannoise_jax.signatures.squares import READS

_PARTS = 8
"""Pieces of a line, whose scatter says how well its noise is known: whatever the pixels' own noise is, and
however neighbours are alike."""
_FEWEST = 8
"""Pixels of a piece, and lines beyond the smooth terms, that say anything."""
_SMOOTH = 6
"""Waves over all lines that are no part of it: dark charge, and light, may make noise that grows smoothly."""
_CAPPED = 1e-3
"""Chance of a pixel whose sum of squares counts as no more than this: those that blink are no part of it."""


_LOUDEST = 3.0
"""Noise power of a line over that of most, up to which it is told in full."""
_QUIETEST = 0.05
"""Power of the read noise of a line over the mean that it has at least: rounding is known but roughly."""
_PLAIN = 2.0
"""Standard errors from which on lines are taken to be louder in some frames than in others."""


class Loudness(NamedTuple):
    """Logarithm of the noise power of every line beyond what is smooth over the lines, and of its error the
    variance. known: lines of pixels enough; freedom: of the lines, once what is smooth is taken out."""

    logs: Float[np.ndarray, "k"]
    error: float
    known: Bool[np.ndarray, "k"]
    freedom: int
    pieces: int

    @property
    def variance(self) -> float:
        """Of the true logarithms."""
        return max(float(np.sum(self.logs**2)) / self.freedom - self.error, 0.0)


class _Sums(NamedTuple):
    """Sums of squares of every pixel over some contrasts `[k, n]`, and how many those are."""

    squares: Float[np.ndarray, "k n"]
    freedom: int


def _half_contrasts(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Contrasts among the first half of so many frames, and among the others, from those among all."""
    matrix, middle = helmert(frames), frames // 2
    first, second = helmert(middle) @ matrix[:, :middle].T, helmert(frames - middle) @ matrix[:, middle:].T
    return first.astype(np.float32), second.astype(np.float32)


def _sums(
    chosen: list[Fields], charge: np.ndarray | None, usable: np.ndarray, axis: Line
) -> tuple[_Sums, _Sums, _Sums]:
    """Of all contrasts, of one half of the frames and of the other, once what the pixels of a line that are
    of one mosaic site share in each is taken out: noise of whole lines is another matter. Of recordings of
    few frames every second one is of the other half."""
    totals, freedom = [np.zeros(usable.shape) for _ in range(3)], [0, 0, 0]
    for k, f in enumerate(chosen):
        own = f.contrasts * usable
        for at in SITES:
            own[:, *at] = _within_lines(own[:, *at], usable[at], axis)
        parts = {0: own}
        if f.frames < 4:
            parts[1 + k % 2] = own
        else:
            among = own[: f.frames - 1]
            for half, matrix in enumerate(_half_contrasts(f.frames), 1):
                parts[half] = np.einsum("kn,nij->kij", matrix, among)
        level = by_charge(f, charge)
        for part, values in parts.items():
            totals[part] += np.einsum("nij,nij->ij", values, values) / level
            freedom[part] += len(values)
    whole, first, second = (
        _Sums(t if axis == "row" else t.T, n) for t, n in zip(totals, freedom, strict=True)
    )
    return whole, first, second


def _within_lines(
    values: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"], axis: Line
) -> np.ndarray:
    """Less what rows and columns share, to which no pixel adds more than three standard deviations: one far
    out would make its whole line louder. Twice, for lines that share more than that."""
    for along in (1, 2, 1, 2) if axis == "row" else (2, 1, 2, 1):
        counts = np.maximum(usable.sum(along - 1, keepdims=True), 1)
        values = (values - np.clip(values, -3, 3).sum(along, keepdims=True) / counts) * usable
    return values


def _bounded(power: np.ndarray, usable: np.ndarray, freedom: int) -> np.ndarray:
    """The powers `[k, n]`, none more than `_LOUDEST` times what chance gives once in a thousand: one
    limit for all lines, since one of their own would be of what their pixels share."""
    law = stats.chi2(freedom, scale=1 / freedom)
    typical = float(np.median(power[usable])) / float(law.median())
    return np.minimum(power, _LOUDEST * float(law.isf(_CAPPED)) * typical)


class _Parted(NamedTuple):
    """Logarithms of the noise power of lines, beyond what is smooth over them, mean squares of those and of
    what pieces of lines differ by beside, each per piece."""

    rough: Float[np.ndarray, "k"]
    of_lines: float
    of_pieces: float


def _parted(logs: Float[np.ndarray, "k s"], terms: np.ndarray) -> _Parted:
    """Two-way analysis of variance of pieces of lines."""
    lines, pieces = logs.shape
    means = logs.mean(1)
    rough = means - terms @ np.linalg.lstsq(terms, means, rcond=None)[0]
    apart = logs - means[:, None] - logs.mean(0) + logs.mean()
    return _Parted(
        rough,
        float(np.sum(rough**2)) / (lines - terms.shape[1]),
        float(np.sum(apart**2)) / ((lines - 1) * (pieces - 1)) / pieces,
    )


def loudness(fields: Many, axis: Line) -> Loudness | None:
    """How loud the lines are in the darks; None where too little tells."""
    chosen = darks(fields)
    if sum(len(f.contrasts) for f in chosen) < 2:
        return None
    usable = np.all([f.usable for f in chosen], axis=0)
    whole, *halves = _sums(chosen, own_charge(fields), usable, axis)
    usable = usable if axis == "row" else usable.T
    pieces = min(_PARTS, usable.shape[1] // (2 * _FEWEST))
    if pieces < 2:
        return None
    starts = np.linspace(0, usable.shape[1], pieces + 1).astype(int)[:-1]
    count = np.add.reduceat(usable.astype(float), starts, axis=1)
    known = count.min(1) >= _FEWEST
    terms = _smooth_terms(np.flatnonzero(known), len(known))
    spare = int(known.sum()) - terms.shape[1]
    if spare < _FEWEST:
        return None

    def logs(sums: _Sums) -> np.ndarray:
        power = _bounded(sums.squares / max(sums.freedom, 1), usable, max(sums.freedom, 1))
        mean = np.add.reduceat(power * usable, starts, axis=1)[known] / count[known]
        return np.log(np.maximum(mean, 1e-6))

    found = _parted(logs(whole), terms)
    # What is louder in some frames alone is no noise of a line that stays.
    moving = 0.0
    if all(h.freedom for h in halves):
        turns = _parted((logs(halves[0]) - logs(halves[1])) / 2, terms)
        beyond = turns.of_lines - turns.of_pieces
        moving = beyond if beyond > _PLAIN * turns.of_pieces * np.sqrt(2 / spare) else 0.0
    rough = np.zeros(len(known))
    rough[known] = found.rough
    return Loudness(rough, max(found.of_pieces + moving, 1e-12), known, spare, pieces)


def _smooth_terms(places: np.ndarray, lines: int) -> Float[np.ndarray, "n k"]:
    """Waves over the lines, and every second one: the baseline has a noise of every mosaic site."""
    waves = np.cos(np.pi * np.outer((places + 0.5) / lines, np.arange(_SMOOTH + 1)))
    return np.column_stack([waves, (-1.0) ** places])


def spread_of_lines(fields: tuple[Fields, ...], *, axis: Line) -> Score[float] | None:
    """A read noise of its own for every line (log-normal): analysis of variance of the noise power of pieces
    of lines. Payload: variance of the lines' logarithms of the noise power."""
    found = loudness(fields, axis)
    if found is None:
        return None
    ratio = float(np.sum(found.logs**2)) / found.freedom / found.error
    tail = float(stats.f.sf(ratio, found.freedom, found.freedom * (found.pieces - 1)))
    log_p = float(np.log(tail)) if tail > 1e-200 else chi2_log_sf(ratio * found.freedom, found.freedom)
    variance, error = found.variance, found.error
    gain = 0.5 * float(
        np.sum(found.logs**2) / error * variance / (error + variance)
        - found.freedom * np.log1p(variance / error)
    )
    # A logarithm of the noise power is twice that of the noise, of which read noise is a share.
    scale = 1 / (2 * read_share(fields))
    width, one_sigma = scale * np.sqrt(variance), scale * np.sqrt(error * np.sqrt(2 / found.freedom))
    spread = float(np.sqrt(np.expm1(width**2)))
    doubt = scale**2 * (variance + error) * np.sqrt(2 / found.freedom) / (2 * max(width, one_sigma))
    largest = np.argsort(-np.abs(found.logs))[:8]
    return Score(
        log_p=min(log_p, 0.0),
        payload=variance,
        gain=max(gain, 0.0),
        penalty=0.5 * float(np.log(found.freedom)),
        amplitude=spread,
        error=float(doubt),
        shift=float(one_sigma),
        power=2,
        parameters={"spread": (spread, "1", float(doubt))},
        where={"axis": axis, "index": sorted(int(i) for i in largest)},
    )


def _read_power(
    fields: Many, axis: Line, variance: float, rng: np.random.Generator | None = None
) -> np.ndarray:
    """Power of the read noise of every line over the mean: what is known of it, or with `rng` a draw."""
    found = loudness(fields, axis)
    logs = np.zeros(fields[0].mean.shape[0 if axis == "row" else 1])
    if found is not None and variance > 0:
        share = np.where(found.known, variance / (variance + found.error), 0.0)
        logs = share * found.logs
        if rng is not None:
            logs = logs + np.sqrt(variance * (1 - share)) * rng.standard_normal(logs.shape)
    power = np.exp(logs)
    power = np.maximum(1 + (power / power.mean() - 1) / read_share(fields), _QUIETEST)
    return (power / power.mean()).reshape((-1, 1) if axis == "row" else (1, -1))


def without_spread(fields: tuple[Fields, ...], score: Score[float], *, axis: Line) -> tuple[Fields, ...]:
    """The fields in units of the noise that each line has."""
    power = _read_power(fields, axis, score.payload)

    def own(f: Fields) -> Fields:
        read = np.clip(1 - f.shot - f.step**2 / 12 / f.sigma**2, 0, 1)
        square = (1 + read * (power - 1)).astype(np.float32)
        return of_noise(f, np.sqrt(square), f.shot / square) if len(f.contrasts) else f

    return tuple(own(f) for f in fields)


def _least(sets: tuple[Seen, ...], axis: Line) -> Law:
    """Spread a of the read noise over lines: a relative variance 2 g a, g normal, against the information of
    every line, less that of its single pixels, which are no part of what lines share."""
    across = 1 if axis == "row" else 0
    information = sum(s.frames * s.read**2 / 2 for s in sets)
    of_lines = np.sum(information, axis=across)
    return grows(16 * (float(np.sum(of_lines**2)) - float(np.sum(np.square(information)))) / 2, 2)


def own_noise(
    axis: Line, *, name: str, parameter: str, of_pixels: tuple[str, ...], smooth: tuple[str, ...] = ()
) -> Signature:
    """A read noise of its own for every row or column. of_pixels: signatures of the noise of single pixels,
    which hold it as well, each pixel by itself. smooth: those that take the counts of codes to be as smooth
    as those of normal noise."""

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray:
        return np.sqrt(_read_power(fields, axis, score.payload, rng))

    def simulate(found: Found) -> Addition:
        maps = {} if found.pattern is None else {"factor": as_map(found.pattern)}
        return Addition({parameter: found.score.amplitude}, maps)

    return Signature(
        name=name,
        axes=Axes("readout", axis, "frozen", "additive", "log-normal variance"),
        reads=READS,
        score=partial(spread_of_lines, axis=axis),
        absorb=partial(without_spread, axis=axis),
        covers=(),
        found_in=of_pixels,
        before=lambda score: of_pixels,
        hides=lambda score: smooth if score.amplitude > PEAKED else (),
        predict=NO_LAW,
        pattern=pattern,
        simulate=simulate,
        place=placed_beyond,
        detectable=BY_SHIFT,
        least=partial(_least, axis=axis),
    )
