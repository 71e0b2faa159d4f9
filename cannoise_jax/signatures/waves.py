"""Lines in the spectrum: interference, on the unpacked mosaic."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy import fft, stats

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.carriers import carrier, refined
from cannoise_jax.signatures.fields import Fields, frame_fields, helmert
from cannoise_jax.signatures.handed import Addition, Asked, Found, Many
from cannoise_jax.signatures.least import (
    one,
    sinusoid,
)
from cannoise_jax.signatures.phasors import about_centre, rician_fit
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
from cannoise_jax.signatures.wave_fields import Wave, centred, taken, turn_of, wave_absorb
from cannoise_jax.signatures.wave_shares import PAD, around, of_all, of_lines

_LEAST_STAYING = 3
"""Periods in the frame from which on what stays may be called a wave."""
_MOST = 0.5
"""Share of what whole rows or columns share, or of all that is alike between pixels, that lies in one line,
from which on the line is judged first: a law of many frequencies would take it for its own."""
_CLEAR = 25.0
"""Power of a wave in a frame, in that of the noise, from which on its phases show where the mean of the
frames was: a fifth of its amplitude is noise then."""
_LEAST_FRAMES = 6
"""Frames of a recording from which on a circle through their phases is held to be theirs."""


_MOST_TAKEN = 8
"""Frequencies that are passed over because a wave of theirs was taken out."""


def plane_power(field: Fields, values: np.ndarray) -> np.ndarray:
    """Summed power of 2-D plane waves on the padded frequency grid, mean 1 per field: [pad H, pad W /
    2 + 1]."""
    w = field.weight.astype(np.float32)
    total = np.sum(w.astype(np.float64) ** 2)
    h, wd = w.shape
    out = np.zeros((PAD * h, PAD * wd // 2 + 1))
    for x in values:
        y = x * w
        y = y - y.sum() / total * w**2
        own = max(float(np.sum(y.astype(np.float64) ** 2)), 1e-30)
        # Row by row before the rows of zeros are added: of those nothing is to be transformed.
        modes = fft.fft(fft.rfft(y, PAD * wd, axis=1), PAD * h, axis=0, overwrite_x=True)
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
    scale, squares = (sum(len(v) * i**k for _, v, i in chosen) for k in (1, 2))
    power: np.ndarray = np.sum([plane_power(f, v) * (i / scale) for f, v, i in chosen], axis=0)
    h, w = fields[0].mean.shape
    power[0, 0] = 0
    # Less than a period in the frame is a drift, not interference, and its two phases are not independent;
    # of what stays, a few periods are a glow or shading of some shape.
    least = PAD * (1 if time == "redrawn" else _LEAST_STAYING)
    power[:least, :least] = power[1 - least :, :least] = 0
    # Two pixels to a period, along an axis or both: that is what sites of the mosaic share, no interference.
    middle, last = PAD * h // 2, power.shape[1] - 1
    for rows in (slice(0, PAD + 1), slice(-PAD, None), slice(middle - PAD, middle + PAD + 1)):
        power[rows, last - PAD :] = 0
    power[middle - PAD : middle + PAD + 1, : PAD + 1] = 0
    raw, level_about = power, around(power)
    power = power / level_about
    here = np.ones(power.shape, bool) if near is None else _about(near, power.shape, (h, w))
    for _ in range(_MOST_TAKEN):
        where = np.unravel_index(np.argmax(here * power), power.shape)
        # Between two points of the grid a wave shows less of its power.
        fy, fx = refined(
            [v * f.weight.astype(np.float32) for f, v, _ in chosen],
            (float(fft.fftfreq(PAD * h)[where[0]]), float(where[1] / (PAD * w))),
        )
        turn = turn_of(fy, fx, (h, w))
        if time == "redrawn" or not taken([f for f, _, _ in chosen], turn):
            break
        here &= ~_about((fy, fx), power.shape, (h, w))
    else:
        return None
    level = float(level_about[where])
    trials = h * w / 2 * PAD**2  # every point of the padded grid: a bound, whatever the number of fields
    told = [centred(f, v, turn) for f, v, _ in chosen]
    own, whole, rest = (np.concatenate(parts) for parts in zip(*told, strict=True))
    weights = np.concatenate([np.full(len(v), i) for _, v, i in chosen]) / level
    fit = rician_fit(float(power[where]), np.abs(own) ** 2 / level, weights, whole, rest)
    if time == "redrawn":
        fit = fit._replace(amplitude=_of_frames(chosen, told, level) or fit.amplitude)
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
        payload=Wave(fy, fx, *_shares(raw, (int(where[0]), int(where[1])), scale**2 / squares)),
        # Of a wave along the rows no frame tells which way it runs down the columns.
        spot={
            "frequency_y": (abs(fy) if direction == "row" else fy, 2.5 * doubt[0]),
            "frequency_x": (fx, 2.5 * doubt[1]),
        },
    )


def _about(near: tuple[float, float], grid: tuple[int, int], size: tuple[int, int]) -> np.ndarray:
    """Points of the padded frequency grid that frames of this size do not tell from a frequency."""
    apart_y = np.abs((fft.fftfreq(grid[0]) - near[0] + 0.5) % 1 - 0.5)[:, None]
    apart_x = np.abs(np.arange(grid[1]) / (PAD * size[1]) - near[1])[None, :]
    return (apart_y < 0.75 / size[0]) & (apart_x < 0.75 / size[1])


def _shares(power: Float[np.ndarray, "h w"], at: tuple[int, int], terms: float) -> tuple[float, float]:
    """Of what lines share, and of all: see `of_lines` and `of_all`. Of a few periods in the frame none of
    all: what varies slowly has most of its power there, whatever it is."""
    h, w = power.shape
    periods = np.hypot(min(at[0], h - at[0]), at[1]) / PAD
    return of_lines(power, at), of_all(power, at, terms) if periods >= _LEAST_STAYING else 0.0


def _of_frames(
    chosen: Sequence[tuple[Fields, np.ndarray, float]], told: Sequence[tuple[np.ndarray, ...]], level: float
) -> float | None:
    """Amplitude, DN, of a wave that is clear in every frame; None of another. A contrast between frames holds
    the difference of several phases, so that its power differs from one to the next; the phasors of frames
    lie on a circle, wherever their mean was."""
    powers, weights = [], []
    for (f, v, information), (own, whole, rest) in zip(chosen, told, strict=True):
        if f.before or f.frames < _LEAST_FRAMES or len(v) != f.frames - 1:
            continue
        seen = own * np.sqrt(whole)
        if np.mean(np.abs(seen) ** 2) > _CLEAR * level * np.mean(rest):
            frames = about_centre(helmert(f.frames).T @ seen)
            powers.append(np.mean(np.abs(frames) ** 2) - level * np.mean(rest))
            weights.append(information)
    if not powers:
        return None
    # Of noise of power 1 a wave of amplitude A has the power A^2 I / 4.
    each = 4 * np.maximum(np.array(powers), 0.0) / np.array(weights)
    return float(np.sqrt(np.average(each, weights=np.array(weights))))


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
    alike: tuple[str, ...] = (),
    after: str = "",
) -> Signature:
    """A plane wave: of a new phase in every frame, or of one that stays. lines: signatures of rows and
    columns, before which a wave that is most of what these share is judged. A lesser one stands out only of
    noise of lines that is known; taken out with that it would be too weak, and their law another one. alike:
    signatures of what pixels have alike in each frame in other ways, before which a wave that is most of
    that is judged. after: the wave beside which this one is looked for."""
    redrawn_too = time == "redrawn"
    point = Point("readout", "signal", "raster", time, spectrum="sinusoid")

    def score(fields: Many, near: tuple[float, float] | None = None) -> Score | None:
        return wave_score(fields, time=time, near=near)

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        return wave_map(fields, score.parameters["frequency_y"][0], score.parameters["frequency_x"][0])

    def added(found: Found, amplitude: str) -> Addition:
        fy, fx = (found.score.parameters[name][0] for name in ("frequency_y", "frequency_x"))
        over, frequencies = carrier(fy, fx, found.size)
        maps = {} if found.pattern is None else {"field": as_map(found.pattern)}
        values = {amplitude: found.score.amplitude, **frequencies}
        return Addition(values, maps, point=dataclasses.replace(point, over=over))

    def simulate(found: Found) -> Addition:
        return added(found, parameter)

    def before(score: Score) -> tuple[str, ...]:
        first = alike if score.payload.of_all > _MOST else ()
        return (*first, *(lines if score.payload.of_lines > _MOST else ()))

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
        absorb=partial(wave_absorb, stays=not redrawn_too),
        covers=COVERS_NOTHING,
        predict=NO_LAW,
        pattern=NO_PATTERN if redrawn_too else pattern,
        simulate=simulate,
        place=place,
        detectable=wave_detectable if redrawn_too else BY_SHIFT,
        decides=redrawn_too,
        before=before,
        found_in=lines,
        after=after,
        least=(lambda sets: sinusoid(sets, one)) if redrawn_too else NO_CLOSED_FORM,
    )
