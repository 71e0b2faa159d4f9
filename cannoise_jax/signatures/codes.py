"""The lattice of codes: missing codes, a coarser step than stated, and values cut off at a rail."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from scipy import stats

from cannoise_jax.recordings.codes import share_above
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.recorded import Codes, Recorded
from cannoise_jax.signatures.score import LEAST_LOG_P, ONE_PARAMETER, Score, chi2_log_sf, normal_log_p, sidak
from cannoise_jax.signatures.signature import (
    FILES,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NO_STRENGTH,
    Axes,
    Signature,
    unchanged,
)

COMB = "comb"
"""The law of codes of which every so-manieth is another."""
_PERIODS = range(2, 129)
"""Codes from one gap or spike to the next that are looked for."""
_SURE = 4.0
"""Standard errors by which a code must differ from its neighbours to be one of a comb."""


_PILED = float(np.log(1e-4))
"""log p from which on darks count as cut off."""
_FEW = 20
"""Values at a code from which its count is told from chance."""
_SLACK = 0.05
"""By which the log of a count of rounded normal noise departs from a constant second difference, at most:
0.012 for a standard deviation of one code, less above it."""
_MOVED = 0.01
"""Share of all values that a comb moves to other codes from which it changes the shape of narrow noise."""


def comb_score(fields, *, codes: Codes) -> Score | None:
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
    above = share_above(index, counts, round(distance), phase) if comb else 1.0
    return Score(
        log_p=sidak(smallest, tried) if comb else 0.0,
        gain=0.5 * max(chi2 - dof, 0.0) if comb else 0.0,
        penalty=float(np.log(tried) + dof / 2),
        amplitude=distance,
        error=0.0,
        shift=float("inf"),
        power=1,
        parameters={
            "period": (distance, "code steps", 0.0),
            "shortfall": (shortfall, "1", float(np.sqrt(distance / total))),
        },
        where={"axis": "code", "period": distance, "phase": phase, "above": above},
        spot={"period": (distance, 0.0)},
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


def step_score(fields, *, codes: Codes) -> Score | None:
    """Codes more widely spaced than stated: values on one code in `ratio` gain log(ratio) each over values
    that may take all."""
    if not codes.stated:
        return None
    ratio = codes.detected / codes.stated
    found = ratio > 1.5
    values = max(float(codes.broad.sum()), *(float(dark.sum()) for dark in codes.dark), 1.0)
    return Score(
        log_p=LEAST_LOG_P if found else 0.0,
        gain=values * float(np.log(ratio)) if found else 0.0,
        penalty=0.0,
        amplitude=codes.detected,
        error=0.0,
        shift=codes.stated,
        power=1,
        parameters={"step": (codes.detected, "DN", 0.0)},
        where={"axis": "code", "period": codes.detected},
        spot={"period": (codes.detected, 0.0)},
    )


def clip_score(fields, *, codes: Codes, black: float) -> Score | None:
    """Values piled up at the lowest code of the darks."""
    scores: list[Score] = []
    for counts, lowest in zip(codes.dark, codes.lowest, strict=True):
        used = np.flatnonzero(counts)
        if used.size < 3 or counts[used[0] : used[0] + 2].sum() < 1:
            continue
        first, second = int(counts[used[0]]), int(counts[used[0] + 1]) if used[0] + 1 < counts.size else 0
        log_p = min(
            float(stats.binom.logsf(first - 1, first + second, 0.5))
            if first > second and first > 20
            else 0.0,
            _above_the_law(counts[used[0] : used[0] + 5]),
        )
        level = (used[0] + lowest) * codes.step - black
        gain = max(first * np.log(max(2 * first / (first + second), 1e-9)), 0.0) if log_p < 0 else 0.0
        gain = first * 1.0 if log_p < -30 else gain
        score: Score = Score(
            log_p=max(log_p, LEAST_LOG_P),
            gain=float(gain),
            penalty=ONE_PARAMETER,
            amplitude=float(level),
            error=0.5 * codes.step,
            shift=codes.step,
            power=1,
            parameters={"level": (float(level), "DN", codes.step / np.sqrt(12))},
            where={"axis": "code", "period": None},
        )
        scores.append(score)
    return min(scores, key=lambda s: (s.log_p, s.amplitude), default=None)


def cut_off(codes: Codes) -> bool:
    """Whether values of darks pile up at their lowest code, so that noise and levels are skewed."""
    found = clip_score((), codes=codes, black=0.0)
    return found is not None and found.log_p < _PILED


def _above_the_law(counts: np.ndarray) -> float:
    """log p of the count of the lowest code under the normal law that the next three codes follow: its log
    counts have a constant second difference. 0 where a fourth one does not follow it (a comb, tails), and for
    noise below a code, whose counts are no samples of a density."""
    if counts.size < 5 or counts.min() < _FEW:
        return 0.0
    logs, errors = np.log(counts), 1 / counts
    beyond = logs[:2] - 3 * logs[1:3] + 3 * logs[2:4] - logs[3:5]
    spread = np.sqrt(errors[:2] + 9 * errors[1:3] + 9 * errors[2:4] + errors[3:5])
    if -(logs[1] - 2 * logs[2] + logs[3]) > 1 or abs(beyond[1]) > _SLACK + _SURE * spread[1]:
        return 0.0
    return normal_log_p(max(float(beyond[0]) - _SLACK, 0.0) / float(spread[0]), 1) if beyond[0] > 0 else 0.0


def _of_codes(law: str, **fields) -> Signature:
    """A signature of the lattice of codes, which nothing that is taken out of the fields changes."""
    return Signature(
        axes=Axes("converter", "code", "frozen", "none", law),
        reads=FILES,
        absorb=unchanged,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        place=NO_PLACE,
        detectable=NO_STRENGTH,
        least=NO_CLOSED_FORM,
        **fields,
    )


def combed(
    recorded: Recorded,
    *,
    name: str,
    parameter: str,
    covers: tuple[str, ...],
    shapes: tuple[str, ...],
) -> Signature:
    """Codes that are missing, rarer or more frequent than those beside them. shapes: signatures of the shape
    of the noise, which is that of the comb where it moves many values."""

    def hides(score: Score) -> tuple[str, ...]:
        share = abs(score.parameters["shortfall"][0]) / max(score.amplitude, 1.0)
        return shapes if share > _MOVED else ()

    def simulate(found: Found) -> Addition | None:
        """Codes that are doubled, or whose distances are no whole numbers: the camera model knows of none."""
        value, where = found.score.amplitude, found.score.where
        short = found.score.parameters["shortfall"][0]
        if short <= 0 or value % 1:
            return None
        beside = {n: where[n] for n in ("phase", "above")}
        return Addition({parameter: value, **beside, "kept": kept_of(max(1 - short, 0.0), value)})

    def says(entry: dict[str, Any]) -> tuple[str, tuple[float, float]]:
        lost = entry["parameters"]["shortfall"]
        held, (low, high) = 1 - lost["value"], (1 - v for v in reversed(lost["ci90"]))
        how = "rarer" if held < 1 else "more frequent"
        return (
            f"Every {entry['amplitude']['value']:.4g} codes one is {how} than those beside it, by "
            f"digital scaling or a fault of the converter: it holds {held:.3g} of what they hold",
            (low, high),
        )

    return _of_codes(
        COMB,
        name=name,
        score=partial(comb_score, codes=recorded.codes),
        covers=covers,
        hides=hides,
        simulate=simulate,
        says=says,
    )


def kept_of(held: float, period: float) -> float:
    """Share of a code's values that stay on it, of one that holds this much of what those beside it hold:
    these have got what it lost, each of them half, and all of it where every second code is one of them."""
    got = 1.0 if period == 2 else 0.5
    return (1 + got) * held / (1 + got * held)


def coarse(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """Codes that are more widely spaced than stated."""
    return _of_codes(
        "lattice",
        name=name,
        score=partial(step_score, codes=recorded.codes),
        covers=covers,
        rare=True,
        simulate=strength(parameter),
    )


def piled_up(
    recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...], off: tuple[str, ...]
) -> Signature:
    """Values that are cut off at a rail above or below black: the shape of what is left is the rail's, so it
    is judged first. off: signatures of single pixels, which know of it (`cut_off`), but are told after."""
    black, raised = float(recorded.black.mean()), strength(parameter)

    def simulate(found: Found) -> Addition:
        # A camera model has no code below 0 anyhow, and the black level that it has was told with that in
        # mind: what its darks have more by it is no part of it.
        at_zero = found.score.amplitude + black <= recorded.codes.step / 2
        return Addition(bare=True, fitted_black=True) if at_zero else raised(found)

    return _of_codes(
        "pile-up",
        name=name,
        score=partial(clip_score, codes=recorded.codes, black=black),
        covers=covers,
        before=lambda score: (*covers, *off),
        rare=True,
        simulate=simulate,
    )
