"""Locate: every signature of the battery against the data, with one error rate for the whole family."""

from __future__ import annotations

import warnings
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.score import Score, sidak
from cannoise_jax.signatures.signature import Signature


class Located(NamedTuple):
    """Scores of one pass, their family-wise log p, and how many tests share the error rate."""

    scores: dict[str, Score]
    log_p: dict[str, float]
    tests: float

    def significant(self, log_alpha: float) -> dict[str, Score]:
        """Scores that the family-wise test rejects, strongest evidence first."""
        rejected = ((n, s) for n, s in self.scores.items() if self.log_p[n] < log_alpha)
        return dict(sorted(rejected, key=lambda s: -s[1].evidence))


class NotJudgedWarning(UserWarning):
    """A signature whose score is no number on these recordings: it is not looked for."""


def _told(name: str, score: Score) -> bool:
    """Whether evidence, p-value and strength are numbers; else it is said, and the others count."""
    # log p may be minus infinity: next to nothing is as unlikely.
    told = bool(np.isfinite([score.evidence, score.amplitude]).all()) and score.log_p <= 0.0
    if not told:
        warnings.warn(
            f"{name}: its score is not a number on these recordings; it is left out",
            NotJudgedWarning,
            stacklevel=3,
        )
    return told


def locate(
    fields: tuple[Fields, ...],
    signatures: tuple[Signature, ...],
    tests: float | None = None,
    known: dict[str, Score] | None = None,
) -> Located:
    """Runs the battery. Every signature's p-value is calibrated for the search inside it; the smallest is
    judged by Sidak's bound with weights (Genovese, Roeder & Wasserman 2006) over `tests`, the sum of the
    weights times `Multiplicity.effective`. known: scores that need not be computed again. What is looked for
    after another one waits as long as that is looked for.
    """
    names = {s.name for s in signatures}
    signatures = tuple(s for s in signatures if s.after not in names)
    scores = dict(known or {})
    missing = [s for s in signatures if s.name not in scores]
    found = zip(missing, each(lambda s: s.score(fields), missing), strict=True)
    scores |= {s.name: score for s, score in found if score is not None and _told(s.name, score)}
    scores = {s.name: scores[s.name] for s in signatures if s.name in scores}
    number = tests or SHARED.effective * sum(p.weight for p in signatures if p.name in scores)
    share = {p.name: p.weight for p in signatures}
    return Located(scores, {n: sidak(s.log_p, number / share[n]) for n, s in scores.items()}, number)
