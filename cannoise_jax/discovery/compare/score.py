"""Which of two simulators is nearer to the recordings: the log score of their noise on frames held back.

In the orthonormal basis of the bank a simulator is a normal law with its own energies. The logarithm of that
law at the recorded coefficients is a proper score: no simulator does better than the true one. What is left
of tails is not in it; the table has that.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import special, stats

from cannoise_jax.discovery.compare.compared import Compared
from cannoise_jax.discovery.compare.families import STATIC, STRUCTURE, TEMPORAL, of
from cannoise_jax.discovery.compare.measure import of_sets
from cannoise_jax.discovery.frames.splits import split_frames


class Better(NamedTuple):
    """B's score less A's, nats per pixel and frame, with its 90 % interval over frames; of the fixed pattern
    likewise, over recordings (None: fewer than two). units: contrasts that it rests on; held_back: whether
    they are of frames that `diagnose` does not fit on."""

    gain: float
    low: float
    high: float
    units: int
    held_back: bool
    fixed: tuple[float, float, float] | None

    @property
    def verdict(self) -> str:
        """B better, A better, or no difference that these frames show."""
        return "B" if self.low > 0 else "A" if self.high < 0 else "neither"


def scores(compared: Compared, family: str = of(TEMPORAL, STRUCTURE)) -> dict[str, Float[np.ndarray, "u"]]:
    """Log score of every contrast (or of the static map) of every recording, nats per pixel."""
    out = {}
    for name, measured in compared.recorded.items():
        sets = of_sets(compared.simulated[name], family)
        if family not in measured.families or not sets:
            continue
        real = measured.families[family]
        drawn = np.concatenate([s.values for s in sets])
        free = real.size > 0
        count, expected = real.size[free], np.maximum(drawn.mean(0)[free], 1e-3)
        # A simulator that gave few frames is not to lose by the scatter of its energies.
        degrees = np.maximum(count * len(drawn), 3)
        ratio = real.values[:, free] / expected * (degrees - 2) / degrees
        level = np.log(expected) + np.log(degrees / 2) - special.digamma(degrees / 2)
        each = np.sum(count * (ratio + level), 1)
        out[name] = -each / (2 * count.sum()) - compared.seen[name].log_sigma
    return out


def held_back(frames: int) -> Bool[np.ndarray, "u"]:
    """Which contrasts bring in a frame that is held back."""
    return np.isin(np.arange(1, frames), split_frames(frames)[1] if frames > 2 else [])


def better(a: Compared, b: Compared) -> Better | None:
    """Is B nearer to the recordings than A? None where they share no contrast."""
    first, second = scores(a), scores(b)
    names = [n for n in first if n in second and first[n].size == second[n].size]
    if not names:
        return None
    gains = {n: second[n] - first[n] for n in names}
    every = a.held_back and b.held_back
    kept = {n: gains[n][held_back(a.seen[n].frames)] for n in names} if not every else gains
    held = every or sum(v.size for v in kept.values()) > 1
    values = np.concatenate(list((kept if held else gains).values()))
    mean, low, high = _interval(values)
    fixed = None
    one, two = (scores(c, of(STATIC, STRUCTURE)) for c in (a, b))
    maps = [float(two[n][0] - one[n][0]) for n in one if n in two]
    if len(maps) > 1:
        fixed = _interval(np.array(maps))
    return Better(mean, low, high, values.size, held, fixed)


def _interval(values: Float[np.ndarray, "n"]) -> tuple[float, float, float]:
    """Mean and 90 % interval of independent values."""
    mean = float(values.mean())
    if values.size < 2:
        return mean, -np.inf, np.inf
    wide = float(stats.t.ppf(0.95, values.size - 1) * values.std(ddof=1) / np.sqrt(values.size))
    return mean, mean - wide, mean + wide
