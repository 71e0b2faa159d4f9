"""The simulator without what it has too much of: all that is found is then fitted beside what is there."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping

import numpy as np

from cannoise_jax.discovery.proof.excess import Excess
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core.sensor import Fitted, SensorModel

SURE = 2.0
"""Standard errors from which on the recordings show some of it, and not none."""


_MOST = 0.5
"""Of what a simulator's draws show of a mechanism, what its own strength is at least, where it is in the same
unit: the rest is what others add to it, as noise along the raster adds to that of rows."""


def shares(found: Iterable[Excess], model: SensorModel | None = None) -> dict[str, float]:
    """Of every mechanism that a simulator has too much of the share that the recordings show. model: the
    simulator, whose own strengths tell what of that others add: variances add, and theirs stays."""
    held = {} if model is None else {f.mechanism: f for f in model.mechanisms}
    return {e.mechanism: _share(e, held.get(e.mechanism)) for e in found}


def _share(e: Excess, fitted: Fitted | None) -> float:
    # Pixels of another unit hide those of this one, which are found with their places once they are gone.
    if e.elsewhere or e.recorded <= SURE * e.recorded_error:
        return 0.0
    first = None if fitted is None else fitted.record.parameters[0]
    if fitted is not None and first is not None and first.name.endswith("_dn"):
        own = float(np.mean(fitted.parameters[first.name]))
        if _MOST * e.simulated < own < e.simulated:
            return float(np.sqrt(max(1 - (e.simulated**2 - e.recorded**2) / own**2, 0.0)))
    return e.recorded / e.simulated


def lowered(model: SensorModel, share: Mapping[str, float]) -> SensorModel | None:
    """The camera model with mechanisms at a share of their strength; None where it has none of these."""
    if not any(fitted.mechanism in share for fitted in model.mechanisms):
        return None
    kept = []
    for fitted in model.mechanisms:
        less = share.get(fitted.mechanism, 1.0)
        if less == 1.0:
            kept.append(fitted)
        elif less > 0:
            kept.append(_at(fitted, less))
    return dataclasses.replace(model, mechanisms=tuple(kept))


def _at(fitted: Fitted, share: float) -> Fitted:
    """The mechanism at a share of its strength; as it is where that does not begin at zero, as a shape."""
    record = fitted.record
    first = next(p for p in record.parameters if p.name == (record.scales or record.parameters[0].name))
    if first.low < 0:
        return fitted
    values = {**fitted.parameters, first.name: fitted.parameters[first.name] * share}
    # A map that is not in units of the strength would keep it.
    return dataclasses.replace(fitted, parameters=values, maps=fitted.maps if record.scales else {})


def at_shares(steps: tuple[Step, ...], share: Mapping[str, float]) -> tuple[Step, ...]:
    """What a simulator's own draws show, at a share of its strength."""
    out = []
    for step in steps:
        less = share.get(step.named.mechanism, 1.0)
        if less == 1.0:
            out.append(step)
        elif less > 0:
            score = step.named.score
            score = step.named.signature.at(score, less * score.amplitude)
            out.append(step._replace(named=step.named._replace(score=score)))
    return tuple(out)
