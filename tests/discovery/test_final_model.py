"""What a search has accepted beside all that it has accepted: which p-values stand."""

from __future__ import annotations

from types import SimpleNamespace

from cannoise_jax.discovery.search.final_model import standing
from cannoise_jax.discovery.search.steps import Step

LEVEL = -6.0


def step(evidence: float, log_p: float, late: bool = False) -> Step:
    return Step(SimpleNamespace(score=SimpleNamespace(evidence=evidence)), (), log_p, late)


def test_what_all_frames_alone_show_takes_nothing_from_what_stands_far_out():
    old = [step(500, -500), step(30, -30)]
    new = step(4, -9, late=True)
    assert standing([*old, new], old, tuple(old), LEVEL) == {0: old[0]}


def test_what_the_frames_that_look_show_may():
    old = [step(500, -500)]
    assert standing([*old, step(4, -9)], old, tuple(old), LEVEL) == {}
    assert standing([*old, step(60, -9, late=True)], old, tuple(old), LEVEL) == {}


def test_so_may_another_order_of_steps_and_nothing_new_is_judged_again():
    old = [step(500, -500), step(400, -400)]
    new = step(4, -9, late=True)
    assert standing([old[1], old[0], new], old, tuple(old), LEVEL) == {}
    assert standing(old, [], (), LEVEL) == {}
