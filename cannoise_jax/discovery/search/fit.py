"""Fit: forward, one mechanism at a time, the baseline refitted after each; back where one is not needed.

The frames that look are not all frames, so that some are left to prove with. What they suspect but cannot
show gets a second look with all frames together, at its own share of the error rate: such a finding is seen
sooner, but no frame is left to confirm it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool

from cannoise_jax.discovery.search.final_model import in_final_model, standing
from cannoise_jax.discovery.search.locate import Located, locate
from cannoise_jax.discovery.search.name import Named, name
from cannoise_jax.discovery.search.steps import Fitted, Step, changed, without
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

MOST_STEPS = 25
"""A bound on time: longer lists than this are no explanation."""
_STANDS_FAR_OUT = 30.0
"""Nats of a finding from which on another of its kind is looked for. Weak ones may be of something that is
found only later: in noise of rows that something else hid for a while, lines of up to 12 were found."""
_SOME = 0.05
"""Share of the pixels that a finding takes out, beyond chance, that another one takes out in its stead. With
each that is hit by charge its neighbours go, a ninth of them at least being those that were hit."""


class Search(NamedTuple):
    """What does not change while steps are added: the signatures, the names that may be given, how many tests
    share the error rate, log of the share of alpha that one look may spend, and who is told."""

    signatures: tuple[Signature, ...]
    allowed: frozenset[str]
    tests: float
    level: float
    tell: Callable[[str], None]


def known(
    located: Located,
    before: tuple[Fields, ...],
    after: tuple[Fields, ...],
    signatures: tuple[Signature, ...],
) -> dict[str, Score]:
    """Scores that stand because nothing that they read of the fields has changed."""
    moved = changed(before, after)
    return {
        s.name: located.scores[s.name] for s in signatures if s.name in located.scores and not s.reads & moved
    }


def stepwise(
    fields: tuple[Fields, ...],
    signatures: tuple[Signature, ...],
    allowed: frozenset[str],
    log_alpha: float,
    *,
    tell: Callable[[str], None] = lambda text: None,
    every: Callable[[], tuple[Fields, ...]] | None = None,
    located: Located | None = None,
) -> Fitted:
    """Accepts the best-supported mechanism, takes it out, refits, and looks again until nothing is rejected.
    What the final model does not need any more is given up again, the least needed first; pixels that stand
    out only where nothing else is found in their stead. every: the fields of all frames, for a second look
    at what is suspected; without it all of alpha is spent on the first. located: the first pass of the
    battery, where it was run already.
    """
    share = SHARED.looking if every else 1.0
    first = last = located or locate(fields, signatures)
    search = Search(signatures, allowed, first.tests, log_alpha + float(np.log(share)), tell)
    start = fields
    steps: list[Step] = []
    judged: list[Step] = []
    final: tuple[Step, ...] = ()
    given_up: set[str] = set()
    needed: set[str] = set()
    while True:
        steps, fields, last = _forward(search, steps, fields, last, given_up)
        if [id(s) for s in steps] != [id(s) for s in judged]:
            stand = standing(steps, judged, final, search.level)
            judged, final = list(steps), in_final_model(steps, first.tests, needed, stand, tell)
        weak = [n for n, step in enumerate(final) if not step.late and step.log_p > search.level]
        if not weak:
            late = None
            if every and len(steps) < MOST_STEPS:
                active = _active(signatures, steps, given_up)
                late = second_look(
                    steps, last, every, active,
                    allowed=allowed, tests=first.tests, log_alpha=log_alpha, tell=tell,
                )  # fmt: skip
            if late is None:
                charged = (s if s.late else s._replace(log_p=charge(s.log_p, share)) for s in final)
                return Fitted(tuple(s._replace(left=fields) for s in charged), fields, last, first)
            named, log_p = late
            tell(f"step {len(steps) + 1}, all frames: {named.mechanism} ({named.signature.name})")
            steps.append(Step(named, fields, log_p, late=True, rivals=_evidence(last)))
            fields = without(named, fields, fields)
            last = locate(fields, _active(signatures, steps, given_up), first.tests)
            continue
        n = max(weak, key=lambda n: final[n].log_p)
        gone = steps[n].named
        without_it = given_up | {gone.signature.name}
        others, left = _again([*steps[:n], *steps[n + 1 :]], start)
        active = _active(signatures, others, without_it)
        seen = locate(left, active, first.tests)
        taken = _taken(steps, n, fields)
        # What it only kept from being asked is no other explanation.
        kept_off = {*gone.signature.covers, *gone.signature.hides(gone.score)}
        more = seen._replace(scores={n: s for n, s in seen.scores.items() if n not in kept_off})
        if taken.any() and (name(more, active, allowed, search.level) or _others_take(taken, left)):
            needed.add(gone.signature.name)
            final = (*final[:n], steps[n], *final[n + 1 :])
            continue
        tell(f"given up: {gone.mechanism} ({gone.signature.name})")
        steps, fields, last, given_up = others, left, seen, without_it


def _taken(steps: list[Step], n: int, left: tuple[Fields, ...]) -> Bool[np.ndarray, "r h w"]:
    """The pixels of every recording that a step takes out. Maps of all pixels that are fitted with these in
    them take in what makes them stand out, so that it seems superfluous; what they cannot take in is then
    found elsewhere, or taken out as something else."""
    before, after = steps[n].before, steps[n + 1].before if n + 1 < len(steps) else left
    return np.stack([f.usable & ~g.usable for f, g in zip(before, after, strict=True)])


def _others_take(taken: Bool[np.ndarray, "r h w"], left: tuple[Fields, ...]) -> bool:
    """Whether of the pixels that a step took out far more are taken out without it too than of all."""
    gone = np.stack([~f.usable for f in left])
    return bool(np.sum(taken & gone) > (_SOME + 2 * np.mean(gone)) * np.sum(taken))


def charge(log_p: float, share: float) -> float:
    """log p of a test that may spend `share` of the error rate."""
    return min(0.0, log_p - float(np.log(share)))


def second_look(
    steps: list[Step],
    last: Located,
    every: Callable[[], tuple[Fields, ...]],
    signatures: tuple[Signature, ...],
    *,
    allowed: frozenset[str],
    tests: float,
    log_alpha: float,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Named, float] | None:
    """What all frames together reject of that which the frames that look suspect, with the score of the
    latter and the family-wise log p of the former; None where there is no suspicion or it does not hold."""
    if not last.log_p or min(last.log_p.values()) > np.log(SHARED.suspect):
        return None
    doubtful = tuple(
        p
        for p in signatures
        if p.name in last.scores and last.scores[p.name].log_p < np.log(SHARED.candidate)
    )
    fields = every()
    for number, step in enumerate(steps):
        tell(f"all frames: {number} of {len(steps)}")
        # Fields of all frames before each step are not kept: they are as large as the recordings.
        fields = without(_fitted_anew(step, fields).named, fields, fields)
    together = locate(fields, doubtful, tests)
    named = name(together, doubtful, allowed, log_alpha + float(np.log(SHARED.together)))
    if named is None:
        return None
    log_p = charge(together.log_p[named.signature.name], SHARED.together)
    return named._replace(score=last.scores[named.signature.name]), log_p


def _forward(
    search: Search, steps: list[Step], fields: tuple[Fields, ...], located: Located, given_up: set[str]
) -> tuple[list[Step], tuple[Fields, ...], Located]:
    """Steps added until nothing is rejected, what is left of the fields, and the last pass of the battery.

    What was not rejected is looked at again only once all that was rejected is taken out: most of a pass
    over large frames goes to statistics of effects that are not there.
    """
    steps, old = list(steps), set[str]()
    while True:
        active = _active(search.signatures, steps, given_up)
        full = len(steps) == MOST_STEPS
        named = None if full else name(located, active, search.allowed, search.level)
        if named is None:
            if not old:
                return steps, fields, located
            located = locate(
                fields, active, search.tests, {n: s for n, s in located.scores.items() if n not in old}
            )
            old = set()
            continue
        search.tell(f"step {len(steps) + 1}: {named.mechanism} ({named.signature.name})")
        previous, before = fields, steps
        found = Step(named, fields, located.log_p[named.signature.name], rivals=_evidence(located))
        steps, fields = _accepted(before, found)
        active = _active(search.signatures, steps, given_up)
        same = known(located, previous, fields, active)
        # What was not rejected while more was taken out may be now.
        put_off = {
            s.name: located.scores[s.name]
            for s in active
            if len(steps) > len(before)
            and s.name not in same
            and located.log_p.get(s.name, -np.inf) >= search.level
        }
        old = {s.name for s in active if s.name in old} | put_off.keys()
        located = locate(fields, active, search.tests, {**same, **put_off})


def _evidence(located: Located) -> dict[str, float]:
    return {name: score.evidence for name, score in located.scores.items()}


def _accepted(steps: list[Step], new: Step) -> tuple[list[Step], tuple[Fields, ...]]:
    """The steps with one more, without those in which it was counted, which are to be found anew; and what is
    left of the fields."""
    names = new.named.signature.found_in
    inside = [n for n, s in enumerate(steps) if s.named.signature.name in names and not s.late]
    if inside:
        return _beneath(steps, new, inside)
    after = (n for n, step in enumerate(steps) if new.named.signature.precedes(step.named.signature))
    at = next(after, len(steps))
    out, fields = steps[:at], steps[at].before if at < len(steps) else new.before
    for step in (new, *steps[at:]):
        named = step.named
        if step is not new and named.signature.map_of:
            named = named._replace(score=named.signature.score(fields) or named.score)
        out.append(step._replace(named=named, before=fields))
        fields = without(named, fields, fields)
    return out, fields


def _beneath(steps: list[Step], new: Step, inside: list[int]) -> tuple[list[Step], tuple[Fields, ...]]:
    """The steps with one more in the place of the first of those `inside`, which are left out."""
    first, found = inside[0], new.named
    fields = steps[first].before
    look = found.signature.again
    score = look(fields, found.score) if look else found.signature.score(fields)
    own = new._replace(named=found._replace(score=score or found.score), before=fields)
    kept = [s for n, s in enumerate(steps) if n > first and n not in inside]
    later, left = _again(kept, without(own.named, fields, fields))
    return [*steps[:first], own, *later], left


def _active(
    signatures: tuple[Signature, ...], steps: list[Step], given_up: set[str]
) -> tuple[Signature, ...]:
    """Signatures that can be trusted beside the steps, those that are looked for after another one once that
    is a step that stands out far."""
    found = [(s.named.signature, s.named.score) for s in steps]
    names = {p.name for p, _ in found}
    covered = [(p.name, n) for p, score in found for n in (*p.covers, *p.hides(score))]
    doubtful = given_up | {n for _, n in covered}
    by_others = given_up | {n for own, n in covered if n != own}
    before = {"", *({p.name for p, score in found if score.evidence > _STANDS_FAR_OUT} - by_others)}
    return tuple(p for p in signatures if p.name not in doubtful | names and p.after in before)


def _fitted_anew(step: Step, fields: tuple[Fields, ...]) -> Step:
    """The step with the score that it has in these fields."""
    found = step.named.score
    score = step.named.signature.refitted(fields, found) or found
    return step._replace(named=step.named._replace(score=score), before=fields)


def _again(steps: Sequence[Step], fields: tuple[Fields, ...]) -> tuple[list[Step], tuple[Fields, ...]]:
    """The steps fitted anew from the start, each beside those before it, and what is left of the fields."""
    out = []
    for step in steps:
        out.append(_fitted_anew(step, fields))
        fields = without(out[-1].named, fields, fields)
    return out, fields
