"""The Poisson-Gaussian baseline of a capture set, through rounding and clipping.

Black level and read noise are those whose *stored* mean and temporal variance are the recorded ones: noise of
less than a code is anything but read^2 + step^2 / 12 once rounded, and a black level near code 0 is cut off
below. The gain is the slope of the temporal variance over the signal.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import optimize, special

from cannoise_jax.discovery.calibrate import gain_groups
from cannoise_jax.discovery.compare.light import SITES, Light, light_for
from cannoise_jax.discovery.compare.view import Raw, bulk_variance, chosen_frames, reduce
from cannoise_jax.discovery.stacks import code_step, iso_numbers
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import DARK, CaptureSet

_BINS = 12
_REACH = 12


class _Point(NamedTuple):
    """Temporal variance (DN^2) at a level (DN) of one site, and how many values it rests on."""

    level: float
    variance: float
    values: float
    dark: bool


def fitted_baseline(capture: CaptureSet) -> SensorModel | None:
    """The baseline of every gain setting; None where no recording has two frames."""
    step = code_step(capture)
    isos = iso_numbers(gain_groups(capture))
    first = capture.recordings[0]
    rows = []
    for iso in gain_groups(capture):
        points: list[list[_Point]] = [[], [], [], []]
        for r in capture.recordings:
            if r.iso != iso or r.count < 2:
                continue
            dark = r.kind in DARK
            frames = np.stack([np.asarray(r.frames[t : t + 1])[0] for t in chosen_frames(r)])
            raw = reduce(frames, min(float(r.white_level), 65535.0), dark, step)
            light = light_for(r, raw.mean, raw.usable, dark)
            for site, found in zip(points, _points(raw, light, dark, float(r.white_level)), strict=True):
                site += found
        if not any(points):
            continue
        stated = np.mean([r.black_level for r in capture.recordings if r.iso == iso], 0)
        rows.append((isos[iso], *_solved(points, stated, step)))
    if not rows:
        return None
    rows.sort(key=lambda row: row[0])
    gains, reads = np.stack([r[2] for r in rows]), np.stack([r[3] for r in rows])
    a, b, c, d = rows[0][1].tolist()
    return SensorModel.poisson_gaussian(
        gains,
        reads / gains,
        (a, b, c, d),
        min(first.white_level, 65535.0),
        first.cfa,
        iso=tuple(r[0] for r in rows),
        code_step=step,
        camera=capture.camera,
    )


def _points(raw: Raw, light: Light | None, dark: bool, white: float) -> list[list[_Point]]:
    """Variances of one recording by site; of uneven light by level."""
    fitted = raw.mean if light is None else light.fit(raw.mean, raw.usable)
    dof = len(raw.contrasts)
    out: list[list[_Point]] = []
    for y, x in SITES:
        at = np.s_[y::2, x::2]
        use = raw.usable[at]
        level = fitted[at][use]
        v = np.mean(raw.contrasts[(slice(None), *at)] ** 2, 0)[use]
        found: list[_Point] = []
        if level.size >= 64:
            bins = 1 if dark or np.ptp(level) ** 2 < 100 * np.median(v) else _BINS
            edges = np.quantile(level, np.linspace(0, 1, bins + 1)[1:-1])
            which = np.searchsorted(edges, level)
            for b in range(bins):
                mine = which == b
                if mine.sum() < 64:
                    continue
                variance = bulk_variance(v[mine], dof)
                mean = float(level[mine].mean())
                if mean + 5 * np.sqrt(variance) < white:
                    found.append(_Point(mean, variance, float(mine.sum() * dof), dark))
        out.append(found)
    return out


def _solved(
    points: list[list[_Point]], stated: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Black level (DN), gain (DN/e-) and read noise (DN) of every site."""
    black, gain, read = np.array(stated, float), np.ones(4), np.full(4, step)
    for c, site in enumerate(points):
        dark = [p for p in site if p.dark]
        lit = [p for p in site if not p.dark]
        if dark:
            # Dark charge is in the long ones: the quietest say what the read noise is.
            quiet = [p for p in dark if p.variance < 1.1 * min(q.variance for q in dark) + 1e-9]
            level = float(np.median([p.level for p in quiet]))
            variance = float(np.average([p.variance for p in quiet], weights=[p.values for p in quiet]))
            black[c], read[c] = through_codes(level, variance, step)
        if lit:
            known = read[c] if dark else None
            gain[c], read[c] = _line(lit, black[c], known, step)
    return black, gain, np.maximum(read, 1e-3 * step)


def _line(lit: list[_Point], black: float, read: float | None, step: float) -> tuple[float, float]:
    """Gain and read noise: variance = read^2 + step^2 / 12 + gain (level - black), weighted; levels at which
    the variance falls short of the line by far are full wells, and left out."""
    x = np.array([max(p.level - black, 0) for p in lit])
    v = np.array([p.variance for p in lit]) - step**2 / 12
    n = np.array([p.values for p in lit])
    fitted, kept = np.maximum(v, 1e-3), np.ones(x.size, bool)
    slope, floor = 1e-6, 0.0
    for _ in range(6):
        weight = np.where(kept, np.sqrt(n) / (fitted + step**2 / 12), 0)
        if read is not None:
            floor = read**2
            slope = float(np.sum(weight**2 * x * (v - floor)) / max(np.sum((weight * x) ** 2), 1e-12))
        else:
            basis = np.stack([x, np.ones_like(x)], 1) * weight[:, None]
            (slope, floor), _ = optimize.nnls(basis, v * weight)
        slope = max(slope, 1e-6)
        fitted = np.maximum(slope * x + floor, 1e-3)
        kept = v > 0.7 * fitted
        if not kept.any():
            kept[:] = True
    return slope, float(np.sqrt(max(floor, 0))) if read is None else read


def stored_moments(black: float, read: float, step: float) -> tuple[float, float]:
    """Mean and variance (DN, DN^2) of normal noise once rounded to the step and clipped at 0."""
    near = np.round(black / step)
    reach = int(_REACH + 8 * read / step)
    codes = np.arange(max(near - reach, 0), near + reach + 1)
    upper = special.ndtr(((codes + 0.5) * step - black) / read)
    chance = np.diff(np.concatenate([[0.0], upper]))
    chance[-1] += 1 - upper[-1]
    mean = float(np.sum(chance * codes))
    return mean * step, float(np.sum(chance * (codes - mean) ** 2)) * step**2


def through_codes(mean: float, variance: float, step: float) -> tuple[float, float]:
    """Black level and read noise (DN) whose stored mean and variance are these."""
    start = np.sqrt(max(variance - step**2 / 12, 0.02 * step**2))
    if start > 1.5 * step and mean > 6 * start:
        return mean, float(start)

    def miss(at: np.ndarray) -> np.ndarray:
        m, v = stored_moments(at[0] * step, np.exp(at[1]) * step, step)
        return np.array([(m - mean) / step, (v - variance) / max(variance, 1e-3 * step**2)])

    best = None
    for shift in (0.0, -0.3, 0.3, -1.0):
        for factor in (1.0, 0.6, 1.5):
            guess = np.array([mean / step + shift, np.log(factor * start / step)])
            found = optimize.least_squares(
                miss, guess, bounds=([mean / step - 5 * start / step - 2, -4], [mean / step + 1, 6])
            )
            if best is None or found.cost < best.cost - 1e-12:
                best = found
    assert best is not None
    return float(best.x[0] * step), float(np.exp(best.x[1]) * step)
