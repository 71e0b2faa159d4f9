"""Lines in the spectrum: interference, on the unpacked mosaic."""

from __future__ import annotations

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import fft, ndimage, stats

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.carriers import carrier, raster_frequency, refined
from cannoise_jax.signatures.fields import Fields, frame_fields
from cannoise_jax.signatures.handed import Addition, Asked, Found, Many
from cannoise_jax.signatures.least import (
    one,
    sinusoid,
)
from cannoise_jax.signatures.phasors import rician_fit, without
from cannoise_jax.signatures.score import Score, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    STATIC,
    Axes,
    Signature,
)

_PAD = 2
_LEAST_STAYING = 3
"""Periods in the frame from which on what stays may be called a wave."""
_WINDOW = 10 * _PAD + 1
"""Points of the padded grid that tell the level about a frequency, a side: some 100 of them independent."""
_OWN = 4 * _PAD + 1
"""Points, a side, that a line itself takes."""
_LEAST_REST = 0.01
"""Share of a field's power that is taken to be no wave's, at least."""
_MOST_OF_LINES = 0.5
"""Share of what whole rows or columns share that lies in one line, from which on the line is judged first: a
law of many frequencies would take it for its own."""
_LINES, _NEXT_LINE, _SHARP = 3, 0.3, 10.0
"""Lines that are looked for one after the other, how far another one stands out at least of what is about it,
against the first, and in powers of that: rows that wander slowly have peaks of up to five."""
_COLOURED = 1.5
"""Level from which on noise is taken as coloured: three standard deviations of what white noise shows."""


class Wave(NamedTuple):
    """Cycles a pixel along the columns and the rows, and its share of what whole rows or columns share."""

    fy: float
    fx: float
    of_lines: float


