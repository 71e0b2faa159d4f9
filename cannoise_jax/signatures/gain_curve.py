"""Where the gain changes.

Dual gain: above a signal, or from an ISO on, another amplifier reads the pixels. The photon-transfer curve is
two lines, which smooth effects (shared charge, a bent response: a parabola) do not make; over ISO settings
the read noise in electrons falls at one setting by more than s^2 = a + b / K^2 allows.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import GroupBaseline, Recorded
from cannoise_jax.signatures.score import Score, chi2_log_sf, sidak
from cannoise_jax.signatures.signature import FILES, NOT_SIMULATED, Axes, Signature, unchanged

_FLOOR = 0.01
"""Relative error of a point of a photon-transfer curve, at least: no camera's curve is straighter."""


def _fit(basis: np.ndarray, y: np.ndarray, e: np.ndarray) -> tuple[float, np.ndarray]:
    beta = np.linalg.lstsq(basis / e[:, None], y / e, rcond=None)[0]
    return float(np.sum(((y - basis @ beta) / e) ** 2)), beta


_RISES = 0.08
"""Slope above the switch over that below, at least: a full well leaves none."""


class Break(NamedTuple):
    """Two lines through a curve: where they meet, chi-square of one line, of a parabola and of both, points,
    slope above over slope below."""

    at: float
    one: float
    bent: float
    two: float
    points: int
    ratio: float


def two_lines(x: np.ndarray, y: np.ndarray, e: np.ndarray) -> Break | None:
    """The best two lines, each with its own slope and offset; None for fewer than eight points."""
    order = np.argsort(x)
    x, y, e = x[order], y[order], e[order]
    if x.size < 8 or x[-1] <= x[0]:
        return None
    one, _ = _fit(np.stack([np.ones_like(x), x], 1), y, e)
    bent, _ = _fit(np.stack([np.ones_like(x), x, x**2], 1), y, e)
    best = None
    for k in range(3, x.size - 2):
        low, high = slice(None, k), slice(k, None)
        if x[k] <= x[k - 1] or np.ptp(x[high]) < 0.1 * x[-1] or np.ptp(x[low]) < 1e-3 * x[-1]:
            continue
        a, first = _fit(np.stack([np.ones(k), x[low]], 1), y[low], e[low])
        b, second = _fit(np.stack([np.ones(x.size - k), x[high]], 1), y[high], e[high])
        if best is None or a + b < best.two:
            ratio = float(second[1] / max(first[1], 1e-12))
            best = Break(float(0.5 * (x[k - 1] + x[k])), one, bent, a + b, x.size, ratio)
    return best


_SWITCH = 8.0
"""Nats of a second line: `ONE_PARAMETER` and the place among some twenty levels, log(20) = 3.0. Of eight sets
without a switch the gain was 7.9 on average, for the place is searched, and 9.5 at most."""
_AT_ISO = 3.0
"""Nats of a place among as many gain settings, log(20). The height of the step is not paid for: few settings
tell of it, so that 0.5 log(n) would be 1.2 of n = 10."""


def signal_step_score(fields, *, baselines: tuple[GroupBaseline, ...]) -> Score | None:
    """A photon-transfer curve of two lines. Amplitude: relative step of the gain, or where both lines are as
    steep, of the noise."""
    tested, found, log_p, gain = 0, None, 0.0, 0.0
    for b in baselines:
        for c in range(4):
            # Above a switch the variance may fall as far as that of full pixels; but it rises again.
            points = [p for p in b.levels if p.channel == c and p.sure and p.pixels > 100]
            if len(points) < 8:
                continue
            x, y = np.array([p.signal for p in points]), np.array([p.variance for p in points])
            e = np.hypot(np.array([p.error for p in points]), _FLOOR * y)
            lines = two_lines(x, y, e)
            tested += 1
            if lines is None or not _RISES < lines.ratio < 1 / _RISES:
                continue
            scale = max(lines.two / max(lines.points - 4, 1), 1.0)
            # Beyond what one more parameter of a smooth curve explains.
            better = (min(lines.one, lines.bent + 4.0) - lines.two) / scale
            own = sidak(chi2_log_sf(max(better, 0.1), 3), lines.points)
            gain += 0.5 * max(better, 0.0)
            if found is None or own < log_p:
                log_p, found = own, lines
    if not tested:
        return None
    if found is None:
        found = Break(0.0, 0.0, 0.0, 0.0, 8, 1.0)
    step = abs(found.ratio - 1)
    error = float(np.sqrt(2.0 / found.points)) * _FLOOR * 3
    return Score(
        log_p=sidak(log_p, tested),
        gain=gain,
        penalty=_SWITCH,
        amplitude=step,
        error=error,
        shift=error,
        power=1,
        parameters={"ratio": (found.ratio, "1", error), "switch": (found.at, "DN", 0.0)},
        where={"axis": "signal", "range": [found.at, found.at]},
    )


