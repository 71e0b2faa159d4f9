"""Telegraph pixels are noisy again; events that fall anywhere are noisy elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.signatures.returning import halves, returning_log_p
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.looks import SIGNATURES


def jumping(share, height):
    def alter(rng):
        sites = rng.random(SIZE) < share
        return lambda dn, *_: dn + height * sites * (rng.random(SIZE) < 0.5)

    return alter


def events(rate, height):
    """Charge of an electron multiplier's register: exponential, in pixels of each frame's own."""
    return lambda rng: lambda dn, *_: dn + rng.exponential(height, SIZE) * (rng.random(SIZE) < rate)


def fields_of(seed, alter, **more):
    capture = capture_set(seed, alter, kinds="d", **more)
    return prepare(capture, all_frames(split_recordings(capture)), False).fields


def everywhere(fields):
    return np.all([f.usable for f in fields], 0)


@pytest.mark.parametrize(
    "share, height", [(0.001, 40.0), pytest.param(0.01, 20.0, marks=pytest.mark.slow), (0.05, 15.0)]
)
def test_pixels_that_jump_return(share, height):
    fields = fields_of(1, jumping(share, height))
    assert returning_log_p(fields, everywhere(fields)) < -12
    assert SIGNATURES["telegraph"].score(fields).log_p < -12


@pytest.mark.parametrize("rate, height", [(0.002, 100.0), (0.01, 30.0), (0.03, 30.0)])
def test_events_elsewhere_are_no_telegraph_pixels(rate, height):
    fields = fields_of(2, events(rate, height))
    assert returning_log_p(fields, everywhere(fields)) > np.log(1e-3)
    assert SIGNATURES["telegraph"].score(fields).log_p > np.log(1e-3)


@pytest.mark.parametrize("read", [pytest.param(3.0, marks=pytest.mark.slow), 0.5])
def test_its_chance_is_as_stated_also_of_noise_of_few_codes(read):
    told = [fields_of(seed, None, read=read, frames=4) for seed in range(40)]
    p = [np.exp(returning_log_p(fields, everywhere(fields))) for fields in told]
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-3


def test_few_frames_tell_nothing():
    fields = fields_of(3, None, frames=3)
    assert halves(fields) is None and returning_log_p(fields, everywhere(fields)) is None
