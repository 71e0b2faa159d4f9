"""Whether what a search has accepted is needed once all of it is known: the evidence of each step beside all
others."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Set
from types import MappingProxyType

from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step, changed, without
from cannoise_jax.signatures.score import sidak

_FAR_MORE = 10.0
"""Times the evidence of what all frames together alone show, in nats, at which a step stands beside it."""


def standing(steps: list[Step], judged: list[Step], final: tuple[Step, ...], level: float) -> dict[int, Step]:
    """Steps by place whose p-value in the final model stays as it was `judged`: all that is new was seen in
    all frames together alone, and has far less evidence than they, of which it can take away no more."""
    if [id(s) for s in steps[: len(judged)]] != [id(s) for s in judged]:
        return {}
    new = steps[len(judged) :]
    if not (judged and new and all(s.late for s in new)):
        return {}
    most = sum(max(s.named.score.evidence, 0.0) for s in steps if s.late)
    return {n: s for n, s in enumerate(final) if s.log_p < level - _FAR_MORE * most}


def _bearing(
    steps: list[Step], moved: list[frozenset[str]], taken: list[int], reads: frozenset[str]
) -> list[int]:
    """Of the steps that are taken out those that change anything of what is read, or of what those read that
    do. Of the last step it is not known what it changes."""
    out = []
    for n in reversed(taken):
        if n >= len(moved) or moved[n] & reads:
            out.append(n)
            reads = reads | steps[n].named.signature.reads
    return out[::-1]


def in_final_model(
    steps: list[Step],
    tests: float,
    needed: Set[str],
    stand: Mapping[int, Step] = MappingProxyType({}),
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Step, ...]:
    """The steps with the p-value that each has when it alone is dropped from the final model. A signature
    that the others leave nothing to look at, or that is `needed`, keeps the p-value of its step; those that
    `stand` are known. What is left of an effect that is known but approximately, and has no name, does not
    make it superfluous; nor do those that set the pixels aside by which it is seen, and in which it would be
    counted, or that hold it as well, so that it was judged before them."""
    moved = [changed(step.before, after.before) for step, after in zip(steps, steps[1:], strict=False)]

    def alone(k: int) -> Step:
        if k in stand:
            return stand[k]
        step = steps[k]
        if step.late or step.named.signature.name in needed:
            return step
        fields, own = step.before, step.named.signature
        holds_it = {*(own.found_in if own.single_pixels else ()), *own.before(step.named.score)}
        taken = [
            n
            for n in range(k + 1, len(steps))
            if not (own.approximate and steps[n].named.mechanism == UNKNOWN)
            and steps[n].named.signature.name not in holds_it
        ]
        for n in _bearing(steps, moved, taken, step.named.signature.reads):
            fields = without(steps[n].named, fields, fields)
        found = step.named.score
        score = own.refitted(fields, found) if k + 1 < len(steps) else found
        share = step.named.signature.weight
        return step if score is None else step._replace(log_p=sidak(score.log_p, tests / share))

    return tuple(each(alone, range(len(steps)), tell, "each step beside the others"))
