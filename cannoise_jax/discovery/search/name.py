"""Name: which of the mechanisms that could have done it did, with probabilities, ties kept as ties."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cannoise_jax import vocabulary
from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

UNKNOWN = vocabulary.UNKNOWN.id
"""What a structure is called that no mechanism explains."""
TIE_NATS = 3.0
"""Difference of evidence below which two names are one tie: a Bayes factor of 20, from which on evidence is
strong (Kass & Raftery, Bayes factors, J. Am. Stat. Assoc. 90, 773, 1995)."""
UNNAMED_NATS = 3.0
"""What a mechanism without a name must gain beyond the best named one: as much as parts two names
(`TIE_NATS`)."""


class Doubt(NamedTuple):
    """Why a name is not enough: the share of the mismatch of its own part that it leaves, and what that is,
    in words; nearest: the name; instead: whether the words say another reason than what is left."""

    left: float
    against: tuple[str, ...]
    nearest: str = ""
    instead: bool = False


class Named(NamedTuple):
    """The chosen score, its mechanism ('unknown' when it has no name), and all candidates' probabilities.
    doubt: of the name that came nearest and was withdrawn; None: none was."""

    score: Score
    signature: Signature
    mechanism: str
    candidates: tuple[tuple[str, float], ...]
    ambiguous: bool
    doubt: Doubt | None = None

    def withdrawn(self, doubt: Doubt) -> Named:
        """Without its name, which only comes nearest: what spoke for it now speaks for something unknown."""
        chances = dict(self.candidates)
        chances[UNKNOWN] = chances.get(UNKNOWN, 0.0) + chances[self.mechanism]
        chances[self.mechanism] = 0.0
        candidates = tuple(sorted(chances.items(), key=lambda c: (c[0] != UNKNOWN, -c[1])))
        doubt = doubt._replace(nearest=self.mechanism)
        return self._replace(mechanism=UNKNOWN, candidates=candidates, ambiguous=False, doubt=doubt)


def mechanism_of(signature: Signature, allowed: frozenset[str]) -> str:
    """The signature's mechanism if it is registered for this run, else 'unknown'."""
    return signature.mechanism if signature.mechanism in allowed else UNKNOWN  # type: ignore[return-value]


def _readings(
    score: Score, signature: Signature, located: Located, allowed: frozenset[str]
) -> list[tuple[str, float]]:
    """What a score may mean, of the mechanisms that this run may name; the first of them else unnamed."""
    first, *others = signature.read_as(score, located.scores)
    main = first[0] if first[0] in allowed else UNKNOWN
    return [(str(main), first[1]), *((str(m), value) for m, value in others if m in allowed)]


def name(
    located: Located, signatures: tuple[Signature, ...], allowed: frozenset[str], log_alpha: float
) -> Named | None:
    """Ranks what the battery rejects by penalised log-likelihood gain; None when it rejects nothing."""
    by_name = {p.name: p for p in signatures}
    significant = located.significant(log_alpha)
    if not significant:
        return None
    significant = _judged_before(next(iter(significant)), significant, by_name) or significant
    found = _ranked(significant, by_name, located, allowed)
    first = _judged_before(found.signature.name, significant, by_name)
    return _ranked(first, by_name, located, allowed) if first else found


def _judged_before(
    one: str, significant: dict[str, Score], by_name: dict[str, Signature]
) -> dict[str, Score]:
    """The rejected scores that must be judged before one of them."""
    return {n: s for n, s in significant.items() if one in by_name[n].before(s)}


def _ranked(
    significant: dict[str, Score], by_name: dict[str, Signature], located: Located, allowed: frozenset[str]
) -> Named:
    """The name of the most evidence, that of what it is lifted by and of each of its readings with it."""
    evidence: dict[str, float] = {UNKNOWN: 0.0}
    best: dict[str, str] = {}
    for which, score in significant.items():
        signature = by_name[which]
        lifted = sum(other.evidence for n, other in significant.items() if n in signature.lifted_by)
        for mechanism, value in _readings(score, signature, located, allowed):
            value += lifted - (UNNAMED_NATS if mechanism == UNKNOWN else 0.0)
            if mechanism not in best or value > evidence[mechanism]:
                evidence[mechanism], best[mechanism] = value, which
    ranked = sorted(best, key=lambda m: -evidence[m])
    chosen = ranked[0]
    values = np.array([evidence[m] for m in evidence])
    weights = np.exp(values - values.max())
    weights /= weights.sum()
    candidates = sorted(zip(evidence, weights.tolist(), strict=True), key=lambda c: (-c[1], c[0] != chosen))
    ties = [m for m in ranked if evidence[chosen] - evidence[m] < TIE_NATS]
    which = best[chosen]
    return Named(significant[which], by_name[which], chosen, tuple(candidates), len(ties) > 1)
