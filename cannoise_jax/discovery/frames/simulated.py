"""What a simulator shows in draws of its own, beside which the recordings are judged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.frames.calibrate import fit_baseline, ordinary_variance
from cannoise_jax.discovery.frames.contrasts import robust_mean, stack
from cannoise_jax.physics.core.rounding import before_cut
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK, CaptureSet
from cannoise_jax.signatures.levels import STANDS_OUT, slope_of
from cannoise_jax.signatures.recorded import GroupBaseline, Stated

_SURE = 3.0
"""Standard errors of the mean of all sites, of which that of one is twice as large."""


def drawn_parameters(
    drawn: CaptureSet, baselines: tuple[GroupBaseline, ...], step: float
) -> tuple[Stated | None, ...]:
    """Gain and read noise of a simulator per gain setting, fitted on its own draws."""
    out: list[Stated | None] = []
    for baseline in baselines:
        chosen = [(n, r) for n, r in enumerate(drawn.recordings) if r.iso == baseline.iso and r.count > 1]
        if not chosen:
            out.append(None)
            continue
        fitted = fit_baseline([stack(r, n, list(range(r.count)), step) for n, r in chosen], baseline.iso)
        out.append(Stated(fitted.gain, fitted.read_noise, fitted.gain_stderr, fitted.read_stderr))
    return tuple(out)


def drawn_rise(
    drawn: CaptureSet, baselines: Sequence[GroupBaseline], units: Sequence[float]
) -> tuple[float, float]:
    """How the level of a simulator's darks rises with the exposure, and its standard error, DN/s at the
    lowest gain; (0, 0) where it draws darks of one exposure. units: see `battery.gain_units`."""
    group = {b.iso: n for n, b in enumerate(baselines)}
    darks = [r for r in drawn.recordings if r.kind in DARK and r.exposure_s is not None and r.iso in group]
    if not darks:
        return 0.0, 0.0
    seconds = np.array([r.exposure_s for r in darks], float)
    groups = np.array([group[r.iso] for r in darks])
    frames = [np.asarray(r.frames, np.float32) for r in darks]
    level, variance = np.array([_level(f) for f in frames]).T
    steps = [baselines[g].code_step for g in groups]
    level = np.array([_uncut(*each) for each in zip(level, frames, steps, strict=True)])
    unit = np.asarray(units)[groups]
    rise, error = slope_of(seconds, level / unit, variance / unit**2, groups)
    return (rise, error) if np.isfinite(error) else (0.0, 0.0)


def drawn_black(
    drawn: CaptureSet,
    baselines: Sequence[GroupBaseline],
    units: Sequence[float],
    rise: float,
    stated: Float[np.ndarray, "g 4"],
) -> Float[np.ndarray, "g 4"]:
    """Black levels of a simulator per gain setting and site, DN: of its darks of the shortest exposure, less
    what they rise by in that; as stated where it draws no darks, or where its few frames, which rows that
    wander or an offset move as a whole, are no further from that than by chance. rise: see `drawn_rise`."""
    out = np.array(stated, float)
    for g, baseline in enumerate(baselines):
        darks = [r for r in drawn.recordings if r.kind in DARK and r.iso == baseline.iso]
        if darks:
            r = min(darks, key=lambda r: r.exposure_s or 0.0)
            frames = np.asarray(r.frames, np.float32)
            mean, charge = frames.mean(0), rise * units[g] * (r.exposure_s or 0.0)
            level = np.array([robust_mean(mean[at]) - charge for at in SITES])
            error = np.sqrt(_level(frames)[1])
            if abs(np.mean(level - out[g])) > _SURE * error or np.ptp(level - out[g]) > _SURE * 2 * error:
                out[g] = level
    return out


def _uncut(level: float, frames: np.ndarray, step: float) -> float:
    """The level before code 0 cuts it off, as that of recorded darks is told."""
    if len(frames) < 2:
        return level
    return before_cut(level, ordinary_variance(frames.var(0, ddof=1), len(frames) - 1), step)


def _level(frames: np.ndarray) -> tuple[float, float]:
    """Mean of the pixels that are not hot, DN, and its variance: of their noise, or of that of the frames."""
    mean, noise = frames.mean(0), float(np.mean(frames.var(0)))
    away = np.abs(mean - median(mean))
    even = frames[:, away < STANDS_OUT * max(robust_std(mean), np.sqrt(noise / len(frames)), 1e-6)]
    of_frames = float(even.mean(1).var(ddof=1)) / len(frames) if len(frames) > 1 else 0.0
    return float(even.mean()), max(noise / even.size, of_frames, 1e-12)
