"""Fit: forward, one mechanism at a time, the baseline refitted after each; back where one is not needed.

The frames that look are not all frames, so that some are left to prove with. What they suspect but cannot
show gets a second look with all frames together, at its own share of the error rate: such a finding is seen
sooner, but no frame is left to confirm it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.fields import Fields, refit
from cannoise_jax.discovery.locate import Located, locate, weight
from cannoise_jax.discovery.name import Named, name
from cannoise_jax.discovery.statistics.score import Probe, sidak
from cannoise_jax.discovery.statistics.spectra import below_frame

MOST_STEPS = 25
SPENT = (0.6, 0.4)
"""Shares of alpha: of the frames that look, and of all frames together. They add up to one, so that the error
rate of the whole is kept whatever the two looks have in common."""
SUSPECT = 0.3
"""Family-wise p of the frames that look from which on a second look is worth its time."""
_CANDIDATE = 0.05
"""p of a single probe, of the frames that look, from which on it takes part in the second."""


class Step(NamedTuple):
    """One accepted mechanism, the fields before it was taken out, and the family-wise log p of its probe with
    all other accepted mechanisms in the model. late: it took all frames together to see it."""

    named: Named
    before: tuple[Fields, ...]
    log_p: float
    late: bool = False


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
    # These see the static fields too.
    names -= {"kurtosis", "light_tails", "skewness", "wave_redrawn", "flicker"}
    return {n: s for n, s in located.scores.items() if n in names}


def stepwise(
    fields: tuple[Fields, ...],
    probes: tuple[Probe, ...],
    allowed: frozenset[str],
    log_alpha: float,
    tell: Callable[[str], None] = lambda text: None,
    every: Callable[[], tuple[Fields, ...]] | None = None,
) -> Fitted:
    """Accepts the best-supported mechanism, takes it out, refits, and looks again until nothing is rejected.
    What the final model does not need any more is given up again, the least needed first. every: the fields
    of all frames, for a second look at what is suspected; without it all of alpha is spent on the first.
    """
    shares = SPENT if every else (1.0, 0.0)
    level = log_alpha + float(np.log(shares[0]))
    first = last = locate(fields, probes)
    start = fields
    steps: list[Step] = []
    given_up: set[str] = set()
    while True:
        steps, fields, last = _forward(
            steps, fields, last, first.tests, probes, given_up, allowed, level, tell
        )
        final = _in_final_model(steps, first.tests)
        weak = [n for n, step in enumerate(final) if not step.late and step.log_p > level]
        if not weak:
            late = None
            if every and len(steps) < MOST_STEPS:
                active = _active(probes, steps, given_up)
                late = second_look(steps, last, every, active, allowed, first.tests, log_alpha)
            if late is None:
                charged = (s if s.late else s._replace(log_p=charge(s.log_p, shares[0])) for s in final)
                return Fitted(tuple(charged), fields, last, first)
            named, log_p = late
            tell(f"step {len(steps) + 1}, all frames: {named.mechanism} ({named.probe.name})")
            steps.append(Step(named, fields, log_p, late=True))
            fields = refit(named.probe.absorb(fields, named.score), fields)
            last = locate(fields, _active(probes, steps, given_up), first.tests)
            continue
        gone = steps.pop(max(weak, key=lambda n: final[n].log_p))
        tell(f"given up: {gone.named.mechanism} ({gone.named.probe.name})")
        given_up.add(gone.named.probe.name)
        steps, fields = _again(steps, start)
        last = locate(fields, _active(probes, steps, given_up), first.tests)


def charge(log_p: float, share: float) -> float:
    """log p of a test that may spend `share` of the error rate."""
    return min(0.0, log_p - float(np.log(share)))


def second_look(
    steps: list[Step],
    last: Located,
    every: Callable[[], tuple[Fields, ...]],
    probes: tuple[Probe, ...],
    allowed: frozenset[str],
    tests: float,
    log_alpha: float,
) -> tuple[Named, float] | None:
    """What all frames together reject of that which the frames that look suspect, with the score of the
    latter and the family-wise log p of the former; None where there is no suspicion or it does not hold."""
    if not last.log_p or min(last.log_p.values()) > np.log(SUSPECT):
        return None
    doubtful = tuple(
        p for p in probes if p.name in last.scores and last.scores[p.name].log_p < np.log(_CANDIDATE)
    )
    fields = _again(steps, every())[1]
    together = locate(fields, doubtful, tests)
    named = name(together, doubtful, allowed, log_alpha + float(np.log(SPENT[1])))
    if named is None:
        return None
    log_p = charge(together.log_p[named.probe.name], SPENT[1])
    return named._replace(score=last.scores[named.probe.name]), log_p


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
    found = [(s.named.probe, s.named.score) for s in steps]
    aside = given_up | {n for p, score in found for n in (p.name, *p.covers, *p.hides(score))}
    return tuple(p for p in probes if p.name not in aside)


def _again(steps: list[Step], fields: tuple[Fields, ...]) -> tuple[list[Step], tuple[Fields, ...]]:
    """The steps fitted anew from the start, each beside those before it, and what is left of the fields."""
    out = []
    for step in steps:
        score = step.named.probe.score(fields) or step.named.score
        out.append(step._replace(named=step.named._replace(score=score), before=fields))
        fields = refit(step.named.probe.absorb(fields, score), fields)
    return out, fields


def part_of(steps: tuple[Step, ...]) -> dict[int, int]:
    """Steps that are the slow part of another: means of frames that move no more than 1/f noise slower than a
    frame moves them, and the step with that noise."""
    slopes = [n for n, s in enumerate(steps) if s.named.probe.name in ("raster_slope", "row_slope")]
    out = {}
    for n, step in enumerate(steps):
        score = step.named.score
        if step.named.probe.name != "frame_additive":
            continue
        for slope in slopes:
            size = step.before[0].mean.shape
            if score.amplitude - 1.645 * score.error < below_frame(steps[slope].named.score, size):
                out[n] = slope
    return out


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
        out.append(
            step if score is None or step.late else step._replace(log_p=sidak(score.log_p, tests / share))
        )
    return tuple(out)
