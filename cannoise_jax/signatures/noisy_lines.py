"""Rows or columns that have a read noise of their own each, as of converters that are not alike."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.physics.transfer.noise_of_lines import Line, Loudness, Squares, loudness, within_lines
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.charge_noise import by_charge, of_noise, own_charge
from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.least import Law, Seen, grows
from cannoise_jax.signatures.pixels import PEAKED, placed_beyond, read_share, with_factors
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import BY_SHIFT, NO_LAW, Axes, Signature
from cannoise_jax.signatures.squares import READS

_QUIETEST = 0.05
"""Power of the read noise of a line over the mean that it has at least: rounding is known but roughly."""


def _half_contrasts(frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Contrasts among the first half of so many frames, and among the others, from those among all."""
    matrix, middle = helmert(frames), frames // 2
    first, second = helmert(middle) @ matrix[:, :middle].T, helmert(frames - middle) @ matrix[:, middle:].T
    return first.astype(np.float32), second.astype(np.float32)


def _sums(
    chosen: list[Fields], charge: np.ndarray | None, usable: np.ndarray, axis: Line
) -> tuple[Squares, Squares, Squares]:
    """Of all contrasts, of one half of the frames and of the other, once what the pixels of a line that are
    of one mosaic site share in each is taken out: noise of whole lines is another matter. Of recordings of
    few frames every second one is of the other half."""
    totals, freedom = [np.zeros(usable.shape) for _ in range(3)], [0, 0, 0]
    for k, f in enumerate(chosen):
        own = f.contrasts * usable
        for at in SITES:
            own[:, *at] = within_lines(own[:, *at], usable[at], axis)
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
    whole, first, second = (Squares(t, n) for t, n in zip(totals, freedom, strict=True))
    return whole, first, second


def _look(fields: Many, axis: Line) -> Loudness | None:
    """How loud the lines are in the darks; None where too little tells."""
    chosen = darks(fields)
    if not chosen:
        return None
    usable = np.all([f.usable for f in chosen], axis=0)
    whole, *halves = _sums(chosen, own_charge(fields), usable, axis)
    return loudness(whole, (halves[0], halves[1]), usable, axis)


def spread_of_lines(fields: tuple[Fields, ...], *, axis: Line) -> Score[float] | None:
    """A read noise of its own for every line (log-normal): analysis of variance of the noise power of pieces
    of lines. Payload: variance of the lines' logarithms of the noise power."""
    found = _look(fields, axis)
    if found is None:
        return None
    variance, error = found.variance, found.error
    gain = 0.5 * float(
        np.sum(found.logs**2) / error * variance / (error + variance)
        - found.freedom * np.log1p(variance / error)
    )
    # A logarithm of the noise power is twice that of the noise, of which read noise is a share.
    scale = 1 / (2 * read_share(fields))
    width, one_sigma = scale * np.sqrt(variance), scale * np.sqrt(error * np.sqrt(2 / found.freedom))
    spread = float(np.sqrt(np.expm1(width**2)))
    doubt = scale**2 * found.doubt / (2 * max(width, one_sigma))
    largest = np.argsort(-np.abs(found.logs))[:8]
    return Score(
        log_p=found.chance,
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
    found = _look(fields, axis)
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
        simulate=with_factors(parameter),
        place=placed_beyond,
        detectable=BY_SHIFT,
        least=partial(_least, axis=axis),
    )