def plane_power(field: Fields, values: np.ndarray) -> np.ndarray:
    """Summed power of 2-D plane waves on the padded frequency grid, mean 1 per field: [pad H, pad W /
    2 + 1]."""
    w = field.weight.astype(np.float32)
    total = np.sum(w.astype(np.float64) ** 2)
    h, wd = w.shape
    out = np.zeros((_PAD * h, _PAD * wd // 2 + 1))
    for x in values:
        y = x * w
        y = y - y.sum() / total * w**2
        own = max(float(np.sum(y.astype(np.float64) ** 2)), 1e-30)
        # Row by row before the rows of zeros are added: of those nothing is to be transformed.
        modes = fft.fft(fft.rfft(y, _PAD * wd, axis=1), _PAD * h, axis=0, overwrite_x=True)
        out += (modes.real**2 + modes.imag**2) / own
    return out


def redrawn(field: Fields) -> Float[np.ndarray, "n h w"]:
    """Fields in which what is new in every frame shows: the contrasts, and of two frames their mean as well,
    which holds half of what two frames know. Frames held back are taken one by one: each holds one wave of
    full strength, a contrast the difference of several."""
    if field.before and field.static is not None:
        return frame_fields(field)
    if field.frames == 2 and field.static is not None and not field.before:
        return np.concatenate([field.contrasts, field.static[None]])
    return field.contrasts


def wave_score(
    fields: tuple[Fields, ...], *, time: str, near: tuple[float, float] | None = None
) -> Score[Wave] | None:
    """One plane wave, of the same frequency in every frame: phase new in each (redrawn) or the same
    (frozen). Fields count by their information, which is the score for a small amplitude. near: frequency
    that other frames tell, as well as they resolve it."""
    chosen = []
    for f in fields if time == "redrawn" else map(as_it_stays, fields):
        values = redrawn(f) if time == "redrawn" else None if f.static is None or f.lit else f.static[None]
        information = float(np.sum(f.weight.astype(np.float64) ** 2))
        if values is not None and len(values) and information > 0:
            chosen.append((f, values, information * (f.frames if time == "frozen" else 1)))
    if not chosen:
        return None
    scale = sum(len(v) * i for _, v, i in chosen)
    power: np.ndarray = np.sum([plane_power(f, v) * (i / scale) for f, v, i in chosen], axis=0)
    h, w = fields[0].mean.shape
    power[0, 0] = 0
    # Less than a period in the frame is a drift, not interference, and its two phases are not independent;
    # of what stays, a few periods are a glow or shading of some shape.
    least = _PAD * (1 if time == "redrawn" else _LEAST_STAYING)
    power[:least, :least] = power[1 - least :, :least] = 0
    # Two pixels to a period, along an axis or both: that is what sites of the mosaic share, no interference.
    middle, last = _PAD * h // 2, power.shape[1] - 1
    for rows in (slice(0, _PAD + 1), slice(-_PAD, None), slice(middle - _PAD, middle + _PAD + 1)):
        power[rows, last - _PAD :] = 0
    power[middle - _PAD : middle + _PAD + 1, : _PAD + 1] = 0
    raw, around = power, _around(power)
    here = 1.0 if near is None else _about(near, power.shape, (h, w))
    where = np.unravel_index(np.argmax(here * power / around), power.shape)
    power, level = power / around, float(around[where])
    # Between two points of the grid a wave shows less of its power.
    fy, fx = refined(
        [v * f.weight.astype(np.float32) for f, v, _ in chosen],
        (float(fft.fftfreq(_PAD * h)[where[0]]), float(where[1] / (_PAD * w))),
    )
    trials = h * w / 2 * _PAD**2  # every point of the padded grid: a bound, whatever the number of fields
    y, x = np.arange(h)[:, None], np.arange(w)[None, :]
    turn = np.exp(-2j * np.pi * (fy * y + fx * x)).astype(np.complex64)
    own, whole, rest = (
        np.concatenate(parts)
        for parts in zip(*(_centred_power(f, v, turn) for f, v, _ in chosen), strict=True)
    )
    weights = np.concatenate([np.full(len(v), i) for _, v, i in chosen]) / level
    fit = rician_fit(float(power[where]), own / level, weights, whole, rest)
    direction = "row" if abs(fx) < 0.6 / w else "column" if abs(fy) < 0.6 / h else "diagonal"
    along, doubt = np.hypot(fx, fy), (0.2 / h, 0.2 / w)
    return Score(
        log_p=sidak(fit.log_p, trials),
        gain=fit.gain,
        penalty=float(np.log(trials)),
        amplitude=fit.amplitude,
        error=fit.error,
        shift=fit.shift,
        power=2,
        parameters={
            "amplitude": (fit.amplitude, "DN", fit.error),
            "frequency_y": (fy, "1/px", doubt[0]),
            "frequency_x": (fx, "1/px", doubt[1]),
        },
        where={"axis": "frequency", "period_px": float(1 / along) if along else None, "direction": direction},
        payload=Wave(fy, fx, _of_lines(raw, (int(where[0]), int(where[1])))),
        spot={"frequency_y": (fy, 2.5 * doubt[0]), "frequency_x": (fx, 2.5 * doubt[1])},
    )


def _of_lines(power: Float[np.ndarray, "h w"], at: tuple[int, int]) -> float:
    """Share of what whole rows or columns share, beyond white noise, that lies in the line at this point and
    in others that stand out as it does: harmonics of one source come together. 0 where it is no wave of rows
    or columns."""
    h, w = power.shape
    if at[1] > 0.6 * _PAD and min(at[0], h - at[0]) > 0.6 * _PAD:
        return 0.0
    shared = power[:, 0] if at[1] <= 0.6 * _PAD else power[0]
    place, length = (at[0], h) if at[1] <= 0.6 * _PAD else (at[1], 2 * (w - 1))
    beyond = np.maximum(shared - 1, 0)
    around, near = (n * ndimage.uniform_filter1d(beyond, n, mode="wrap") for n in (_WINDOW, _OWN))
    sharp = beyond / (1 + np.maximum(around - near, 0) / (_WINDOW - _OWN))
    own = _line(shared.size, place, length)
    for _ in range(_LINES - 1):
        left = np.where(own, 0, sharp)
        other = int(np.argmax(left))
        if left[other] < max(_NEXT_LINE * sharp[place], _SHARP):
            break
        own |= _line(shared.size, other, length)
    return float(beyond[own].sum() / max(beyond.sum(), 1e-30))


def _line(size: int, place: int, length: int) -> Bool[np.ndarray, "n"]:
    """Points of the padded grid that a line and its mirror image take."""
    near = np.arange(size)
    out = np.zeros(size, bool)
    for middle in (place, length - place):
        out |= np.abs((near - middle + length / 2) % length - length / 2) <= 2 * _PAD
    return out


def _around(power: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Level of the power about every frequency where it is well above that of white noise, else 1: a line
    stands out of what is about it, noise that is stronger at low frequencies does not."""

    def sums(values: np.ndarray, side: int) -> np.ndarray:
        return side**2 * ndimage.uniform_filter(values, side, mode=("wrap", "nearest"))

    seen = (power > 0).astype(float)
    number = sums(seen, _WINDOW) - sums(seen, _OWN)
    level = (sums(power, _WINDOW) - sums(power, _OWN)) / np.maximum(number, 1.0)
    return np.where(level > _COLOURED, level, 1.0)


def _about(near: tuple[float, float], grid: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Points of the padded frequency grid that frames of this size do not tell from a frequency."""
    apart_y = np.abs((fft.fftfreq(grid[0]) - near[0] + 0.5) % 1 - 0.5)[:, None]
    apart_x = np.abs(np.arange(grid[1]) / (_PAD * size[1]) - near[1])[None, :]
    return (apart_y < 0.75 / size[0]) & (apart_x < 0.75 / size[1])


def _centred_power(
    field: Fields, values: np.ndarray, turn: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of each field the power at one frequency, mean 1 under the null; the field's own power that it was
    divided by, over that of the modelled noise; and what is left of that without the wave."""
    w = field.weight.astype(np.float32)
    total = float(np.sum(w.astype(np.float64) ** 2))
    weighted = values * w
    level = np.einsum("nij->n", weighted) / total
    centred = weighted - level[:, None, None] * w**2
    own = np.maximum(np.einsum("nij,nij->n", centred, centred, dtype=np.float64), 1e-30)
    power = np.abs(np.einsum("nij,ij->n", centred, turn)) ** 2 / own
    of_wave = np.minimum(2 * power / max(np.count_nonzero(w), 1), 1 - _LEAST_REST)
    return power, own / total, own / total * (1 - of_wave)


def wave_absorb(fields: tuple[Fields, ...], score: Score[Wave]) -> tuple[Fields, ...]:
    """Projects the wave out of every field, and its near neighbours on the frequency grid; not the mean of a
    field, which is no wave's."""
    fy, fx = score.payload.fy, score.payload.fx
    waves = _neighbours(fy, fx, fields[0].mean.shape)
    out = []
    for f in fields:
        weight = f.weight.ravel().astype(np.float64)
        total = max(float(np.sum(weight**2)), 1e-30)
        level = waves @ weight**2 / total
        out.append(without(f, (waves - level[:, None]) * weight))
    return tuple(out)


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


def wave_map(fields: Many, fy: float, fx: float) -> np.ndarray | None:
    """The frozen plane wave of cycles per pixel (fy, fx) in the darks, of peak 1, with its phase `[H, W]`."""
    dark = [as_it_stays(f) for f in fields if f.static is not None and not f.lit]
    if not dark:
        return None
    y, x = np.indices(dark[0].mean.shape)
    phase = 2 * np.pi * (fy * y + fx * x)
    total = sum(
        complex(np.sum(f.static * f.weight * np.exp(-1j * phase))) * np.sqrt(f.frames)
        for f in dark
        if f.static is not None
    )
    return np.cos(phase + np.angle(total))


def wave_detectable(asked: Asked, score: Score, mechanism: str) -> float:
    """A wave whose phase is new in every frame is found where the mean power of all frames, by their
    information, exceeds what the strongest of all frequencies tried has by chance: a gamma law."""
    each = [
        (float(np.sum(f.weight.astype(np.float64) ** 2)), f.contrasts)
        for fields in asked.looks
        for f in fields
    ]
    # Between two points of the padded grid of frequencies a wave shows less of its power.
    shown = float(np.mean(np.sinc(np.linspace(0, 0.25, 101)) ** 2)) ** 2
    information = np.array([i * shown for i, contrasts in each for _ in contrasts])
    tried = 2 * asked.looks[0][0].mean.size
    p = np.exp(asked.log_p) * asked.share / tried
    shape = float(np.sum(information) ** 2 / np.sum(information**2))
    excess = (float(stats.gamma.isf(p, shape)) - shape) / np.sqrt(shape)
    return float(np.sqrt(4 * excess / np.sqrt(np.sum(information**2))))


def interference(
    time: Literal["redrawn", "frozen"],
    *,
    name: str,
    parameter: str,
    lines: tuple[str, ...] = (),
    after: str = "",
) -> Signature:
    """A plane wave: of a new phase in every frame, or of one that stays. lines: signatures of rows and
    columns, before which a wave that is most of what these share is judged. A lesser one stands out only of
    noise of lines that is known; taken out with that it would be too weak, and their law another one. after:
    the wave beside which this one is looked for."""
    redrawn_too = time == "redrawn"
    point = Point("readout", "signal", "raster", time, spectrum="sinusoid")

    def score(fields: Many, near: tuple[float, float] | None = None) -> Score | None:
        return wave_score(fields, time=time, near=near)

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        return wave_map(fields, score.parameters["frequency_y"][0], score.parameters["frequency_x"][0])

    def added(found: Found, amplitude: str) -> Addition:
        fy, fx = (found.score.parameters[name][0] for name in ("frequency_y", "frequency_x"))
        if redrawn_too:
            over, frequency = carrier(fy, fx, found.size)
        else:
            over, frequency = "raster", raster_frequency(fy, fx, found.size[1])
        maps = {} if found.pattern is None else {"field": as_map(found.pattern)}
        values = {amplitude: found.score.amplitude, "frequency": frequency}
        return Addition(values, maps, point=dataclasses.replace(point, over=over))

    def simulate(found: Found) -> Addition:
        more = added(found, parameter)
        usual = redrawn_too and more.point == point
        return more._replace(point=None) if usual else more

    def place(found: Found) -> Addition:
        return added(found, amplitude_name(point))

    return Signature(
        name=name,
        kin="wave",
        axes=Axes("readout", "raster", time, "additive", "sinusoid"),
        # Of two frames their mean tells of what is new in each as well.
        reads=CONTRASTS | STATIC if redrawn_too else STATIC,
        score=score,
        again=lambda fields, found: score(fields, near=(found.payload.fy, found.payload.fx)),
        absorb=wave_absorb,
        covers=COVERS_NOTHING,
        predict=NO_LAW,
        pattern=NO_PATTERN if redrawn_too else pattern,
        simulate=simulate,
        place=place,
        detectable=wave_detectable if redrawn_too else BY_SHIFT,
        decides=redrawn_too,
        before=lambda score: lines if score.payload.of_lines > _MOST_OF_LINES else (),
        found_in=lines,
        after=after,
        least=(lambda sets: sinusoid(sets, one)) if redrawn_too else NO_CLOSED_FORM,
    )
