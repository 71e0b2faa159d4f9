"""What is handed back and told."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.proof.handed_back import worth_telling
from cannoise_jax.discovery.proof.prove import Proof, Proofs
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt, Named
from cannoise_jax.discovery.search.steps import Fitted, Step
from tests.discovery.looks import SIGNATURES
from tests.discovery.test_jackknife import score_of

DOUBT = Doubt(0.5, ("it is a trace",), "row_noise")


def step_of(name=UNKNOWN, doubt=DOUBT, late=False):
    named = Named(score_of(9.0, 1.0), SIGNATURES["row_additive_temporal"], name, ((name, 1.0),), False, doubt)
    return Step(named, (), -20.0, late)


@pytest.mark.parametrize(
    ("step", "gain", "entered", "told"),
    [
        (step_of(), -1250.0, False, False),
        (step_of(), 0.0, False, False),
        (step_of(), 5.0, False, True),  # it gains
        (step_of(), -3.0, True, True),  # it is in the simulator
        (step_of(doubt=None), -3.0, False, True),  # it never had a name
        (step_of("row_noise", None), -3.0, False, True),
        (step_of(late=True), -3.0, False, True),  # no frame was held back from it
        (step_of(), None, False, True),
    ],
)
def test_what_lost_its_name_and_gains_nothing_is_not_told(step, gain, entered, told):
    other = step_of("row_noise", None)
    proofs = Proofs(tuple(Proof(None, g, np.nan, np.nan, 9) for g in (40.0, gain)), None, None)
    fitted = Fitted((other, step), (), None, None)
    said = []
    after, each = worth_telling(fitted, proofs, (other, step) if entered else (other,), said.append)
    assert after.steps == ((other, step) if told else (other,))
    assert len(each.each) == len(after.steps) and bool(said) is not told
