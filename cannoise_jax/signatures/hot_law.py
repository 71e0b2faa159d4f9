"""How many pixels stand out from the levels of most, whose law is told together with them.

Where pixels have levels of their own the share that stands out depends on the tail of these: of a law that is
too short some of the tail would be hot. Laws of more parameters count where they are clearly better; whether
any pixel stands out is judged by the law, of those that are about as likely as the likeliest, that leaves
least to stand out.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import special

from cannoise_jax.signatures.core_law import Core, left_open, level, skewed, widened
from cannoise_jax.signatures.heat import MOST_SHARE
from cannoise_jax.signatures.rare import CENTRES, FAR, HEATS, level_counts, log_mixture

_FEW = 0.05
"""Share of hot pixels up to which the lower half of all levels tells the law of the others."""
_ROUNDS = 3
"""Of a share of hot pixels and the law below it, each told with the other: three, and they stand."""
_CLEARLY = 10.0
"""Nats by which a law must be better that has more skewness than the lower half of the levels, or normal
values beside a skewed one; and up to which hot pixels beside the first are none. Gamma-distributed currents
of variation 0.13 to 0.25 gained 15 to 200 on normal ones with hot pixels."""
_ALIKE = 5.0
"""Nats up to which a law is about as likely as the likeliest."""


class Told(NamedTuple):
    """Levels with a law of most of them: nats of both that and hot ones beside it, the law, counts of the
    standard levels, and of the hot ones the share, the mean height and what they gain."""

    nats: float
    core: Core
    counts: Int[np.ndarray, "b"]
    share: float
    height: float
    gain: float

    @property
    def mixture(self) -> float:
        """What hot ones of any share and height gain on average."""
        return float(log_mixture(self.counts, self.core.table()))


def likely_laws(u: Float[np.ndarray, "n"], spread: float, mapped: bool) -> list[Told]:
    """The levels with the laws of most of them that are about as likely as the likeliest, which is first.
    mapped: whether these have levels of their own, or had."""

    def beside(core: Core) -> Told:
        counts = level_counts(core.standard(u))
        share, height, gain = _fitted(counts, core)
        each = core.log_density(CENTRES)
        if share:
            each = np.logaddexp(np.log1p(-share) + each, np.log(share) + core.log_sum(CENTRES, height))
        nats = float(counts @ each) - u.size * float(np.log(core.spread))
        return Told(nats, core, counts, share, height, gain)

    def proper(laws: Iterable[Core]) -> list[Core]:
        # Of levels that lie on few values half may be one of them, and tell no law.
        return [core for core in laws if core.spread > 0]

    def few(laws: tuple[Core, ...]) -> list[Told]:
        # Beside more hot ones the lower half of all levels is that of no law.
        return [f for f in map(beside, proper(laws)) if f.share < _FEW]

    def many(told: Told) -> list[Told]:
        """Normal laws beside as many hot ones as the one before has."""
        out: list[Told] = []
        for _ in range(_ROUNDS):
            out += [beside(core) for core in proper([level(u, told.share)])]
            told = out[-1] if out else told
        return out

    normal = [beside(core) for core in proper([level(u)])] if mapped else []
    normal += many(normal[0]) if normal and normal[0].share >= _FEW else []
    told = sorted([beside(Core(spread)), *normal, *few(skewed(u) if mapped else ())], key=lambda f: -f.nats)
    if mapped and told[0].gain > _ALIKE:  # else nothing stands out from the shorter tail already
        wide = sorted(few(widened(u)), key=lambda f: -f.nats)
        told = wide if wide and wide[0].nats > told[0].nats + _CLEARLY else told
    if mapped and told[0].share:
        # A tail that a law of more skewness has far better, and nothing out of it, is that law's.
        others = [f for f in map(beside, proper(left_open(u))) if f.gain < _CLEARLY]
        other = max(others, key=lambda f: f.nats, default=told[0])
        told = [other] if other.nats > told[0].nats + _CLEARLY else told
    return [f for f in told if f.nats > told[0].nats - _ALIKE]


def share_error(told: list[Told], pixels: int) -> float:
    """Of the likeliest law, for counting and for what the others have."""
    likely = np.exp([f.nats - told[0].nats for f in told])
    apart = np.square([f.share - told[0].share for f in told])
    return float(np.sqrt(told[0].share / pixels + np.average(apart, weights=likely)))


def _fitted(counts: np.ndarray, core: Core) -> tuple[float, float, float]:
    """Share and mean height of most likelihood, and the nats that they gain."""
    used = counts > 0
    n, u = counts[used], CENTRES[used]

    def step(share: float, ratio: np.ndarray) -> tuple[float, np.ndarray]:
        hot = n * special.expit(special.logit(share) + ratio)
        return float(np.clip(np.sum(hot) / n.sum(), 1e-7, MOST_SHARE)), hot

    def gained(share: float, ratio: np.ndarray) -> float:
        return float(np.sum(n * np.logaddexp(np.log1p(-share), np.log(share) + ratio)))

    best, at, share = 0.0, 1.0, 0.0
    for mean in HEATS:
        ratio, f = core.log_ratio(u, mean), 1e-3
        for _ in range(40):
            f = step(f, ratio)[0]
        gain = gained(f, ratio)
        if gain > best:
            best, at, share = gain, float(mean), f
    if not share:
        return 0.0, at, 0.0
    for _ in range(40):
        share, hot = step(share, core.log_ratio(u, at))
        at = max(float(np.sum(hot * core.height(u, at)) / np.sum(hot)), HEATS[0])
    return share, at, gained(share, np.minimum(core.log_ratio(u, at), FAR))
