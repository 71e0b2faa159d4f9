"""Fit: forward, one mechanism at a time, the baseline refitted after each."""

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
    """Accepts the best-supported mechanism, takes it out, refits, and looks again until nothing is
    rejected."""
    steps: list[Step] = []
    active = list(probes)
    first = located = locate(fields, tuple(active))
    while len(steps) < MOST_STEPS:
        named = name(located, tuple(active), allowed, log_alpha)
        if named is None:
            break
        tell(f"step {len(steps) + 1}: {named.mechanism} ({named.probe.name})")
        steps.append(Step(named, fields, located.log_p[named.probe.name]))
        previous, fields = fields, refit(named.probe.absorb(fields, named.score), fields)
        gone = {named.probe.name, *named.probe.covers}
        active = [p for p in active if p.name not in gone]
        located = locate(fields, tuple(active), first.tests, _known(located, previous, fields, active))
    return Fitted(_in_final_model(steps, first.tests), fields, located, first)


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
