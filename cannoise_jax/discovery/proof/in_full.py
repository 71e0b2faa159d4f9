"""Strength of what a simulator has, but too little of: what it lacks in full."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.proof.prove import Proofs
from cannoise_jax.discovery.search.steps import Fitted, Step, without_all
from cannoise_jax.signatures.score import Score


def in_full(fitted: Fitted, proofs: Proofs, own: Sequence[Step], raw: Prepared) -> tuple[Fitted, Proofs]:
    """Both with the strengths of noise that the simulator has too little of.

    What a simulator has is taken out of the recordings before the rest is looked for: what lines share is
    scaled down to what independent pixels make of it, and what they share beyond that with it. The strength
    that is lacking is that of the recordings as they are less that of the simulator's draws, in quadrature.
    raw: the split that looked, with what the simulator has in it.
    """
    steps, each = list(fitted.steps), list(proofs.each)
    for n, step in enumerate(fitted.steps):
        factor = _factor(step, fitted.steps, own, raw)
        if factor is not None:
            steps[n] = step._replace(named=step.named._replace(score=_scaled(step.named.score, factor)))
            again = each[n].score
            each[n] = each[n] if again is None else each[n]._replace(score=_scaled(again, factor))
    return fitted._replace(steps=tuple(steps)), proofs._replace(each=tuple(each))


def _factor(step: Step, steps: Sequence[Step], own: Sequence[Step], raw: Prepared) -> float | None:
    """By how much more a step is than was found; None where the simulator has none of it."""
    signature, found = step.named.signature, step.named.score
    same = next((o for o in own if o.named.signature.name == signature.name), None)
    if same is None or signature.frozen or found.power != 2 or not found.amplitude > 0:
        return None
    fields = without_all((o for o in own if o is not same), raw.fields)
    whole = signature.score_again(without_all((s for s in steps if s is not step), fields), found)
    if whole is None:
        return None
    lacking = whole.amplitude**2 - same.named.score.amplitude**2
    return float(np.sqrt(lacking) / found.amplitude) if lacking > found.amplitude**2 else None


def _scaled(score: Score, factor: float) -> Score:
    """The score at so many times its strength, and the parameter that is that strength."""
    parameters = {
        name: (factor * value, unit, factor * error) if value == score.amplitude else (value, unit, error)
        for name, (value, unit, error) in score.parameters.items()
    }
    return score.replace(
        amplitude=factor * score.amplitude, error=factor * score.error, parameters=parameters
    )
