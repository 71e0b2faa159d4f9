"""Locate: every probe of the battery against the data, with one error rate for the whole family."""

from __future__ import annotations

from typing import NamedTuple

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.score import Probe, Score, sidak


class Located(NamedTuple):
    """Scores of one pass, their family-wise log p, and how many tests share the error rate."""

    scores: dict[str, Score]
    log_p: dict[str, float]
    tests: int

    def significant(self, log_alpha: float) -> list[Score]:
        """Scores that the family-wise test rejects, strongest evidence first."""
        return sorted(
            (s for n, s in self.scores.items() if self.log_p[n] < log_alpha), key=lambda s: -s.evidence
        )


def locate(
    fields: tuple[Fields, ...],
    probes: tuple[Probe, ...],
    tests: int | None = None,
    known: dict[str, Score] | None = None,
) -> Located:
    """Runs the battery. Every probe's p-value is calibrated for the search inside it; over the `tests` probes
    the smallest is judged by Sidak's bound, which holds for independent and for positively dependent scores.
    known: scores that need not be computed again.
    """
    scores = {}
    for probe in probes:
        score = known[probe.name] if known and probe.name in known else probe.score(fields)
        if score is not None:
            scores[probe.name] = score
    number = tests or len(scores)
    return Located(scores, {n: sidak(s.log_p, number) for n, s in scores.items()}, number)
