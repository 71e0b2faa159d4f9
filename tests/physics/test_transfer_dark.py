"""Dark charge is counted once: in the mechanism, not in the black level and the read noise beside it too."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.mechanisms.coverage import assumed_baseline
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.dark import Series, dark_currents, dark_series
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.charge import hot_map
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.physics.transfer.table import format_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, RATE = (96, 128), 20.0


@pytest.fixture(
    scope="module", params=[pytest.param(1.0, marks=pytest.mark.slow), 0.01], ids=["long", "short"]
)
def calibrated(request):
    """Flats and darks of one exposure, and darks of two more, of a camera with dark current."""
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 100.0, 16383.0, "RGGB").with_mechanism(
        "dark_current", e_per_s=RATE, scaling=None
    )
    plan = [("flat", level, request.param, 4) for level in (0.02, 0.1, 0.3, 0.5)]
    plan += [("dark", 0.0, seconds, 8) for seconds in (request.param, 4.0, 16.0)]
    recordings = []
    for n, (kind, level, seconds, frames) in enumerate(plan):
        drawn = camera.sample(
            jax.random.key(n), jnp.full(SIZE, level), Settings(100.0, seconds, frames=frames)
        )
        recordings.append(
            Recording(
                frames=np.asarray(drawn),
                cfa="RGGB",
                black_level=(100.0,) * 4,
                white_level=16383.0,
                kind=kind,
                iso=100.0,
                exposure_s=seconds,
            )
        )
    transfers = photon_transfer(CaptureSet("c", tuple(recordings)))
    findings = find_mechanisms(transfers[0].statistics, transfers[0].baseline, LISTED)
    return transfers, findings, sensor_model(transfers, findings), recordings


def test_a_dark_of_one_frame_is_asked_for_once_more(calibrated):
    """Where the exposures are there and only a repeat is missing, not the whole series is asked for."""
    *_, recordings = calibrated
    longest = max(r.exposure_s for r in recordings)
    short = [
        dataclasses.replace(r, frames=r.frames[:1]) if r.exposure_s == longest else r for r in recordings
    ]
    said = format_transfer(photon_transfer(CaptureSet("c", tuple(short)))[0])
    assert f"record a second dark of {longest:g} s" in said
    two = [r for r in recordings if r.exposure_s != longest]
    assert "record darks at three or more" in format_transfer(photon_transfer(CaptureSet("c", tuple(two)))[0])


def test_a_table_without_a_line_is_left_out(calibrated):
    *_, recordings = calibrated
    single = [dataclasses.replace(r, frames=r.frames[:1]) for r in recordings if r.kind == "flat"]
    said = format_transfer(photon_transfer(CaptureSet("c", tuple(single)))[0]).splitlines()
    assert (
        not any(line.split()[:1] == ["unit"] for line in said)
        and "Not measured, for want of these recordings:" in said
    )
    assert not any(line.startswith("temporal dark noise:") for line in said)


def test_darks_come_back_as_dark_as_they_were(calibrated):
    _, _, model, recordings = calibrated
    for r in (r for r in recordings if r.kind == "dark"):
        mean = float(np.mean(model.expected(jnp.zeros(SIZE), Settings(100.0, r.exposure_s))))
        assert mean == pytest.approx(np.mean(r.frames), abs=0.01 * 2 * RATE * r.exposure_s + 0.3)
    assert np.mean(model.black_level) == pytest.approx(100.0, abs=0.8)
    assert np.mean(model.read_noise_e) == pytest.approx(3.0, rel=0.06)


def test_interval_of_the_dark_current_holds_the_doubt_about_the_gain(calibrated):
    transfers, findings, _, _ = calibrated
    (found,) = (f for f in findings if f.mechanism == "dark_current")
    low, high = found.estimates["e_per_s"].ci90
    slope = transfers[0].baseline
    doubt = np.linalg.norm(np.divide(slope.gain_stderr, slope.gain)) / 4
    assert (high - low) / 2 >= 1.6 * doubt * RATE
    assert low - 0.02 * RATE < RATE < high + 0.02 * RATE
    channels = [q.outcome for q in transfers[0].quantities if q.name == "dark current, by mean"]
    held = [q.ci90[0] <= RATE <= q.ci90[1] for q in channels]
    assert sum(held) >= 3  # four intervals of 90 %
    certain = dataclasses.replace(slope, gain_stderr=(0.0,) * 4)
    findings = find_mechanisms(transfers[0].statistics, certain, [MECHANISMS["dark_current"]])
    again = findings[0]
    assert again.estimates["e_per_s"].stderr < found.estimates["e_per_s"].stderr


RATE_OF_THREE, TIMES, READ_E, CUBE = 300.0, np.array([0.05, 0.1, 0.15]), 6.0, (4, 48, 48)


def three_exposures(seed, wander=0.0):
    """Darks of three exposures; wander: of the level from frame to frame, e-, the same in all of a frame."""
    rng = np.random.default_rng(seed)
    darks = []
    for seconds in TIMES:
        charge = rng.poisson(RATE_OF_THREE * seconds, CUBE) + READ_E * rng.standard_normal(CUBE)
        charge = charge + wander * rng.standard_normal((CUBE[0], 1, 1))
        codes = np.clip(np.rint(40 + 0.25 * charge), 0, 1023).astype(np.uint16)
        recording = Recording(codes, "MONO", (40.0,) * 4, 1023.0, "c", "dark", exposure_s=seconds)
        darks.append(frame_statistics(recording))
    return darks


@pytest.mark.parametrize("seeds", [12, pytest.param(40, marks=pytest.mark.slow)])
def test_an_interval_through_three_exposures_is_as_wide_as_the_noise_makes_it(seeds):
    """One degree of freedom alone made widths differ a hundredfold, and half of them miss by luck."""
    truth, times, read, size = RATE_OF_THREE, TIMES, READ_E, CUBE
    found, of_all = [], []
    for seed in range(seeds):
        darks = three_exposures(seed)
        found.append(dark_currents(dark_series(darks, [0], [0.25]))[:2])
        of_all.append(dark_currents(dark_series(darks, range(4), [0.25] * 4))[0])
    # Of the slope: that of means of pixels whose variance is read^2 + charge, of a quarter of the mosaic.
    error = np.sqrt((read**2 + truth * 0.1) / (np.prod(size) / 4) / np.sum((times - 0.1) ** 2))
    # Four channels together know it twice as well.
    wide = [e.ci90[1] - e.ci90[0] for e in of_all]
    assert np.mean([e.ci90[0] <= truth <= e.ci90[1] for e in of_all]) > 0.8
    assert min(wide) > 1.4 * error and np.quantile(wide, 0.8) < 2.6 * error
    for one in zip(*found, strict=True):
        assert np.mean([e.ci90[0] <= truth <= e.ci90[1] for e in one]) > 0.8
    widths = [e.ci90[1] - e.ci90[0] for e, _ in found]
    assert min(widths) > 2 * 1.4 * error and np.quantile(widths, 0.8) < 2 * 2.6 * error


def test_what_moves_all_of_a_frame_is_no_less_for_four_channels():
    for seed in range(2):
        darks = three_exposures(seed, wander=4.0)
        one, all = (dark_series(darks, c, [0.25] * len(c)).mean_error for c in ([0], range(4)))
        assert np.all(all > 0.8 * one) and np.all(one > 0.3)


@pytest.mark.slow
def test_correlations_of_white_noise_are_zero_within_their_intervals():
    rng, held, values = np.random.default_rng(5), [], []
    for _ in range(60):
        frames = np.round(rng.normal(100, 6, (16, 32, 96))).astype(np.uint16)
        r = Recording(frames=frames, cfa="RGGB", black_level=(90.0,) * 4, white_level=4095.0, kind="dark")
        (result,) = photon_transfer(CaptureSet("c", (r,)))
        found = [q.outcome for q in result.quantities if q.name.startswith("correlation of pixels")]
        held.append([e.ci90[0] <= 0 <= e.ci90[1] for e in found])
        values.append([e.value for e in found])
    error = np.std(values, 0) / np.sqrt(len(values))
    assert np.all(np.abs(np.mean(values, 0)) < 3.5 * error)
    assert 0.82 < np.mean(held) < 0.97


def darks_with(heat, wobble, seed=0):
    """A long and a short dark, e-. wobble: of offsets that differ between the two, both ways alike; heat: of
    the long one alone."""
    rng, size = np.random.default_rng(seed), (96, 128)
    found = []
    for seconds, more in ((0.01, 0.0), (10.0, heat)):
        offsets = wobble * rng.standard_t(2.5, size) + more
        frames = 200 + 2.0 * (rng.normal(0, 3, (8, *size)) + offsets)
        codes = np.clip(np.rint(frames), 0, 16383).astype(np.uint16)
        taken = Recording(
            codes, "MONO", (200.0,) * 4, 16383.0, kind="dark", exposure_s=seconds, code_step=1.0
        )
        found.append(frame_statistics(taken))
    return found


def test_pixels_that_move_both_ways_are_not_hot():
    measure = MECHANISMS["hot_pixels"].estimator.measure
    for seed in range(4):
        outcome = measure(darks_with(0.0, 3.0, seed), assumed_baseline())
        assert isinstance(outcome, NotMeasurable) and "below the median" in outcome.record


def test_hot_pixels_are_measured_among_pixels_that_move_both_ways():
    rng = np.random.default_rng(9)
    hot = rng.random((96, 128)) < 0.03
    heat = np.where(hot, rng.exponential(400.0, hot.shape), 0.0)
    for wobble in (0.0, 1.0):
        statistics = darks_with(heat, wobble)
        found = MECHANISMS["hot_pixels"].estimator.measure(statistics, assumed_baseline())
        assert found["e_per_s"].value == pytest.approx(heat[hot].mean() / 10, rel=0.1)
        assert found["fraction"].value == pytest.approx(hot.mean(), rel=0.12)
        seen = hot_map(statistics, assumed_baseline(), 40.0, 0.03) > 0
        assert np.mean(seen[hot & (heat > 100)]) > 0.95 and np.mean(seen[~hot]) < 0.005


def test_hot_pixels_that_fill_in_the_longest_dark_are_told_by_shorter_ones():
    """Heights and map are those of the pixels, whatever the longest dark cuts off."""
    rng, size = np.random.default_rng(4), (96, 128)
    hot = rng.random(size) < 0.02
    heat = np.where(hot, rng.exponential(600.0, size), 1.0)
    statistics = []
    for seconds in (0.01, 0.25, 1.0, 4.0):
        charge = rng.poisson(heat * seconds, (6, *size)) + 4.0 * rng.standard_normal((6, *size))
        codes = np.clip(np.rint(200 + 2.0 * charge), 0, 3000).astype(np.uint16)
        taken = Recording(codes, "MONO", (200.0,) * 4, 3000.0, kind="dark", exposure_s=seconds)
        statistics.append(frame_statistics(taken))
    cut_off = 4.0 * heat > (3000 - 200) / 2.0
    assert cut_off[hot].mean() > 0.3
    found = MECHANISMS["hot_pixels"].estimator.measure(statistics, assumed_baseline())
    low, high = found["e_per_s"].ci90
    assert low < heat[hot].mean() < high and high < 1.35 * low
    heights = 600.0 * hot_map(statistics, assumed_baseline(), 600.0, 0.02)
    np.testing.assert_allclose(heights[cut_off], heat[cut_off], rtol=0.1)


@pytest.mark.parametrize("times", [(0.0005, 0.001, 0.002, 0.004), (1.0, 5.0, 10.0)])
def test_a_few_darks_that_agree_are_not_said_to_disagree(times):
    """Few points lie on a line by luck, which is no measure of their errors."""
    rng, seconds = np.random.default_rng(0), np.array(times)
    mean, error = 0.5 * seconds, np.full(len(times), 0.05)
    variance, share = 36 + 0.5 * seconds, np.sqrt(2 / (3072 * 5))
    agreed = 0
    for _ in range(300):
        drawn = mean + error * rng.standard_normal(len(times))
        squares = variance * (1 + share * rng.standard_normal(len(times)))
        agreed += dark_currents(Series(seconds, drawn, error, squares, variance * np.hypot(share, 0.02)))[2]
    assert agreed >= 298