def iso_step_score(fields, *, baselines: tuple[GroupBaseline, ...]) -> Score | None:
    """Read noise in electrons that falls at one ISO beyond what amplifier and converter noise make of it."""
    known = [b for b in baselines if b.iso and np.mean(b.gain) > 0 and np.mean(b.read_stderr) > 0]
    if len(known) < 5:
        return None
    known.sort(key=lambda b: float(b.iso or 0))
    k = np.array([float(np.mean(b.gain)) for b in known])
    y = np.array([float(np.mean(np.square(b.read_noise / b.gain))) for b in known])
    e = np.hypot(
        2 * y * np.array([float(np.mean(b.read_stderr / b.read_noise)) for b in known]) / 2, 0.04 * y
    )
    smooth = np.stack([np.ones_like(k), 1 / k**2], 1)
    one, _ = _fit(smooth, y, e)
    best, at, ratio = one, 0, 1.0
    for n in range(2, len(known) - 1):
        above = (np.arange(len(known)) >= n).astype(float)
        chi2, beta = _fit(np.column_stack([smooth, above]), y, e)
        if chi2 < best and beta[2] < 0:
            best, at = chi2, n
            ratio = float(np.sqrt(max(y[n] / max(y[n - 1], 1e-12), 1e-6)))
    scale = max(best / max(len(known) - 3, 1), 1.0)
    better = (one - best) / scale
    iso = float(known[at].iso or 0) if at else 0.0
    # A few settings and a fitted scale: Fisher's law.
    log_p = (
        float(stats.f.logsf(better, 1, max(len(known) - 3, 1)))
        if scale > 1
        else chi2_log_sf(max(better, 0.1), 1)
    )
    return Score(
        log_p=sidak(min(log_p, 0.0), len(known) - 3),
        gain=0.5 * better,
        penalty=_AT_ISO,
        amplitude=abs(1 - ratio),
        error=0.05,
        shift=0.05,
        power=1,
        parameters={"read_ratio": (ratio, "1", 0.05), "iso_switch": (iso, "ISO", 0.0)},
        where={"axis": "signal", "range": [0.0, 0.0]},
    )


def signal_step(
    recorded: Recorded, *, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]
) -> Signature:
    """A photon-transfer curve of two lines; camera models switch at an ISO only."""
    return plain(
        name=name,
        axes=Axes("readout", "signal", "frozen", "signal", "two lines"),
        reads=FILES,
        score=partial(signal_step_score, baselines=recorded.baselines),
        absorb=unchanged,
        simulate=NOT_SIMULATED,
        covers=covers,
        lifted_by=lifted_by,
    )


def iso_step(recorded: Recorded, *, name: str, covers: tuple[str, ...]) -> Signature:
    """Read noise in electrons that falls at one gain setting."""

    def values(score: Score) -> dict[str, float]:
        return {n: score.parameters[n][0] for n in ("read_ratio", "iso_switch")}

    return plain(
        name=name,
        axes=Axes("readout", "signal", "frozen", "signal", "step over ISO"),
        reads=FILES,
        score=partial(iso_step_score, baselines=recorded.baselines),
        absorb=unchanged,
        simulate=carried(values),
        covers=covers,
    )
