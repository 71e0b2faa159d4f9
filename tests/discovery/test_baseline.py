"""The baseline through rounding and clipping: what was put in comes back, also below a code and beside 0."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.full import mark_full
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.physics.core.rounding import before_rounding, stored_moments
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.crop import central
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.signatures.recorded import Level
from tests.discovery.capture import SIZE, capture_set, row_offsets


@pytest.mark.parametrize("black, read", [(100.2, 0.3), (100.5, 0.25), (3.0, 3.0), (1.0, 1.5), (64.4, 5.0)])
def test_level_and_noise_come_back_through_their_codes(black, read):
    mean, variance = stored_moments(black, read, 1.0)
    found = before_rounding(mean, variance, 1.0)
    assert stored_moments(*found, 1.0) == pytest.approx((mean, variance), rel=1e-3)
    assert found == pytest.approx((black, read), abs=0.02)


@pytest.mark.parametrize(
    "black, read, step, spread", [(2.0, 2.5, 1, 0), (40.6, 0.4, 1, 0), (64, 3, 4, 0), (40.6, 0.25, 1, 0.4)]
)
def test_stored_moments_are_those_of_rounded_draws(black, read, step, spread):
    rng = np.random.default_rng(1)
    offsets = spread * rng.standard_normal(10**4)
    drawn = black + offsets + read * rng.standard_normal((200, 10**4))
    codes = np.maximum(np.round(drawn / step) * step, 0)
    mean, variance = stored_moments(black, read, step, spread)
    assert codes.mean() == pytest.approx(mean, abs=0.015)
    assert codes.var(0, ddof=1).mean() == pytest.approx(variance, rel=0.015)


@pytest.mark.parametrize("read, black, step", [(3.0, 200.0, 1.0), (0.25, 200.0, 1.0), (2.0, 3.0, 1.0)])
def test_the_baseline_of_a_camera(read, black, step):
    capture = capture_set(3, kinds="df", read=read, black=black, gain=1.5, step=step)
    model = baseline_model(capture, prepare(capture, all_frames(split_recordings(capture)), False))
    assert np.asarray(model.gain_dn_per_e) == pytest.approx(np.full((1, 4), 1.5), rel=0.03)
    assert np.asarray(model.read_noise_e) == pytest.approx(np.full((1, 4), read), rel=0.03)
    assert np.asarray(model.black_level) == pytest.approx(np.full(4, black), abs=0.06)


@pytest.mark.parametrize("frames", [3, pytest.param(8, marks=pytest.mark.slow)])
def test_what_code_0_cuts_off_of_darks_is_not_missing_in_the_light(frames):
    """Of a black level of 0 half of the noise is cut off, and medians of few frames are no measure of it."""
    capture = capture_set(3, kinds="df", read=11.0, black=0.0, gain=0.15, frames=frames, size=(160, 192))
    (found,) = prepare(capture, all_frames(split_recordings(capture)), False).baselines
    assert found.gain == pytest.approx(np.full(4, 0.15), rel=0.02)
    assert found.read_noise == pytest.approx(np.full(4, 1.65), rel=0.03)
    assert found.pedestal == pytest.approx(np.zeros(4), abs=0.08)


def test_a_site_that_is_always_0_takes_nothing_with_it():
    """As where a colour is masked: its noise is none, and cut off at the same code."""
    alive = np.ones(SIZE)
    alive[1::2, 1::2] = 0
    capture = capture_set(3, lambda rng: lambda dn, *_: dn * alive, kinds="df", black=0.0, read=3.0)
    (found,) = prepare(capture, all_frames(split_recordings(capture)), False).baselines
    assert np.isfinite(found.read_noise).all() and found.read_noise[:3] == pytest.approx(4.5, rel=0.1)


@pytest.mark.parametrize(
    "camera",
    [
        pytest.param("asi178", marks=pytest.mark.slow),
        pytest.param("asi120", marks=pytest.mark.slow),
        pytest.param("imx541", marks=pytest.mark.slow),
        pytest.param("stl1001", marks=pytest.mark.slow),
        "scmos_live",
    ],
)
def test_calibration_and_diagnosis_agree_on_gain_and_read_noise(real_data, camera):
    """One line through pixels: of the frames of calibration, and of those that diagnosis looks at."""
    capture, _ = central(load_capture_set(real_data / camera), 24576)
    (transfer,) = photon_transfer(capture)
    (found,) = prepare(capture, all_frames(split_recordings(capture)), False).baselines
    assert found.gain == pytest.approx(transfer.baseline.gain, rel=0.03)
    # Calibration states the noise of pixels beside that of rows; the baseline holds both, and weak
    # flicker.
    assert found.read_noise == pytest.approx(transfer.baseline.read_noise, rel=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["asi178", "imx541"])
def test_calibration_and_diagnosis_find_mechanisms_equally_strong(real_data, camera):
    """Two ways to each strength, which share no estimate: where both find one, the intervals meet."""
    capture, _ = central(load_capture_set(real_data / camera), 12000)
    measured = {f.mechanism: f.estimates for f in calibrate(capture)[1]}
    report = document(diagnose(capture, compare=False), key=0, version="0")
    found = [(f["mechanism"], f["amplitude"]) for f in report["findings"]]
    for name in ("prnu", "dsnu", "odd_even_row_noise", "row_pink_noise"):
        (strength, *_) = measured[name].values()
        own = [a for n, a in found if n == name]
        assert own, name
        # Offsets of pixels are found twice where some grow with the exposure: the nearer is the same one.
        apart = [
            abs(a["value"] - strength.value) / np.hypot(a["ci90"][1] - a["value"], 1.645 * strength.stderr)
            for a in own
        ]
        assert min(apart) < 2, (name, apart)


def hot_pixels(rng):
    """One pixel in a hundred far noisier than the others."""
    loud = 40.0 * (rng.random(SIZE) < 0.01)
    return lambda dn, signal, kind, t: dn + loud * rng.standard_normal(dn.shape)


@pytest.mark.parametrize("alter, rows", [(None, 0.0), (hot_pixels, 0.0), (row_offsets(2.0), 2.0)])
def test_calibration_and_diagnosis_agree_on_a_camera_and_differ_by_its_row_noise(alter, rows):
    capture = capture_set(5, alter, kinds="df")
    (transfer,) = photon_transfer(capture)
    (found,) = prepare(capture, all_frames(split_recordings(capture)), False).baselines
    assert found.gain == pytest.approx(transfer.baseline.gain, rel=0.01)
    assert found.gain == pytest.approx(np.full(4, 1.5), rel=0.03)
    assert found.read_noise == pytest.approx(np.hypot(transfer.baseline.read_noise, rows), rel=0.025)
    assert found.read_noise == pytest.approx(np.full(4, np.hypot(4.5, rows)), rel=0.03)


def test_levels_close_together_are_not_taken_for_full_pixels(real_data):
    """A thermal camera whose noise hardly grows with the signal."""
    capture, _ = central(load_capture_set(real_data / "lwir"), 24576)
    (found,) = prepare(capture, all_frames(split_recordings(capture)), False).baselines
    assert not any(level.full for level in found.levels)
    assert np.ptp(found.read_noise) < 0.2 * found.read_noise.mean() and found.gain.max() < 1e-3


def curve(rng, darks, flats, full=()):
    """Levels of one channel of a linear camera of its own gain and read noise; full: flats at which it is."""
    gain, read, pixels = rng.uniform(0.3, 5), rng.uniform(1.0, 8.0), 3000
    signal = np.r_[rng.uniform(-0.05, 0.05, darks), np.sort(rng.uniform(60, 3000, flats))]
    truth = read**2 + gain * np.maximum(signal, 0)
    truth[[darks + n for n in full]] *= 0.2
    error = truth * np.sqrt(2 / (3 * pixels))
    seen = truth + error * rng.standard_normal(signal.size)
    return [
        Level(n, 0, x, v, e, pixels, full=False, sure=True, alone=v, part=0)
        for n, (x, v, e) in enumerate(zip(signal, seen, error, strict=True))
    ]


@pytest.mark.parametrize("darks, flats", [(2, 2), (1, 3), (6, 2), (0, 5), (9, 1), (3, 8)])
def test_no_level_of_a_linear_camera_is_full_and_a_full_one_is(darks, flats):
    rng = np.random.default_rng([darks, flats])
    for _ in range(100):
        levels, _ = mark_full(curve(rng, darks, flats), 1.0)
        assert not any(p.full for p in levels)
        if flats > 3:
            levels, _ = mark_full(curve(rng, darks, flats, full=(flats - 1,)), 1.0)
            assert [p.full for p in levels] == [False] * (darks + flats - 1) + [True]
