"""Noise of lines moves whole lines; noise that halves or mirrored parts share moves none."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.whole_lines import in_parts
from cannoise_jax.discovery.search.name import UNKNOWN, Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import capture_set


def lines(axis, sigma):
    def alter(rng):
        def change(dn, *_):
            size = (dn.shape[0], 1) if axis == 0 else (1, dn.shape[1])
            return dn + sigma * rng.standard_normal(size)

        return change

    return alter


def halves(axis):
    """The noise of one half of each line is that of the other."""

    def alter(rng):
        def change(dn, *_):
            height, width = dn.shape
            half = 3 * rng.standard_normal((height, width // 2) if axis == 0 else (height // 2, width))
            return dn + np.concatenate([half, half], 1 - axis)

        return change

    return alter


def mirrored(rng):
    """Four quadrants that are read at once share the noise of their amplifiers."""

    def change(dn, *_):
        one = 3 * rng.standard_normal((dn.shape[0] // 2, dn.shape[1] // 2))
        left = np.concatenate([one, one[::-1]])
        return dn + np.concatenate([left, left[:, ::-1]], 1)

    return change


def step_of(alter, axis, name="row_noise", amplitude=None):
    capture = capture_set(5, alter, read=2.0, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    side = ("row", "column")[axis]
    (signature,) = (s for s in prepared.signatures if s.name == f"{side}_additive_temporal")
    score = signature.score(prepared.fields)
    named = Named(score, signature, name, ((name, 1.0),), False)
    return Step(named, prepared.fields, score.log_p)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("sigma", [0.4, 3.0])
def test_lines_that_move_pass(axis, sigma):
    step = step_of(lines(axis, sigma), axis)
    assert step.log_p < -20 and in_parts(step) is None


@pytest.mark.parametrize("axis, alter", [(0, halves(0)), (1, halves(1)), (0, mirrored), (1, mirrored)])
def test_parts_that_are_alike_are_no_lines(axis, alter):
    step = step_of(alter, axis)
    doubt = in_parts(step)
    assert step.log_p < -20 and doubt is not None and doubt.left > 0.75
    assert "quarters" in doubt.against[0]


def test_nothing_is_said_of_what_has_no_name():
    assert in_parts(step_of(mirrored, 0, UNKNOWN)) is None
