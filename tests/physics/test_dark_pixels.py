"""Dark currents that differ from pixel to pixel, hot pixels beside them, and a glow over both."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.dark_pixels import above_level, law_of
from cannoise_jax.physics.transfer.estimate import normal_estimate
from cannoise_jax.physics.transfer.estimators import charge
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, SECONDS = (128, 160), (0.1, 3.0, 10.0)


def log_normal(rng, mean, variation, size=SIZE):
    """Positive numbers of given mean and standard deviation over mean."""
    shape = np.sqrt(np.log1p(variation**2))
    return mean * np.exp(shape * rng.standard_normal(size) - shape**2 / 2)


def recorded(current, seed, glow=0.0, plan=tuple((s, 10) for s in SECONDS), read=3.0):
    """Flats and darks of a camera of 0.5 DN/e- and a dark current of every pixel, e-/s. plan: exposures and
    frames of the darks; read: noise, e-."""
    rng, out = np.random.default_rng(seed), []
    flats = [("flat", plan[0][0], light, 10) for light in (500.0, 2000.0)]
    for kind, seconds, light, frames in (*flats, *(("dark", s, 0.0, n) for s, n in plan)):
        charge = np.broadcast_to(light + (current + glow) * seconds, SIZE)
        drawn = rng.poisson(charge, (frames, *SIZE)) + read * rng.standard_normal((frames, *SIZE))
        codes = np.clip(np.rint(100 + 0.5 * drawn), 0, 65535).astype(np.uint16)
        out.append(Recording(codes, "MONO", (100.0,) * 4, 65535.0, kind=kind, iso=100.0, exposure_s=seconds))
    return CaptureSet("c", tuple(out))


def calibrated(captures):
    (transfer,) = photon_transfer(captures)
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    return {f.mechanism: f for f in findings}, sensor_model([transfer], findings), transfer


@pytest.mark.parametrize(
    ("rate", "variation", "hot"),
    [
        pytest.param(0.5, 0.6, 1e-3, marks=pytest.mark.slow),
        (5.0, 0.8, 2e-3),
        pytest.param(5.0, 1.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_the_tail_of_the_dark_currents_is_not_hot(rate, variation, hot):
    """Currents, their spread and hot pixels come back, and a camera drawn anew has the darks' quantiles."""
    rng = np.random.default_rng(int(10 * rate + 100 * variation))
    heat = (rng.random(SIZE) < hot) * rng.exponential(60.0, SIZE)
    current = log_normal(rng, rate, variation)
    captures = recorded(current + heat, 3)
    found, model, _ = calibrated(captures)
    dark = found["dark_current"].measured
    assert dark["e_per_s"].value == pytest.approx(rate, rel=0.03)
    low, high = dark["variation"].ci90
    assert low < current.std() / current.mean() < high
    if hot:
        low, high = found["hot_pixels"].measured["fraction"].ci90
        assert low < hot < high and high < 5 * hot
    else:
        assert found["hot_pixels"].measured is None
    assert found["dsnu"].measured is None
    longest = captures.recordings[-1]
    drawn = model.sample(jax.random.key(1), jnp.zeros(SIZE), Settings(100.0, SECONDS[-1], frames=10))
    quantiles = [0.01, 0.1, 0.5, 0.9, 0.99, 0.999]
    real, made = (np.quantile(np.asarray(f, float).mean(0) - 100, quantiles) for f in (longest.frames, drawn))
    np.testing.assert_allclose(made, real, rtol=0.12, atol=0.8)
    assert np.corrcoef(np.asarray(drawn, float).mean(0).ravel(), longest.frames.mean(0).ravel())[0, 1] > 0.9


@pytest.mark.parametrize(
    ("variation", "frames"),
    [
        (0.0, 2),
        pytest.param(0.3, 3, marks=pytest.mark.slow),
        pytest.param(0.5, 2, marks=pytest.mark.slow),
        pytest.param(1.0, 2, marks=pytest.mark.slow),
    ],
)
def test_few_frames_tell_the_mean_and_the_spread_of_dark_currents(variation, frames):
    """Noise of means of few frames is as wide as the currents: their tail is no hot pixels, and noise is no
    spread. The darks come back as dark as they were."""
    rng = np.random.default_rng(int(100 * variation) + frames)
    current = log_normal(rng, 15.0, variation)
    captures = recorded(current, 4, plan=((0.02, frames), (0.6, frames), (1.5, frames)), read=6.0)
    found, model, _ = calibrated(captures)
    dark = found["dark_current"].measured
    assert dark["e_per_s"].value == pytest.approx(current.mean(), rel=0.02)
    assert found["hot_pixels"].measured is None
    told = dark.get("variation")
    if variation:
        assert told.value == pytest.approx(current.std() / current.mean(), rel=0.1)
    else:
        assert told is None
    for r in (r for r in captures.recordings if r.kind == "dark"):
        made = float(np.mean(model.expected(jnp.zeros(SIZE), Settings(100.0, r.exposure_s))))
        full = 0.5 * current.mean() * 1.5
        assert made == pytest.approx(np.mean(r.frames), abs=0.01 * full + 0.03)


