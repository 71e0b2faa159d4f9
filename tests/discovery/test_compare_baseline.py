"""The baseline through rounding and clipping: what was put in comes back, also below a code and beside 0."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.compare.baseline import fitted_baseline, stored_moments, through_codes
from tests.discovery.capture import capture_set


@pytest.mark.parametrize("black, read", [(100.2, 0.3), (100.5, 0.25), (3.0, 3.0), (1.0, 1.5), (64.4, 5.0)])
def test_level_and_noise_come_back_through_their_codes(black, read):
    mean, variance = stored_moments(black, read, 1.0)
    found = through_codes(mean, variance, 1.0)
    assert stored_moments(*found, 1.0) == pytest.approx((mean, variance), rel=1e-3)
    assert found == pytest.approx((black, read), abs=0.02)


def test_stored_moments_are_those_of_rounded_draws():
    rng = np.random.default_rng(1)
    for black, read, step in ((2.0, 2.5, 1.0), (40.6, 0.4, 1.0), (64.0, 3.0, 4.0)):
        codes = np.maximum(np.round((black + read * rng.standard_normal(10**6)) / step) * step, 0)
        mean, variance = stored_moments(black, read, step)
        assert codes.mean() == pytest.approx(mean, abs=0.01)
        assert codes.var() == pytest.approx(variance, rel=0.01)


@pytest.mark.parametrize("read, black, step", [(3.0, 200.0, 1.0), (0.25, 200.0, 1.0), (2.0, 3.0, 1.0)])
def test_the_baseline_of_a_camera(read, black, step):
    capture = capture_set(3, kinds="df", read=read, black=black, gain=1.5, step=step)
    model = fitted_baseline(capture)
    assert np.asarray(model.gain_dn_per_e) == pytest.approx(np.full((1, 4), 1.5), rel=0.03)
    assert np.asarray(model.read_noise_e) == pytest.approx(np.full((1, 4), read), rel=0.03)
    assert np.asarray(model.black_level) == pytest.approx(np.full(4, black), abs=0.06)


def test_single_frames_have_no_baseline():
    assert fitted_baseline(capture_set(4, kinds="d", frames=1)) is None
