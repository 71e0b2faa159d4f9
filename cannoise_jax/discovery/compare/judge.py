"""Recorded against simulated statistics: one signed number of standard deviations each, and what passes.

The probability `alpha` of a false alarm is divided evenly over the families of statistics, and within a
family over everything that was looked at, in every recording and in darks and lit frames taken together.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.compare.compared import Judgement, Measured, Peak, Statistics
from cannoise_jax.discovery.compare.correlated import correlated, of_counts, of_moments, unskewed
from cannoise_jax.discovery.compare.families import (
    FAMILIES,
    MOMENTS,
    QUIET_CHANCES,
    SMOOTH_MAPS,
    STATIC,
    TAIL_SIGMAS,
    TAILS,
    TEMPORAL,
    UNSTEADY,
    UNSTEADY_CHANCES,
    Family,
    of,
)
from cannoise_jax.discovery.compare.measure import of_sets
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures import laws

FLOOR = 4.0
"""No statistic is reported below as many standard deviations, however few were looked at."""

_COUNTED = {
    TAILS: (tuple(float(stats.norm.sf(abs(t))) for t in TAIL_SIGMAS), False),
    UNSTEADY: ((*UNSTEADY_CHANCES, *QUIET_CHANCES), True),
}
"""Chances of the limits beyond which a family counts pixels, and whether it counts them by their squares."""


def judged(
    recorded: Statistics,
    simulated: list[Statistics],
    moving: list[Statistics] | None = None,
    counts: Float[np.ndarray, "k"] | float = 1.0,
    parts: int = 1,
) -> laws.Judged:
    """One family by its law. moving: that of what is redrawn, whose mean is in a static map and scatters as
    it does, which is seen in many contrasts but in one map a set. counts: how much more than independent ones
    counts scatter at least. parts: see `laws.compare_means`."""
    real, drawn = recorded.values, np.stack([s.values for s in simulated])
    if recorded.law == "energy":
        free = recorded.size > 0
        least: np.ndarray | float = 1.0
        if moving:
            units = np.stack([s.values for s in moving])
            least = laws.energy_excess(units[..., free], moving[0].size[free])
        out = laws.compare_energies(real[:, free], drawn[..., free], recorded.size[free], least)
        return laws.Judged(*(_spread_over(v, free) for v in out))
    if recorded.law == "count":
        share = len(real) / (len(real) + drawn.shape[0] * drawn.shape[1])
        return laws.compare_counts(real, drawn, share, counts)
    return laws.compare_means(real, drawn, recorded.size, parts)


_SEEN = 5.0
"""Standard deviations from which a difference of the noise is taken out of the static map."""


def without_noise(
    family: Family, recorded: Statistics, moving: laws.Judged, simulated: list[Statistics]
) -> Statistics:
    """A static map's statistics without what the noise in its mean adds where that noise is not the
    simulator's: rows that are redrawn leave rows in a mean of few frames, which are no fixed pattern."""
    shift = np.where(np.abs(moving.z) > _SEEN, moving.recorded - moving.simulated, 0.0)
    if not shift.any():
        return recorded
    if recorded.law == "energy":
        drawn = np.mean([s.values for s in simulated], (0, 1))
        expected = np.where(shift == 0, drawn, np.maximum(drawn + shift, moving.recorded))
        return recorded._replace(values=recorded.values * drawn / np.maximum(expected, 1e-9))
    if recorded.law != "mean":
        return recorded
    falls = [recorded.frames**power for power in family.falls]
    frames = np.repeat(falls, recorded.size.size // len(falls))
    return recorded._replace(values=recorded.values - shift / frames)


def _spread_over(values: np.ndarray, free: np.ndarray) -> np.ndarray:
    out = np.zeros(free.size)
    out[free] = values
    return out


def _wider(sets: list[Measured]) -> dict[str, Float[np.ndarray, "k"]]:
    """By family, how much more its statistics scatter than those of independent pixels, where a simulator's
    noise is alike from pixel to pixel: rows that it redraws are in the mean of its frames too. Empty where it
    draws single frames."""
    powers = [(s.power, s.contrasts, s.width) for s in sets if s.power is not None and s.contrasts]
    if not powers:
        return {}
    fields = sum(n for _, n, _ in powers)
    noise = correlated(np.sum([p for p, _, _ in powers], 0) / fields, powers[0][2], fields)
    return {MOMENTS: of_moments(noise), **{name: of_counts(noise, *how) for name, how in _COUNTED.items()}}


def _in_noise(
    family: Family,
    recorded: Statistics,
    drawn: list[Statistics],
    moving: list[Statistics] | None,
    wider: dict[str, Float[np.ndarray, "k"]],
) -> laws.Judged:
    """One family where its statistics scatter `wider`. moving: see `judged`."""
    if family.name == SMOOTH_MAPS:  # by the scatter that all of them show
        recorded = recorded._replace(size=np.mean([recorded.size, *(s.size for s in drawn)], 0))
    own = wider.get(family.name)
    if own is None:
        return judged(recorded, drawn, moving, parts=len(family.falls))
    if family.name != MOMENTS:
        return judged(recorded, drawn, moving, own)
    wide = recorded._replace(size=recorded.size * own)
    out = judged(wide, drawn, moving, parts=len(family.falls))
    return out._replace(z=unskewed(out.z, own, 2.0 / float(recorded.size[0])))


def judge(
    recorded: dict[str, Measured], simulated: dict[str, list[Measured]], kinds: dict[str, str], alpha: float
) -> tuple[list[Judgement], list[Peak]]:
    """Every family of every recording and of every kind together, and the frequencies that differ.

    kinds: `dark` or `lit` by the name of the recording.
    """
    every: dict[str, list[tuple[str, laws.Judged]]] = defaultdict(list)
    for name, real in recorded.items():
        own: dict[str, laws.Judged] = {}
        wider = _wider(simulated[name])
        for family, values in real.families.items():
            drawn = of_sets(simulated[name], family)
            if drawn:
                known = FAMILIES[family]
                redrawn = of(TEMPORAL, known.name)
                moving = own.get(redrawn) if known.part == STATIC else None
                if moving is not None:
                    values = without_noise(known, values, moving, drawn)
                units = None if moving is None else of_sets(simulated[name], redrawn)
                own[family] = _in_noise(known, values, drawn, units, wider)
                every[family].append((name, own[family]))
    for results in every.values():
        pooled = []
        for kind in ("dark", "lit"):
            alike = [r for name, r in results if kinds[name] == kind]
            if len(alike) > 1:
                pooled.append((f"all {kind}", _together(alike)))
        results += pooled
    families = len(every) + 2
    out = []
    for family, results in every.items():
        looks = sum(int(np.count_nonzero(r.recorded + r.simulated)) for _, r in results)
        passing = max(laws.threshold(alpha, families, looks), FLOOR)
        out += [Judgement(family, where, *r, passing) for where, r in results]
    peaks = []
    for kind in ("dark", "lit"):
        mine = [n for n in recorded if kinds[n] == kind and recorded[n].power is not None]
        if mine:
            peaks += _peaks(kind, mine, recorded, simulated, alpha / (2 * families))
    return out, peaks


def _together(mine: list[laws.Judged]) -> laws.Judged:
    """Several recordings of a kind: values averaged, standard deviations added (Stouffer)."""
    recorded, simulated = np.mean([r.recorded for r in mine], 0), np.mean([r.simulated for r in mine], 0)
    clipped = np.clip([r.z for r in mine], -30, 30)
    return laws.Judged(recorded, simulated, np.sum(clipped, 0) / np.sqrt(len(mine)))


_LOCAL = 24
"""Frequencies along a side of the cells whose median is the broad shape of a ratio: of 576 it is known to 5 %
of the scatter of one (1.25 / sqrt(576)), of the 49 along an axis to 18 %."""


def _peaks(kind, names, recorded, simulated, alpha: float) -> list[Peak]:
    """Single frequencies that stand out of the ratio of both spectra, the broad shape of it aside."""
    real = np.sum([recorded[n].power for n in names], 0)
    count = sum(recorded[n].contrasts for n in names)
    drawn = np.sum([s.power for n in names for s in simulated[n] if s.power is not None], 0)
    draws = sum(s.contrasts for n in names for s in simulated[n])
    real, drawn = np.asarray(real, float) / count, np.asarray(drawn, float) / draws
    ratio = (real + 1e-9) / (drawn + 1e-9)
    dof = np.full(ratio.shape, 2.0)
    own = [0, ratio.shape[0] // 2] if ratio.shape[0] % 2 == 0 else [0]
    for column in (0, -1):
        dof[own, column] = 1.0  # real coefficients
    broad = _broad(ratio)
    rest = ratio / broad
    upper = stats.f.sf(rest, dof * count, dof * draws)
    lower = stats.f.cdf(rest, dof * count, dof * draws)
    pixels = 2.0 * ratio.size
    limit = alpha / ratio.size / 2
    found: list[Peak] = []
    taken: list[tuple[int, int]] = []
    chance = np.minimum(upper, lower)
    chance[0, 0] = 1.0
    chance[ratio.shape[0] // 2 + 1 :, [0, -1]] = 1.0  # the mirror of the first half
    for flat in np.argsort(chance, axis=None)[:4000]:
        y, x = np.unravel_index(flat, ratio.shape)
        if chance[y, x] > limit or len(found) >= 12:
            break
        # Leakage of a frequency between two grid points runs along its row and its column.
        if any(
            _side(y, b, ratio.shape[0]) and abs(x - c) <= 3 or (y == b or x == c) and (c > 0 and b > 0)
            for b, c in taken
        ):
            continue
        taken.append((int(y), int(x)))
        more = rest[y, x] > 1
        excess = (real if more else drawn)[y, x] - (drawn if more else real)[y, x]
        amplitude = 2 * np.sqrt(max(excess, 0) / pixels)
        z = float(
            laws.as_normal(upper[y, x], lower[y, x], np.asarray(laws.FARTHEST if more else -laws.FARTHEST))
        )
        cycles = (y if y <= ratio.shape[0] // 2 else y - ratio.shape[0]) / ratio.shape[0]
        found.append(Peak(kind, (float(cycles), float(x / (2 * (ratio.shape[1] - 1)))), float(amplitude), z))
    return found


def _side(y: int, b: int, rows: int) -> bool:
    return min((y - b) % rows, (b - y) % rows) <= 3


def _broad(ratio: np.ndarray) -> np.ndarray:
    """Local level of the ratio of two spectra: medians of cells, those of the two axes by themselves."""
    out = np.empty_like(ratio)
    h, w = ratio.shape
    for rows in np.array_split(np.arange(h), max(h // _LOCAL, 1)):
        for columns in np.array_split(np.arange(w), max(w // _LOCAL, 1)):
            part = np.ix_(rows, columns)
            out[part] = median(ratio[part])
    for axis in (0, 1):
        line = ratio[:, 0] if axis == 0 else ratio[0]
        width = 2 * _LOCAL + 1
        padded = np.pad(line, width // 2, mode="wrap" if axis == 0 else "reflect")
        local = median(np.lib.stride_tricks.sliding_window_view(padded, width), 1)
        if axis == 0:
            out[:, 0] = local
        else:
            out[0] = local
    return np.maximum(out, 1e-6)
