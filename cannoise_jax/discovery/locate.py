"""Locate: every probe of the battery against the data, with one error rate for the whole family."""

from __future__ import annotations

from typing import NamedTuple

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.score import Probe, Score, sidak

RARE = 0.3
"""Weight of a test whose p is 1 unless something is far off, against 1 of the others: it takes that much less
of the common error rate, and rejects with so little when it does."""
EFFECTIVE = 0.8
"""Independent tests for each one of the battery: several look at the same frames through like templates. The
upper end of the 90 % interval, 0.66 to 0.81, of the r that makes 1 - (1 - p)^r uniform over 240 sets without
an effect (capture sets of the blind proof)."""


class Located(NamedTuple):
    """Scores of one pass, their family-wise log p, and how many tests share the error rate."""

    scores: dict[str, Score]
    log_p: dict[str, float]
    tests: float

    def significant(self, log_alpha: float) -> list[Score]:
        """Scores that the family-wise test rejects, strongest evidence first."""
        return sorted(
            (s for n, s in self.scores.items() if self.log_p[n] < log_alpha), key=lambda s: -s.evidence
        )


def locate(
    fields: tuple[Fields, ...],
    probes: tuple[Probe, ...],
    tests: float | None = None,
    known: dict[str, Score] | None = None,
) -> Located:
    """Runs the battery. Every probe's p-value is calibrated for the search inside it; the smallest is judged
    by Sidak's bound with weights (Genovese, Roeder & Wasserman 2006) over `tests`, the sum of the weights
    times `EFFECTIVE`. known: scores that need not be computed again.
    """
    scores = {}
    for probe in probes:
        score = known[probe.name] if known and probe.name in known else probe.score(fields)
        if score is not None:
            scores[probe.name] = score
    number = tests or EFFECTIVE * sum(weight(p) for p in probes if p.name in scores)
    share = {p.name: weight(p) for p in probes}
    return Located(scores, {n: sidak(s.log_p, number / share[n]) for n, s in scores.items()}, number)


def weight(probe: Probe) -> float:
    """Share of the common error rate that a probe takes, against 1 of most."""
    return RARE if probe.rare else 1.0
