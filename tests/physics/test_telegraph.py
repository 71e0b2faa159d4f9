"""Jumping pixels: told from some of the pixels of large stacks, and given back as they were recorded."""

import jax
import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.estimators import telegraph
from cannoise_jax.physics.transfer.estimators.telegraph import heights, lasting, rts, told_by
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.recordings.recording import CaptureSet, Recording

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


def test_jumps_alike_have_heights_alike():
    seen = dark()
    found = heights(seen, JUMP, FRACTION, RATE)
    own = found[found > 0]
    assert (found > 0).mean() == pytest.approx(FRACTION, rel=0.1)
    assert own.mean() == pytest.approx(1, abs=0.03) and own.std() < 0.05


def test_the_mean_of_frames_keeps_what_lasts():
    assert lasting(12, 0.5) == pytest.approx(1 / 12) and lasting(12, 0.0) == 1
    rng = np.random.default_rng(2)
    turns = np.where(rng.random((12, 40_000)) < 0.15, -1.0, 1.0)
    assert lasting(12, 0.15) == pytest.approx(np.mean(np.cumprod(turns, 0).mean(0) ** 2), rel=0.02)


@pytest.mark.slow
def test_a_calibrated_unit_is_as_loud_and_as_uneven_at_its_telegraph_pixels_as_recorded():
    """Traps that are full in a sixth of the frames, of jumps between 20 and 60 DN, in pixels with offsets."""
    rng, size = np.random.default_rng(8), (80, 128)
    jumping, jump = rng.random(size) < 0.02, rng.uniform(20, 60, size)
    offset, taken = 1.5 * rng.standard_normal(size), []
    for kind, light, count in (("dark", 0.0, 16), ("flat", 400.0, 6), ("flat", 1500.0, 6)):
        values = 300 + offset + 0.5 * rng.poisson(light, (count, *size)) + rng.normal(0, 2, (count, *size))
        values += jump * jumping * (rng.random((count, *size)) < 1 / 6)
        codes = np.clip(np.rint(values), 0, 16383).astype(np.uint16)
        taken.append(Recording(codes, "MONO", (300.0,) * 4, 16383.0, "plain", kind, exposure_s=1.0))
    model = sensor_model(*calibrate(CaptureSet("plain", tuple(taken))))
    assert {"rts", "dsnu"} <= {f.mechanism for f in model.mechanisms}
    clean = np.zeros(size, np.float32)
    ours = np.asarray(model.sample(jax.random.key(1), clean, Settings(exposure_s=1.0, frames=16)))
    real, ours = (np.asarray(f, np.float64) for f in (taken[0].frames, ours))
    for where in (jumping, ~jumping):
        assert ours.var(0)[where].mean() == pytest.approx(real.var(0)[where].mean(), rel=0.1)
        uneven = [np.sqrt(np.mean((f.mean(0)[where] - np.median(f)) ** 2)) for f in (real, ours)]
        assert uneven[1] == pytest.approx(uneven[0], rel=0.2)
    loud = [np.mean(f.var(0) > 9 * np.median(f.var(0))) for f in (real, ours)]
    assert loud[1] == pytest.approx(loud[0], rel=0.25)


def test_the_closed_form_knows_how_high_each_pixel_jumps():
    entry = MECHANISMS["rts"].record
    height = np.array([[0.0, 0.5], [1.0, 2.0]])
    effect = entry.effect({"jump_dn": 8.0, "fraction": 0.5, "rate": 0.2}, {"sites": height[None]}, None)
    np.testing.assert_allclose(effect.variance, 16 * height**2)
    np.testing.assert_allclose(effect.fourth, -2 * (16 * height**2) ** 2)
