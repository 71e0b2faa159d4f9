"""Where the gain changes, and noise of the gain itself.

Dual gain: above a signal, or from an ISO on, another amplifier reads the pixels. The photon-transfer curve is
two lines, which smooth effects (shared charge, a bent response: a parabola) do not make; over ISO settings
the read noise in electrons falls at one setting by more than s^2 = a + b / K^2 allows.

Lossy compression: codes that never occur, the more the brighter. How often a code should have occurred is
known from the means of the pixels and their noise. Codes that are missing evenly are another mechanism.

Excess noise: an electron multiplier raises variance and third cumulant of the shot noise by E x^2 and E x^3
of its gain x. A gain read off the variance takes the one for the other, but the third cumulant is then
(2 F^2 - 1) / F^2 times that of Poisson noise of that gain (gamma law), at every signal. No other source of
the gain is needed while the skewness shows: up to some thousand electrons.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage, stats

from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.memory import cleaned
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.recorded import Baseline, Occurred, Recorded
from cannoise_jax.signatures.score import Score, chi2_log_sf, normal_log_p, sidak
from cannoise_jax.signatures.signature import CONTRASTS, FILES, NOT_SIMULATED, Axes, Signature, unchanged

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


def signal_step_score(fields, *, baselines: tuple[Baseline, ...]) -> Score | None:
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
        penalty=8.0,
        amplitude=step,
        error=error,
        shift=error,
        power=1,
        parameters={"ratio": (found.ratio, "1", error), "switch": (found.at, "DN", 0.0)},
        where={"axis": "signal", "range": [found.at, found.at]},
    )


def iso_step_score(fields, *, baselines: tuple[Baseline, ...]) -> Score | None:
    """Read noise in electrons that falls at one ISO beyond what amplifier and converter noise make of it."""
    known = [b for b in baselines if b.iso and np.mean(b.gain) > 0 and np.mean(b.read_error) > 0]
    if len(known) < 5:
        return None
    known.sort(key=lambda b: float(b.iso or 0))
    k = np.array([float(np.mean(b.gain)) for b in known])
    y = np.array([float(np.mean(np.square(b.read_dn / b.gain))) for b in known])
    e = np.hypot(2 * y * np.array([float(np.mean(b.read_error / b.read_dn)) for b in known]) / 2, 0.04 * y)
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
        penalty=3.0,
        amplitude=abs(1 - ratio),
        error=0.05,
        shift=0.05,
        power=1,
        parameters={"read_ratio": (ratio, "1", 0.05), "iso_switch": (iso, "ISO", 0.0)},
        where={"axis": "signal", "range": [0.0, 0.0]},
    )


_LEAST = 20.0
"""Expected occurrences of a code from which its absence tells."""


def occurrences(stacks, fields: tuple[Fields, ...], chosen, step: float) -> Occurred:
    """Occurrences of every code in all recordings, and the codes that should have occurred: the means of the
    pixels, spread by the least noise of each sixteenth of the signals."""
    size = int(65536 // step) + 1
    counts, expected = np.zeros(size), np.zeros(size)
    for s, f in zip(stacks, fields, strict=True):
        used = f.usable & (f.sigma > 1.0 * step)
        if used.mean() < 0.02:
            continue
        means, sigma = f.mean[used], f.sigma[used]
        if f.static is not None:
            means = means + f.static[used] * sigma / np.sqrt(f.frames)
        frames = chosen[s.number][: f.frames]
        edges = np.unique(np.quantile(means, np.linspace(0, 1, 17)))
        for low, high in (
            zip(edges, edges[1:], strict=False) if edges.size > 1 else [(means.min(), means.max())]
        ):
            part = (means >= low) & (means <= high)
            if not part.any():
                continue
            each = np.bincount(np.clip(means[part] / step, 0, size - 1).astype(np.int64), minlength=size)
            width = max(float(np.quantile(sigma[part], 0.05)) / step, 0.3)
            at = np.flatnonzero(each)
            reach = int(6 * width) + 1
            window = slice(max(at[0] - reach, 0), min(at[-1] + reach + 1, size))
            expected[window] += len(frames) * ndimage.gaussian_filter1d(
                each[window].astype(float), width, mode="constant", truncate=4
            )
        for t in frames:
            frame = np.asarray(s.recording.frames[t : t + 1])[0]
            counts += np.bincount((frame // step).astype(np.int64).ravel(), minlength=size)
    index = np.flatnonzero(expected > _LEAST)
    return Occurred(index, expected[index], counts[index] == 0, step)


def compression_score(fields, *, codes: Occurred, black: float, span: float) -> Score | None:
    """Codes that never occur, the more of them the brighter. Amplitude: spacing at the white level, DN."""
    if codes.code.size < 100:
        return None
    signal = codes.code * codes.step - black
    lit = signal > 0.002 * span
    if lit.sum() < 100:
        return None
    signal, missing, expected = signal[lit], codes.missing[lit], codes.expected[lit]
    order = np.argsort(signal)
    signal, missing = signal[order], missing[order]
    log_p = -float(np.sum(np.minimum(expected[order], 60.0)[missing]))
    parts = np.array_split(np.arange(signal.size), 4)
    spacing = np.array([len(k) / max(int((~missing[k]).sum()), 1) for k in parts])
    level = np.array([float(np.mean(signal[k])) for k in parts])
    low, high = np.concatenate(parts[:2]), np.concatenate(parts[2:])
    table = [[missing[high].sum(), (~missing[high]).sum()], [missing[low].sum(), (~missing[low]).sum()]]
    grows = float(np.log(max(stats.fisher_exact(table, alternative="greater")[1], 1e-300)))
    sure = spacing > 1.02
    if sure.sum() >= 2 and spacing[sure].max() > 1.15 * spacing.min():
        exponent = float(np.polyfit(np.log(level[sure]), np.log(spacing[sure]), 1)[0])
    else:
        exponent, grows = 0.0, 0.0
    exponent = float(np.clip(exponent, 0.0, 0.95))
    at_white = float(spacing[-1] * (span / level[-1]) ** exponent * codes.step)
    error = 0.05 * at_white
    both = max(log_p, grows)
    return Score(
        log_p=float(np.clip(both, -700, 0)),
        gain=-log_p if grows < -5 else 0.0,
        penalty=7.0,
        amplitude=at_white,
        error=error,
        shift=codes.step / 5,
        power=1,
        parameters={"step": (at_white, "DN", error), "exponent": (exponent, "1", 0.1)},
        where={"axis": "signal", "range": [float(level[0]), float(level[-1])]},
    )


def excess_score(fields: tuple[Fields, ...]) -> Score | None:
    """Third moment of the temporal noise beyond that of Poisson noise of the fitted gain, at every signal.
    Amplitude: F^2 - 1."""
    halves = np.zeros((2, 3))
    for f in fields:
        if not f.lit or f.frames < 3 or np.median(f.sigma) < 0.65 * f.step:
            continue
        inside = f._replace(contrasts=cleaned(f), before=0)
        # Of the mean of the frames a part of the third moment goes; the residuals have unit variance again.
        left = (1 - 2 / f.frames) * (1 - 1 / f.frames) ** -0.5
        base = (float(np.mean(f.gain)) * f.shot / f.sigma).astype(np.float64) * left
        bright = base < 0.12
        total = np.zeros(f.mean.shape)
        for z in each_frame(inside, static=False):
            total += np.where(np.abs(z) < 7, z.astype(np.float64) ** 3, 0.0)
        kept = f.usable & (base > 0.004)
        for n, part in enumerate((kept & bright, kept & ~bright)):
            w = base * part
            halves[n] += [
                float(np.sum(w * (total - f.frames * base))),
                float(np.sum(w * base)) * f.frames,
                float(np.sum((w * (total - f.frames * base)) ** 2)),
            ]
    u, i, v = halves.sum(0)
    if i <= 0:
        return None
    relative, error = u / i, float(np.sqrt(v + (0.01 * i) ** 2) / i)
    z = relative / error
    parts = [(a / b, np.sqrt(c) / b) for a, b, c in halves if b > 1e-3 * i]
    apart = len(parts) == 2 and abs(parts[0][0] - parts[1][0]) > 4 * np.hypot(parts[0][1], parts[1][1]) + 0.1
    # The gamma law adds at most as much again; twice the variance half of it.
    ruled_out = relative - 3 * error > 0.75 or apart
    excess = 1 / max(1 - min(max(relative, 0.0), 0.75), 0.25) - 1
    spread = error * (1 + excess) ** 2
    return Score(
        log_p=0.0 if ruled_out else normal_log_p(z, 1),
        gain=0.0 if ruled_out else 0.5 * max(z, 0.0) ** 2,
        penalty=4.0,
        amplitude=excess,
        error=spread,
        shift=error,
        power=1,
        parameters={"relative_skewness": (relative, "1", error)},
        where={"axis": "signal", "range": [0.0, 1.0]},
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


def spacing(
    recorded: Recorded, *, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]
) -> Signature:
    """Codes that are farther apart the brighter they are."""
    black = float(recorded.black.mean())
    return plain(
        name=name,
        axes=Axes("converter", "signal", "frozen", "signal", "spacing of codes"),
        reads=FILES,
        score=partial(compression_score, codes=recorded.occurred, black=black, span=recorded.span),
        absorb=unchanged,
        simulate=carried(lambda s: {"step_dn": s.amplitude, "exponent": s.parameters["exponent"][0]}),
        covers=covers,
        lifted_by=lifted_by,
        rare=True,
    )


def skewed(*, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """Shot noise more skewed than its variance says: that of a random gain."""
    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "signal", "skewed"),
        reads=CONTRASTS | {"shot", "signal"},
        score=excess_score,
        absorb=unchanged,
        simulate=carried(lambda s: {"excess": s.amplitude}),
        covers=covers,
        lifted_by=lifted_by,
    )
