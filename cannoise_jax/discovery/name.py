"""Name: which of the mechanisms that could have done it did, with probabilities, ties kept as ties."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.locate import Located
from cannoise_jax.discovery.statistics.hot import before_maps
from cannoise_jax.discovery.statistics.score import Probe, Score

TIE_NATS = 3.0
UNNAMED_NATS = 3.0
"""What a mechanism without a name must gain beyond the best named one."""


BLURS = {
    "reference_blur": ("in_camera_denoising", "lags_in_camera_denoising"),
    "reference_spread": ("crosstalk", "lags_crosstalk"),
}
"""Probes of blur in the mean, the mechanism of the camera that does it, and the probe of its noise
correlation."""


TOGETHER = {"lags_brighter_fatter": "variance_curve"}
"""What one probe's mechanism does to another's statistic counts for it where both reject: charge that pixels
share in proportion to what they hold also bends the photon-transfer curve."""


class Named(NamedTuple):
    """The chosen score, its mechanism ('unknown' when it has no name), and all candidates' probabilities."""

    score: Score
    probe: Probe
    mechanism: str
    candidates: tuple[tuple[str, float], ...]
    ambiguous: bool


def mechanism_of(probe: Probe, allowed: frozenset[str]) -> str:
    """The probe's name if it is registered for this run, else 'unknown'."""
    return probe.mechanism if probe.mechanism in allowed else "unknown"  # type: ignore[return-value]


def _readings(
    score: Score, probe: Probe, located: Located, allowed: frozenset[str]
) -> list[tuple[str, float]]:
    """What a score may mean. Blur of the scenes is done by the camera, with the noise it correlates, or it is
    the reference's: the noise correlation that goes with the fitted blur decides."""
    if score.probe not in BLURS:
        return [(mechanism_of(probe, allowed), score.evidence)]
    mechanism, partner = BLURS[score.probe]
    readings = [("reference_error" if "reference_error" in allowed else "unknown", score.evidence - 1.0)]
    other = located.scores.get(partner)
    if other is not None and mechanism in allowed:
        measured, error = next(iter(other.parameters.values()))[0], other.error
        expected = score.amplitude
        z, shift = measured / error, expected / error
        readings.append((mechanism, score.evidence + z * shift - 0.5 * shift**2))
    return readings


def name(
    located: Located, probes: tuple[Probe, ...], allowed: frozenset[str], log_alpha: float
) -> Named | None:
    """Ranks what the battery rejects by penalised log-likelihood gain; None when it rejects nothing."""
    significant = before_maps(located.significant(log_alpha))
    if not significant:
        return None
    by_name = {p.name: p for p in probes}
    evidence: dict[str, float] = {"unknown": 0.0}
    best: dict[str, Score] = {}
    rejected = {s.probe: s.evidence for s in significant}
    for score in significant:
        other = rejected.get(TOGETHER.get(score.probe, ""), 0.0)
        for mechanism, value in _readings(score, by_name[score.probe], located, allowed):
            value += other - (UNNAMED_NATS if mechanism == "unknown" else 0.0)
            if mechanism not in best or value > evidence[mechanism]:
                evidence[mechanism], best[mechanism] = value, score
    ranked = sorted(best, key=lambda m: -evidence[m])
    chosen = ranked[0]
    values = np.array([evidence[m] for m in evidence])
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    candidates = sorted(zip(evidence, weights.tolist(), strict=True), key=lambda c: (-c[1], c[0] != chosen))
    ties = [m for m in ranked if evidence[chosen] - evidence[m] < TIE_NATS]
    score = best[chosen]
    return Named(score, by_name[score.probe], chosen, tuple(candidates), len(ties) > 1)