@pytest.mark.parametrize(
    ("peak", "length", "rate"), [pytest.param(40.0, 60.0, 0.1, marks=pytest.mark.slow), (4.0, 25.0, 2.0)]
)
def test_a_glow_is_no_dark_current_and_no_pattern(peak, length, rate):
    glow = peak * np.exp(-np.hypot(*np.mgrid[: SIZE[0], : SIZE[1]]) / length)
    found, model, _ = calibrated(recorded(rate, 5, glow))
    there = {id for id, f in found.items() if f.measured is not None}
    assert there <= {"amp_glow", "dark_current"} and "amp_glow" in there
    assert found["amp_glow"].measured["e_per_s"].value == pytest.approx(peak, rel=0.03)
    assert found["amp_glow"].measured["length"].value == pytest.approx(length / max(SIZE), rel=0.03)
    if rate > 1:
        assert found["dark_current"].measured["e_per_s"].value == pytest.approx(rate, rel=0.03)
    expected = model.expected(jnp.zeros(SIZE), Settings(100.0, SECONDS[-1]))
    truth = 100 + 0.5 * SECONDS[-1] * (rate + glow)
    np.testing.assert_allclose(expected, truth, rtol=0.01, atol=1.5)


def test_the_dark_current_is_that_of_the_pixels_that_are_not_hot():
    """Few hot pixels in every channel, all known together: they are counted once, as hot pixels."""
    rng = np.random.default_rng(12)
    current = log_normal(rng, 20.0, 0.3)
    hot = rng.random(SIZE) < 1e-3
    assert max(hot[i::2, j::2].sum() for i in (0, 1) for j in (0, 1)) < 10
    captures = recorded(np.where(hot, 30.0 * current, current), 6)
    found, _, transfer = calibrated(captures)
    truth = float(current[~hot].mean())
    assert found["dark_current"].measured["e_per_s"].value == pytest.approx(truth, rel=0.008)
    said = [q.outcome.value for q in transfer.quantities if q.name == "dark current, by mean"]
    assert np.mean(said) == pytest.approx(truth, rel=0.008)
    low, high = found["hot_pixels"].measured["e_per_s"].ci90
    assert low < (29.0 * current[hot]).mean() < high


def test_no_relative_spread_is_told_of_a_dark_current_that_does_not_show():
    """Divided by a mean that may be zero it were any number."""
    found = charge.Currents(
        np.zeros((2, 2)), law_of(np.arange(40.0)), np.zeros((2, 2), bool), 1.0, 1.0, 9.0, 1.0
    )
    assert found.differ
    told = charge._variation(found, normal_estimate(2.0, 0.1))
    assert told["variation"].value == pytest.approx(1.5)
    assert not charge._variation(found, normal_estimate(0.01, 0.02))


def test_the_law_of_known_numbers():
    """Log-normal and hot parts come back; normal numbers have neither."""
    rng = np.random.default_rng(8)
    plain = law_of(rng.normal(50, 4, 40000))
    assert not plain.shape and not plain.fraction
    assert plain.scale == pytest.approx(4, rel=0.02) and plain.mean == pytest.approx(50, abs=0.1)
    bent = law_of(log_normal(rng, 50, 0.5, 40000))
    assert not bent.fraction and bent.shape == pytest.approx(np.sqrt(np.log1p(0.25)), rel=0.03)
    assert bent.mean == pytest.approx(50, rel=0.02) and bent.variance**0.5 == pytest.approx(25, rel=0.03)
    hot = rng.random(40000) < 0.01
    both = law_of(log_normal(rng, 50, 0.5, 40000) + hot * rng.exponential(900, 40000))
    assert both.fraction == pytest.approx(0.01, rel=0.3) and both.height == pytest.approx(900, rel=0.2)
    still = law_of(np.where(rng.random(4000) < 0.3, 1.0, 0.0), least=0.5)
    assert still.scale >= 0.5 and np.isfinite(still.variance)


def test_smooth_charge_is_taken_out_and_pixels_stay():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:96, :128]
    own = rng.standard_normal((96, 128))
    left = above_level(own + 5 + 0.2 * x + 0.1 * y)
    assert np.corrcoef(left.ravel(), own.ravel())[0, 1] > 0.95
    small = np.arange(256.0).reshape(16, 16)
    assert above_level(small) is small
