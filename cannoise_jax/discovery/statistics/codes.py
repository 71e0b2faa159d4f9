"""The lattice of codes: missing codes, a coarser step than stated, and values cut off at a rail."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from cannoise_jax.discovery.statistics.score import Probe, Score, chi2_log_sf, sidak, unchanged

_PERIODS = range(2, 129)
_SURE = 4.0
"""Standard errors by which a code must differ from its neighbours to be one of a comb."""


_MOVED = 0.01
"""Share of all values that a comb moves to other codes from which it changes the shape of narrow noise."""


class Codes(NamedTuple):
    """Counts of codes, in units of the step: of broadly spread pixels, and of the darks; steps in DN."""

    broad: np.ndarray
    narrowest: float
    dark: tuple[np.ndarray, ...]
    lowest: tuple[int, ...]
    step: float
    detected: float
    stated: float | None


def comb_score(fields, *, probe: str, codes: Codes) -> Score | None:
    """Every so-manieth code missing or favoured: power of the histogram at the harmonics of one period.

    The spectrum of a histogram of noise of standard deviation s codes falls as exp(-2 pi^2 s^2 f^2): beyond
    `lowest` it is counting noise, exponential with mean 1.
    """
    total = codes.broad.sum()
    if codes.narrowest < 1.6 or total < 1e4:
        return None
    lowest = np.sqrt(np.log(np.sqrt(total) / 0.02) / (2 * np.pi**2)) / codes.narrowest
    index = np.flatnonzero(codes.broad)
    index, counts = index[0] + np.arange(index[-1] - index[0] + 1), codes.broad[index[0] : index[-1] + 1]
    found: list[tuple[float, float, int]] = []
    tried = 0
    for period in _PERIODS:
        folded = np.bincount(index % period, weights=counts, minlength=period)
        power = np.abs(np.fft.rfft(folded)) ** 2 / total
        harmonics = np.arange(power.size) / period
        used = (harmonics > lowest) & (harmonics <= 0.5)
        if not used.any():
            continue
        tried += 1
        nyquist = used[-1] and harmonics[-1] == 0.5
        chi2 = 2 * float(power[used].sum()) - (float(power[-1]) if nyquist else 0.0)
        dof = 2 * int(used.sum()) - (1 if nyquist else 0)
        log_p = chi2_log_sf(chi2, dof)
        found.append((log_p, chi2, dof))
    if not tried:
        return None
    smallest = min(f[0] for f in found)
    _, chi2, dof = max(found, key=lambda f: f[1] - 2 * f[2])
    comb = _comb(index, counts)
    distance, phase, shortfall = comb or (0.0, 0, 0.0)
    return Score(
        probe,
        sidak(smallest, tried) if comb else 0.0,
        0.5 * max(chi2 - dof, 0.0) if comb else 0.0,
        float(np.log(tried) + dof / 2),
        distance,
        0.0,
        float("inf"),
        1,
        {
            "period": (distance, "code steps", 0.0),
            "shortfall": (shortfall, "1", float(np.sqrt(distance / total))),
        },
        {"axis": "code", "period": distance, "phase": phase},
    )


def _comb(index: np.ndarray, counts: np.ndarray) -> tuple[float, int, float] | None:
    """Period, phase and shortfall (beside the next codes) of the comb that explains most.

    Codes are seen against what a cubic through their neighbours expects, so that the shape of the histogram
    is none of it. A comb that digital scaling leaves need not repeat after a whole number of codes: its
    period is the mean distance. None for a histogram whose own codes are uneven: no other code of the comb
    differs as the one that weighs most does.
    """
    expected = np.convolve(counts, np.ones(5) / 5, "same")
    lost = np.convolve(counts, np.array([-1, 4, 0, 4, -1]) / 6, "same") - counts
    best, period, phase = 0.0, 0, 0
    for p in range(_PERIODS[0], min(_PERIODS[-1], index.size // 3) + 1):
        share = np.bincount(index % p, lost, p) / np.sqrt(np.bincount(index % p, expected, p) + 1)
        gain = np.where(share > 0, 1.2, 1.0) * share**2  # the code that gets what another lacks is its twin
        if gain.max() > best:
            best, period, phase = float(gain.max()), p, int(np.argmax(gain))
    mine = np.flatnonzero((index % max(period, 1) == phase) & (expected > 0))
    if mine.size < 3:
        return None
    others = mine[mine != mine[np.argmax(expected[mine])]]
    share, again = lost[mine].sum() / expected[mine].sum(), lost[others].sum() / expected[others].sum()
    if again * np.sign(share) < max(0.3 * abs(share), _SURE / np.sqrt(expected[others].sum())):
        return None
    room = np.maximum(np.bincount(index % period, expected, period), 1.0)
    apart = np.bincount(index % period, lost, period) / room * np.sign(share)
    alike = max(int(np.sum(apart > np.maximum(0.7 * apart[phase], _SURE / np.sqrt(room)))), 1)
    beside = np.convolve(counts, [0.5, 0.0, 0.5], "same")
    return period / alike, phase, float(1 - counts[mine].sum() / beside[mine].sum())


def _hidden_by_comb(score: Score) -> tuple[str, ...]:
    """Shapes that are those of the comb where it moves many values."""
    share = abs(score.parameters["shortfall"][0]) / max(score.amplitude, 1.0)
    shapes = ("kurtosis", "light_tails", "skewness", "pixel_spread", "telegraph")
    return shapes if share > _MOVED else ()


def step_score(fields, *, probe: str, codes: Codes) -> Score | None:
    """Codes more widely spaced than stated."""
    if not codes.stated:
        return None
    ratio = codes.detected / codes.stated
    found = ratio > 1.5
    return Score(
        probe,
        -700.0 if found else 0.0,
        1e6 if found else 0.0,
        0.0,
        codes.detected,
        0.0,
        codes.stated,
        1,
        {"step": (codes.detected, "DN", 0.0)},
        {"axis": "code", "period": codes.detected},
    )


def clip_score(fields, *, probe: str, codes: Codes, black: float) -> Score | None:
    """Values piled up at the lowest code of the darks."""
    best: Score | None = None
    for counts, lowest in zip(codes.dark, codes.lowest, strict=True):
        used = np.flatnonzero(counts)
        if used.size < 3 or counts[used[0] : used[0] + 2].sum() < 1:
            continue
        first, second = int(counts[used[0]]), int(counts[used[0] + 1]) if used[0] + 1 < counts.size else 0
        log_p = (
            float(stats.binom.logsf(first - 1, first + second, 0.5)) if first > second and first > 20 else 0.0
        )
        level = (used[0] + lowest) * codes.step - black
        gain = max(first * np.log(max(2 * first / (first + second), 1e-9)), 0.0) if log_p < 0 else 0.0
        gain = first * 1.0 if log_p < -30 else gain
        score = Score(
            probe,
            max(log_p, -700.0),
            float(gain),
            5.0,
            float(level),
            0.5 * codes.step,
            codes.step,
            1,
            {"level": (float(level), "DN", codes.step / np.sqrt(12))},
            {"axis": "code", "period": None},
        )
        if best is None or score.log_p < best.log_p:
            best = score
    return best


def probes(codes: Codes, black: float) -> tuple[Probe, ...]:
    """The probes of this signature."""
    axes = {"enters": "converter", "varies_over": "code", "time": "frozen", "scales": "none"}
    shapes = (
        "kurtosis",
        "light_tails",
        "pixel_spread",
        "skewness",
        "variance_curve",
        "black_level",
        "black_channels",
        "lags_any",
        "telegraph",
    )
    return (
        Probe(
            "comb",
            "missing_codes",
            {**axes, "law": "comb"},
            partial(comb_score, probe="comb", codes=codes),
            unchanged,
            ("comb",),
            hides=_hidden_by_comb,
        ),
        Probe(
            "coarse",
            "quantization",
            {**axes, "law": "lattice"},
            partial(step_score, probe="coarse", codes=codes),
            unchanged,
            ("coarse", "comb"),
            rare=True,
        ),
        Probe(
            "pile_up",
            "black_clipping",
            {**axes, "law": "pile-up"},
            partial(clip_score, probe="pile_up", codes=codes, black=black),
            unchanged,
            # Levels cut off at black are far to one side, and their means curved, without more.
            ("pile_up", *shapes, "hot_additive", "hot_thermal", "curvature"),
            rare=True,
        ),
    )
