"""Excess noise is what light brings: charge that comes without it is in the darks as well."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from tests.discovery.capture import SIZE, capture_set


def score_of(alter, seed=1, masked=False):
    capture = capture_set(seed, alter, kinds="df", gain=0.5)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    by_name = {s.name: s for s in prepared.signatures}
    fields = prepared.fields
    if masked:
        events = by_name["clocking"]
        fields = events.absorb(fields, events.score(fields))
    return by_name["excess_skewness"].score(fields)


def sparks(rng):
    """Charge in pixels of each frame's own, lit or not."""
    return lambda dn, *_: dn + rng.exponential(25.0, SIZE) * (rng.random(SIZE) < 0.02)


def multiplied(rng):
    """What light there is once more, of an exponential gain: F^2 = 2 about."""

    def change(dn, signal, *_):
        return dn + rng.gamma(np.maximum(signal / 4, 1e-6), 4.0) - signal

    return change


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("masked", [False, True])
def test_charge_without_light_is_no_excess_noise(seed, masked):
    assert score_of(sparks, seed, masked).log_p > np.log(1e-3)


def test_a_random_gain_is():
    found = score_of(multiplied)
    assert found.log_p < np.log(1e-2) and found.amplitude > 0.3
