"""What a simulator has too much of, or of the same pixels too little, in a report."""

from __future__ import annotations

from typing import Any

from cannoise_jax.discovery.proof.excess import Excess
from cannoise_jax.discovery.proof.lowered import SURE
from cannoise_jax.discovery.report.wording import amount
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.vocabulary import Term


def too_much(found: Excess, term: Term) -> dict[str, Any]:
    """A mechanism of which the simulator has another strength."""

    def size(value: float, error: float) -> dict[str, Any]:
        ci90 = [max(value - Z90 * error, 0.0), value + Z90 * error]
        return {"value": value, "unit": term.unit, "ci90": ci90}

    simulated = size(found.simulated, found.simulated_error)
    recorded = size(found.recorded, found.recorded_error)
    seen = found.recorded > SURE * found.recorded_error
    shown = found.recorded if seen else recorded["ci90"][1]
    said, here = (amount(v, term.unit, term.amplitude) for v in (found.simulated, shown))
    name = found.mechanism.replace("_", " ")
    return {
        "mechanism": found.mechanism,
        "sign": found.sign,
        "simulated": simulated,
        "recorded": recorded,
        "sentence": f"The simulator has {said} of {name}, the recordings {'' if seen else 'at most '}{here}.",
    }
