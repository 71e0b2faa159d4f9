"""What a simulator's own draws leave as much of as the recordings is no finding."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cannoise_jax.discovery.proof.judged import beyond_draws
from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.discovery.search.name import UNKNOWN, Named
from cannoise_jax.discovery.search.steps import Fitted, Step
from cannoise_jax.signatures.signature import CONTRASTS, FILES

EMPTY = Located({}, {}, 1.0)


def step(amplitude, error, there=None, reads=CONTRASTS, beyond=False):
    """A finding of this strength, and the strength and error that the draws show."""
    drawn = None if there is None else SimpleNamespace(amplitude=there[0], error=there[1])
    signature = SimpleNamespace(name="lags", reads=reads, beyond=beyond, score=lambda fields: drawn)
    score = SimpleNamespace(amplitude=amplitude, error=error)
    return Step(Named(score, signature, UNKNOWN, ((UNKNOWN, 1.0),), False), (), -15.0)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("found", "given_up"),
    [
        (step(0.0106, 0.002, (0.0068, 0.002)), True),
        (step(0.0306, 0.002, (0.0068, 0.002)), False),  # far more of it
        (step(0.0106, 0.002, (0.0030, 0.002)), False),  # the draws show none of it
        (step(0.0106, 0.002, None), False),
        (step(0.0106, 0.002, (0.0068, float("inf"))), False),
        (step(0.0106, 0.002, (0.0068, 0.002), reads=FILES), False),  # of what files state
        (step(0.0106, 0.002, (0.0068, 0.002), beyond=True), False),  # judged beside the draws as it is
    ],
)
def test_only_what_the_draws_show_as_much_of_is_given_up(found, given_up):
    said = []
    left = beyond_draws(Fitted((found,), (), EMPTY, EMPTY), (step(1.0, 0.1),), said.append)
    assert len(left.steps) == (0 if given_up else 1)
    assert bool(said) == given_up


def test_without_draws_of_its_own_nothing_is_given_up():
    found = step(0.0106, 0.002, (0.0068, 0.002))
    assert beyond_draws(Fitted((found,), (), EMPTY, EMPTY), ()).steps == (found,)
