"""What a simulator has too little of is stated in full, beside what it has."""

from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.in_full import in_full
from cannoise_jax.discovery.proof.judged import own_effects, searched, without_own
from cannoise_jax.discovery.proof.prove import Proofs, unproven
from cannoise_jax.discovery.search import declare
from cannoise_jax.discovery.search.fit import stepwise
from tests.discovery.capture import capture_set
from tests.discovery.test_compare_bank import rows

ENTRIES = declare.registered()
NAMES = frozenset(entry.id for entry in ENTRIES)


@pytest.mark.parametrize("drawn", [0.6, pytest.param(1.0, marks=pytest.mark.slow)])
def test_noise_of_rows_that_lacks_is_that_of_the_recordings_less_that_of_the_draws(drawn):
    own_set = capture_set(11, rows(drawn), kinds="d")
    own = own_effects(own_set, ENTRIES, NAMES, np.log(0.008))
    raw = splits_of(capture_set(12, rows(1.5), kinds="d"), True, own_set, searched(ENTRIES)).looking
    less = without_own(raw, own)
    fitted = stepwise(less.fields, less.signatures, NAMES, np.log(0.008))
    (step,) = fitted.steps
    proofs = unproven(fitted.steps)
    proofs = Proofs((proofs.each[0]._replace(score=step.named.score),), None, None)
    whole, shown = in_full(fitted, proofs, own, raw)
    lacking = np.sqrt(1.5**2 - drawn**2)
    for score in (whole.steps[0].named.score, shown.each[0].score):
        assert score.amplitude == pytest.approx(lacking, rel=0.1)
        assert score.parameters["sigma"][0] == score.amplitude
    assert step.named.score.amplitude < 0.85 * lacking


def test_nothing_changes_where_the_simulator_has_none():
    fitted = SimpleNamespace(steps=(), _replace=lambda steps: steps)
    assert in_full(fitted, Proofs((), None, None), (), None) == ((), Proofs((), None, None))
