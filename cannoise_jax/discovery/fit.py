"""Fit: forward, one mechanism at a time, the baseline refitted after each; back where one is not needed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from cannoise_jax.discovery.fields import Fields, refit
from cannoise_jax.discovery.locate import Located, locate, weight
from cannoise_jax.discovery.name import Named, name
from cannoise_jax.discovery.statistics.score import Probe, sidak

MOST_STEPS = 12


class Step(NamedTuple):
    """One accepted mechanism, the fields before it was taken out, and the family-wise log p of its probe with
    all other accepted mechanisms in the model."""

    named: Named
    before: tuple[Fields, ...]
    log_p: float


class Fitted(NamedTuple):
    """All accepted steps, the fields that are left, and the last pass of the battery."""

    steps: tuple[Step, ...]
    fields: tuple[Fields, ...]
    last: Located
    first: Located


def _known(located: Located, before: tuple[Fields, ...], after: tuple[Fields, ...], probes: list[Probe]):
    """Scores that stand because what they look at was not touched: those of contrasts when only static fields
    changed."""
    same = all(
        a.contrasts is b.contrasts and a.usable is b.usable for a, b in zip(before, after, strict=True)
    )
    names = {p.name for p in probes if p.axes.get("time") in ("redrawn", "telegraph")} if same else set()
    names -= {"kurtosis", "skewness", "wave_redrawn", "flicker"}  # these see the static fields too
    return {n: s for n, s in located.scores.items() if n in names}


def stepwise(
    fields: tuple[Fields, ...],
    probes: tuple[Probe, ...],
    allowed: frozenset[str],
    log_alpha: float,
    tell: Callable[[str], None] = lambda text: None,
) -> Fitted:
    """Accepts the best-supported mechanism, takes it out, refits, and looks again until nothing is rejected.
    What the final model does not need any more is given up again, the least needed first."""
    first = last = locate(fields, probes)
    start = fields
    steps: list[Step] = []
    given_up: set[str] = set()
    while True:
        steps, fields, last = _forward(
            steps, fields, last, first.tests, probes, given_up, allowed, log_alpha, tell
        )
        final = _in_final_model(steps, first.tests)
        weak = [n for n, step in enumerate(final) if step.log_p > log_alpha]
        if not weak:
            return Fitted(final, fields, last, first)
        gone = steps.pop(max(weak, key=lambda n: final[n].log_p))
        tell(f"given up: {gone.named.mechanism} ({gone.named.probe.name})")
        given_up.add(gone.named.probe.name)
        steps, fields = _again(steps, start)
        last = locate(fields, _active(probes, steps, given_up), first.tests)


def _forward(steps, fields, located, tests, probes, given_up, allowed, log_alpha, tell):
    """Steps added until nothing is rejected, what is left of the fields, and the last pass of the battery."""
    steps = list(steps)
    while len(steps) < MOST_STEPS:
        named = name(located, _active(probes, steps, given_up), allowed, log_alpha)
        if named is None:
            break
        tell(f"step {len(steps) + 1}: {named.mechanism} ({named.probe.name})")
        steps.append(Step(named, fields, located.log_p[named.probe.name]))
        previous, fields = fields, refit(named.probe.absorb(fields, named.score), fields)
        active = _active(probes, steps, given_up)
        located = locate(fields, active, tests, _known(located, previous, fields, list(active)))
    return steps, fields, located


def _active(probes: tuple[Probe, ...], steps: list[Step], given_up: set[str]) -> tuple[Probe, ...]:
    """Probes that can be trusted beside the steps."""
    aside = given_up | {n for s in steps for n in (s.named.probe.name, *s.named.probe.covers)}
    return tuple(p for p in probes if p.name not in aside)


def _again(steps: list[Step], fields: tuple[Fields, ...]) -> tuple[list[Step], tuple[Fields, ...]]:
    """The steps fitted anew from the start, each beside those before it, and what is left of the fields."""
    out = []
    for step in steps:
        score = step.named.probe.score(fields) or step.named.score
        out.append(step._replace(named=step.named._replace(score=score), before=fields))
        fields = refit(step.named.probe.absorb(fields, score), fields)
    return out, fields


def _in_final_model(steps: list[Step], tests: float) -> tuple[Step, ...]:
    """The steps with the p-value that each has when it alone is dropped from the final model. A probe that
    the others leave nothing to look at keeps the p-value of its step."""
    out = []
    for k, step in enumerate(steps):
        fields = step.before
        for later in steps[k + 1 :]:
            fields = refit(later.named.probe.absorb(fields, later.named.score), fields)
        score = step.named.probe.score(fields) if k + 1 < len(steps) else step.named.score
        share = weight(step.named.probe)
        out.append(step if score is None else step._replace(log_p=sidak(score.log_p, tests / share)))
    return tuple(out)
