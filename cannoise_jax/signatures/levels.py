"""Levels of the darks: black level and dark current."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from cannoise_jax.physics.core.rounding import before_cut
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.black import alike
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.fields import Fields, channel_index, native
from cannoise_jax.signatures.handed import Addition
from cannoise_jax.signatures.least import (
    template,
)
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import (
    ONE_PARAMETER,
    Score,
    student_log_p,
)
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    STATIC,
    Axes,
    Signature,
    unchanged,
)

STANDS_OUT = 6.0
"""Standard deviations of the map from which on a pixel is not of the level: as the level itself is fitted."""


_SURELY = 3.0
"""Standard errors from which on the level of darks rises."""


def dark_levels(fields: tuple[Fields, ...]) -> list[tuple[Fields, np.ndarray, float]]:
    """Of every dark: its level per channel, DN, and the standard error of one. The level is that of the
    pixels that are left: what those that were taken out lifted it by is no level."""
    out = []
    for f in fields:
        if f.kind in DARK:
            channel = channel_index(f.mean.shape)
            level = np.array([_level(f, channel == c) for c in range(4)])
            out.append((f, level, float(median(f.sigma)) / np.sqrt(f.frames * f.mean.size / 4)))
    return out


def _level(field: Fields, chosen: Bool[np.ndarray, "h w"]) -> float:
    """Mean of some pixels: the model's, and what is left about it of those that do not stand out."""
    level, kept = float(field.mean[chosen].mean()), chosen & field.usable
    if field.static is None or not kept.any():
        return level
    away = np.abs(field.static)
    kept &= away < STANDS_OUT * max(robust_std(field.static[kept], 0.0), 1.0)
    rest = np.asarray(field.static, np.float64) * field.sigma / np.sqrt(field.frames)
    return level + float(rest[kept].mean()) if kept.any() else level


