"""The interval of a gain by leaving out parts of the frames."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.proof.gains import jackknife_interval
from cannoise_jax.signatures.score import Score
from tests.discovery.looks import white


def score_of(gain, shift):
    told = {"log_p": -9.0, "penalty": 0.0, "amplitude": 1.0, "error": np.inf, "power": 1}
    return Score(**told, gain=gain, shift=shift, parameters={}, where={"axis": "pixel"})


def signature_of(gains, banded=True, time="frozen"):
    """A signature whose scores of what is left gain so much each, and know half of what all frames do."""
    told = iter(gains)

    def again(fields, found):
        return score_of(next(told), 2.0)

    return SimpleNamespace(
        axes=SimpleNamespace(in_bands=banded, time=time), redraws_frames=False, score_again=again
    )


@pytest.mark.parametrize("each, low", [((90.0, 80.0, 85.0, 95.0), None), ((30.0, 15.0, 25.0, 20.0), 40.0)])
def test_the_interval_holds_the_gain(each, low):
    fields = white(np.random.default_rng(0), kinds=("dark",) * 2, size=(64, 64))
    score = score_of(100.0, 1.0)
    ends = jackknife_interval(signature_of([*each] * 4), fields, score, score, 100.0)
    assert ends[0] <= 100.0 <= ends[1]
    # Parts that all gain more than the whole, as much as they know, bound nothing.
    assert low is None or ends[0] >= low


@pytest.mark.parametrize("time, shown", [("redrawn", True), ("frozen", False)])
def test_frames_that_lie_far_apart_confirm_what_any_of_them_may_be_left_out_of(time, shown):
    """A lamp that flickers strongly: each frame gains by the square of what it has of it."""
    fields = white(np.random.default_rng(0), kinds=("dark",) * 2, size=(64, 64), frames=4)
    score = score_of(1000.0, 1.0)
    signature = signature_of([300.0, 900.0, 100.0, 80.0, 120.0, 60.0] * 4, False, time)
    low, _ = jackknife_interval(signature, fields, score, score.replace(shift=2.0), 1000.0)
    assert (low > 0) is shown
