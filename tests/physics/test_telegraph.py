"""Jumping pixels of large stacks are told from some of the pixels, at a bounded cost."""

import numpy as np
import pytest

from cannoise_jax.physics.transfer.estimators import telegraph
from cannoise_jax.physics.transfer.estimators.telegraph import rts, told_by
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Recording

JUMP, FRACTION, RATE, READ = 16.0, 0.01, 0.2, 2.0


def dark(size=(160, 192), count=24):
    rng = np.random.default_rng(4)
    jumping = rng.random(size) < FRACTION
    high = np.logical_xor.accumulate(
        np.concatenate([rng.random((1, *size)) < 0.5, rng.random((count - 1, *size)) < RATE])
    )
    values = 300 + READ * rng.standard_normal((count, *size)) + JUMP * jumping * (high - 0.5)
    codes = np.rint(values).astype(np.uint16)
    return frame_statistics(Recording(codes, "MONO", (300.0,) * 4, 4095.0, "made", "dark", exposure_s=1.0))


def test_some_of_the_pixels_tell_of_all(monkeypatch):
    seen = dark()
    monkeypatch.setattr(telegraph, "_MOST_VALUES", 24 * 600)
    odds, sizes = telegraph.telegraph_odds, []
    monkeypatch.setattr(
        telegraph, "telegraph_odds", lambda s, *more: (sizes.append(s.shape[1]), odds(s, *more))[1]
    )
    found = rts([seen])
    assert max(sizes) <= 600
    for name, true in (("jump_dn", JUMP), ("fraction", FRACTION), ("rate", RATE)):
        low, high = found[name].ci90
        middle, reach = (low + high) / 2, high - low
        assert abs(middle - true) < reach, name
        assert reach < 0.4 * true, name


def test_those_taken_stand_for_those_left_out(monkeypatch):
    monkeypatch.setattr(telegraph, "_MOST_VALUES", 4000)
    series = np.random.default_rng(1).standard_normal((10, 5000))
    series[:, :700] *= 3.0
    taken, times = told_by(series, series.std(0))
    assert taken.shape == (10, len(times)) and len(times) == 400
    assert times.sum() == pytest.approx(5000)
    assert times @ (taken**2).sum(0) == pytest.approx((series**2).sum(), rel=0.1)