def from_means(
    seconds: Float[np.ndarray, "n"], group: Int[np.ndarray, "n"], weights: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n"]:
    """Exposures less the weighted mean of their gain setting, each of which has a black level of its own.
    Those of one exposure are zero: a mean of equal numbers is another number by its rounding."""
    out = np.zeros(seconds.shape)
    for g in np.unique(group):
        mine = group == g
        if np.ptp(seconds[mine]):
            out[mine] = seconds[mine] - np.average(seconds[mine], weights=weights[mine])
    return out


def dark_rise(levels: list[tuple[Fields, np.ndarray, float]], jitter: float = 0.0) -> tuple[float, float]:
    """How the level of the darks of known exposure rises with it, DN/s, and its standard error; (0, inf)
    where all are of one. jitter: variance of the offset of a frame, DN^2."""
    levels = [d for d in levels if d[0].exposure_s is not None]
    t = np.array([f.exposure_s for f, _, _ in levels], float)
    y = np.array([level.mean() for _, level, _ in levels])
    v = np.array([e**2 / 4 + jitter / f.frames for f, _, e in levels])
    return slope_of(t, y, v, np.array([f.group for f, _, _ in levels], int))


def charge_beyond(
    fields: tuple[Fields, ...], jitter: float, rise: tuple[float, float], baselines: Sequence[Baseline]
) -> tuple[float, ...]:
    """Variance that the dark charge of the shortest dark of every gain setting has beyond that of darks that
    rise by `rise`, DN^2; zeros where both rise alike. That noise is none of the readout's."""
    slope, error = dark_rise(dark_levels(fields), jitter)
    beyond, error = slope - rise[0], float(np.hypot(error, rise[1]))
    out = []
    for g, baseline in enumerate(baselines):
        darks = [f for f in fields if f.group == g and f.kind in DARK]
        seconds = min((f.exposure_s or 0.0 for f in darks), default=0.0)
        unit = darks[0].unit if darks else 1.0
        surely = np.isfinite(error) and abs(beyond) > _SURELY * error
        out.append(float(np.mean(baseline.gain)) * unit * beyond * seconds if surely else 0.0)
    return tuple(out)


def slope_of(
    seconds: Float[np.ndarray, "n"],
    level: Float[np.ndarray, "n"],
    variance: Float[np.ndarray, "n"],
    group: Int[np.ndarray, "n"],
) -> tuple[float, float]:
    """Rise of levels within gain settings, a second, and its standard error; (0, inf) of one exposure."""
    t = from_means(seconds, group, 1 / variance)
    i = float(np.sum(t**2 / variance))
    return (float(np.sum(t * level / variance)) / i, float(1 / np.sqrt(i))) if i > 0 else (0.0, np.inf)


def jitter_freedom(fields: tuple[Fields, ...], jitter: float, error: float) -> float:
    """Degrees of freedom of a standard error made of pixel noise, which is known, and of frame jitter."""
    frames = sum(len(f.contrasts) for f in fields if f.kind in DARK)
    share = jitter / max(jitter + error, 1e-30)
    return frames / max(share, 1e-3) ** 2


def frame_jitter(fields: tuple[Fields, ...]) -> float:
    """Variance of the frame offsets of the darks beyond pixel noise, DN^2; 0 when there is none to be
    seen."""
    excess, number = 0.0, 0
    for f in fields:
        if f.kind in DARK and len(f.contrasts):
            u = np.einsum("nij,ij->n", f.contrasts, f.weight.astype(np.float32))
            i = float(np.sum(f.weight.astype(np.float64) ** 2))
            excess += float(np.sum((u / i) ** 2 - 1 / i))
            number += len(u)
    return max(excess / number, 0.0) if number else 0.0


def black_score(fields: tuple[Fields, ...], *, recorded: Recorded) -> Score | None:
    """Black level, of all channels, against the stated one: at the gain setting where they are furthest
    apart."""
    levels, unit = dark_levels(tuple(native(f) for f in fields)), {f.number: f.unit for f in fields}
    if not levels:
        return None
    # What dark current adds in the shortest exposure is no fault of the black level.
    at_lowest = [(f, level / unit[f.number], e / unit[f.number]) for f, level, e in levels]
    rise, doubt = dark_rise(at_lowest, recorded.jitter)
    known = (rise, doubt) if rise > _SURELY * doubt else (0.0, 0.0)
    groups = [[d for d in levels if d[0].group == g] for g in sorted({f.group for f, _, _ in levels})]
    least = _shortest(levels)
    judged = [d for d in groups if alike(_shortest(d), least) or np.isfinite(doubt)]
    scores = [_black_of(d, unit[d[0][0].number], recorded, *known) for d in judged]
    worst = min(scores, key=lambda s: s.log_p)
    return worst.replace(log_p=min(worst.log_p + float(np.log(len(scores))), 0.0))


def _shortest(levels: Iterable[tuple[Fields, np.ndarray, float]]) -> float:
    return min((f.exposure_s or 0.0) for f, _, _ in levels)


def _black_of(
    levels: list[tuple[Fields, np.ndarray, float]], unit: float, recorded: Recorded, rise: float, doubt: float
) -> Score:
    """The same of the darks of one gain setting, which rise by so much a second, DN of the lowest one."""
    fields = tuple(f for f, _, _ in levels)
    seconds = _shortest(levels) * unit
    difference, error, frames = off_stated(levels, recorded)
    jitter = recorded.jitter * unit**2
    # A level stated to the nearest code may be off by half a code; the frame offsets scatter the mean.
    spread = np.sqrt(error**2 / 4 + jitter / frames)
    value, spread = float(difference.mean()) - rise * seconds, float(np.hypot(spread, doubt * seconds))
    baseline = recorded.baselines[fields[0].group]
    # Noise of less than a code stores another mean than its level, as does clipping.
    stored = float(np.max(np.abs(baseline.pedestal - baseline.black_level))) * unit
    z = np.sign(value) * max(abs(value) - recorded.tolerance - stored, 0.0) / spread
    return Score(
        log_p=student_log_p(z, jitter_freedom(fields, jitter / frames, error**2 / 4)),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=abs(value),
        error=float(spread),
        shift=float(spread),
        power=1,
        parameters={"black_level_error": (value, "DN", float(spread))},
        where={"axis": "channel", "channel": "all"},
        payload=value,
    )


def off_stated(
    levels: list[tuple[Fields, np.ndarray, float]], recorded: Recorded
) -> tuple[Float[np.ndarray, "4"], float, int]:
    """By how much the darks of the shortest exposure lie off the stated levels of their gain settings, or off
    those of as many draws, DN of every channel, the standard error of one, and the number of frames."""
    shortest = _shortest(levels)
    chosen = [(f, level, e) for f, level, e in levels if (f.exposure_s or 0.0) == shortest]
    weight = np.array([1 / e**2 for _, _, e in chosen])
    off = [level - recorded.black[f.group] for f, level, _ in chosen]
    frames = sum(f.frames for f, _, _ in chosen)
    drawn_too = np.sqrt(2.0) if recorded.fitted_too else 1.0
    return np.average(off, axis=0, weights=weight), float(drawn_too / np.sqrt(weight.sum())), frames


def _uncut(field: Fields, level: Float[np.ndarray, "4"]) -> Float[np.ndarray, "4"]:
    """The level of a dark before code 0 cuts it off, which lifts the shortest most."""
    channel, unit, f = channel_index(field.mean.shape), field.unit, native(field)
    noise = [float(np.mean(np.square(f.sigma[channel == c], dtype=np.float64))) for c in range(4)]
    at = f.black + (level - f.black) * unit
    before = np.array([before_cut(float(y), v, f.step) for y, v in zip(at, noise, strict=True)])
    return level + (before - at) / unit


def dark_current_score(fields: tuple[Fields, ...], *, recorded: Recorded, quantity: str) -> Score | None:
    """Level of the darks against their exposure, beyond what that of the judged simulator's rises."""
    levels = [(f, _uncut(f, level), e) for f, level, e in dark_levels(fields) if f.exposure_s is not None]
    jitter = recorded.jitter
    slope, spread = dark_rise(levels, jitter)
    if not np.isfinite(spread):
        return None
    slope, spread = slope - recorded.rise[0], float(np.hypot(spread, recorded.rise[1]))
    gain = float(np.mean(fields[0].gain))
    z = slope / spread
    # Frame offsets leave few degrees of freedom for their own variance.
    electrons = slope / gain
    error = float(np.hypot(spread / gain, recorded.baselines[fields[0].group].gain_error * electrons))
    return Score(
        log_p=student_log_p(
            z, jitter_freedom(fields, jitter, levels[0][2] ** 2 * levels[0][0].frames / 4), 1
        ),
        gain=0.5 * z**2 if z > 0 else 0.0,
        penalty=ONE_PARAMETER,
        amplitude=max(electrons, 0.0),
        error=error,
        shift=spread / gain,
        power=1,
        parameters={quantity: (electrons, "e-/s", error)},
        where={"axis": "frame", "recordings": [f.name for f, _, _ in levels]},
    )


READS = frozenset({"mean"}) | STATIC | CONTRASTS


def black(recorded: Recorded, *, name: str, covers: tuple[str, ...]) -> Signature:
    """A black level other than the stated one, the same in all channels."""
    return Signature(
        name=name,
        axes=Axes("readout", "channel", "frozen", "additive", "common"),
        reads=READS,
        score=partial(black_score, recorded=recorded),
        absorb=unchanged,
        covers=covers,
        rare=True,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=lambda found: Addition(bare=True, fitted_black=True),
        place=NO_PLACE,
        detectable=BY_SHIFT,
        beyond=recorded.fitted_too,
        least=NO_CLOSED_FORM,
    )


def by_exposure(
    recorded: Recorded, *, name: str, parameter: str, quantity: str, covers: tuple[str, ...]
) -> Signature:
    """A level of the darks that rises with the exposure. quantity: what its slope is called."""
    return Signature(
        name=name,
        axes=Axes("pixel", "frame", "frozen", "exposure", "mean"),
        reads=READS,
        score=partial(dark_current_score, recorded=recorded, quantity=quantity),
        absorb=unchanged,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter),
        place=NO_PLACE,
        detectable=BY_SHIFT,
        beyond=True,
        least=lambda sets: template(sets, lambda s: s.gain * s.seconds * np.ones(s.weight.shape)),
    )
