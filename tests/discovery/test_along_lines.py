"""Noise of loud columns: that of their pixels, each by itself, or of what reads them one after the other."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.along_lines import pixels_alike
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import capture_set


def louder(rng, shape):
    """Read noise of columns, some of them with three times as much as most."""
    more = np.zeros(shape[1])
    more[rng.choice(shape[1], 14, replace=False)] = rng.uniform(3, 6, 14)
    return more


def of_pixels(rng):
    more = louder(rng, (96, 128))
    return lambda dn, *_: dn + more * rng.standard_normal(dn.shape)


def jumping(rng):
    """Amplifiers that jump between two levels while their column is read."""
    more = louder(rng, (96, 128))

    def change(dn, *_):
        jumps = np.cumsum(rng.random(dn.shape) < 1 / 20, axis=0) % 2
        return dn + 2 * more * (jumps - 0.5)

    return change


def also_blended(rng):
    """All pixels are alike to the next, in loud columns no more than in others."""
    own = of_pixels(rng)

    def change(dn, *given):
        dn = own(dn, *given)
        return dn + 0.3 * np.roll(dn - dn.mean(), 1, axis=0)

    return change


def step_of(alter):
    capture = capture_set(5, alter, read=2.0, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = (s for s in prepared.signatures if s.name == "column_spread")
    score = signature.score(prepared.fields)
    name = signature.mechanism
    return Step(Named(score, signature, name, ((name, 1.0),), False), prepared.fields, score.log_p)


@pytest.mark.parametrize("alter", [of_pixels, also_blended])
def test_read_noise_of_columns_passes(alter):
    step = step_of(alter)
    assert step.log_p < -20 and pixels_alike(step) is None


@pytest.mark.parametrize("hidden", [None, slice(0, None), slice(0, 90)])
def test_columns_that_jump_while_they_are_read_have_no_read_noise_of_their_own(hidden):
    """Whether or not a column of them is masked, as a bad one is, or most of one."""
    step = step_of(jumping)
    if hidden is not None:
        usable = step.before[0].usable.copy()
        usable[hidden, 7] = False
        step = step._replace(before=tuple(f._replace(usable=usable) for f in step.before))
    doubt = pixels_alike(step)
    assert step.log_p < -20 and doubt is not None and "loudest columns" in doubt.against[0]
