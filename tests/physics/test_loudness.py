"""Loud values are put down to what makes them: heavy tails, noisy pixels, telegraph pixels, or several."""

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.mechanisms.coverage import BLACK, GAIN, READ_E, WHITE, assumed_baseline
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, normal_estimate
from cannoise_jax.physics.transfer.estimators import loudness
from cannoise_jax.physics.transfer.estimators.loudness import _negative
from cannoise_jax.physics.transfer.estimators.maps import pixel_read_noise_map
from cannoise_jax.physics.transfer.estimators.noise import heavy_tails
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels
from cannoise_jax.recordings.recording import CaptureSet, Recording, per_channel

TRUTH = {
    "heavy_tails": {"tukey_lambda": -0.1},
    "pixel_read_noise_map": {"spread": 0.2},
    "rts": {"jump_dn": 40.0, "fraction": 0.03, "rate": 0.2},
}


def statistics(ids, seed=3, frames=8, size=(64, 96), offsets=0.0, student=0.0):
    """A dark with some of the mechanisms, as bin/calibrate sees it."""
    model = SensorModel.poisson_gaussian(GAIN, READ_E, BLACK, WHITE, "RGGB")
    for id in ids:
        model = model.with_mechanism(id, **TRUTH[id])
    model = model.with_mechanism("dsnu", sigma_dn=offsets) if offsets else model
    camera = model.with_unit(jax.random.key(seed + 100))
    codes = camera.sample(jax.random.key(seed), np.zeros(size, np.float32), Settings(frames=frames))
    if student:
        rng = np.random.default_rng(seed)
        codes = np.round(BLACK + 6 * rng.standard_t(student, (frames, *size))).clip(0, WHITE)
    taken = Recording(
        np.asarray(codes, np.uint16), "RGGB", per_channel(BLACK), WHITE, kind="dark", exposure_s=1.0,
        code_step=1.0,
    )  # fmt: skip
    return [frame_statistics(taken)]


def causes(stats):
    entries = [MECHANISMS[id] for id in TRUTH]
    found = {f.mechanism: f for f in find_mechanisms(stats, assumed_baseline(), entries)}
    return {id: found[id].estimates for id in TRUTH if found[id].verdict == "in the model"}


@pytest.mark.parametrize(
    "ids",
    [
        pytest.param(("heavy_tails",), marks=pytest.mark.slow),
        ("pixel_read_noise_map",),
        ("rts",),
        pytest.param(("heavy_tails", "pixel_read_noise_map"), marks=pytest.mark.slow),
        pytest.param(("pixel_read_noise_map", "rts"), marks=pytest.mark.slow),
        pytest.param(("heavy_tails", "rts"), marks=pytest.mark.slow),
        pytest.param(tuple(TRUTH), marks=pytest.mark.slow),
    ],
    ids="+".join,
)
def test_what_made_the_values_loud_is_found_and_nothing_else(ids):
    found = causes(statistics(ids))
    assert tuple(found) == ids
    for id in ids:
        for name, true in TRUTH[id].items():
            estimate = found[id][name]
            assert abs(estimate.value - true) < 4 * estimate.stderr, (id, name, estimate)


@pytest.mark.slow
def test_fixed_offsets_are_no_levels_of_a_telegraph_signal():
    assert tuple(causes(statistics(("heavy_tails",), offsets=5.0, size=(48, 64)))) == ("heavy_tails",)


def test_another_law_of_heavy_tails_is_no_map_either():
    found = causes(statistics((), student=5.0))
    assert tuple(found) == ("heavy_tails",) and found["heavy_tails"]["tukey_lambda"].ci90[1] < 0


def test_tails_alike_in_all_pixels_are_no_spread_of_their_noise():
    # Of twelve 90 % intervals that hold the truth, seven or fewer do so once in 150 times.
    for ids, true in ((("heavy_tails",), 0.0), (("heavy_tails", "pixel_read_noise_map"), 0.2)):
        found = [pixel_read_noise_map(statistics(ids, seed)) for seed in range(12)]
        assert not any(isinstance(f, NotMeasurable) for f in found)
        held = sum(f["spread"].ci90[0] <= true <= f["spread"].ci90[1] for f in found)
        assert held >= 8, [f["spread"] for f in found]


def test_the_shape_of_the_noise_does_not_depend_on_the_levels_of_frames():
    rng = np.random.default_rng(0)
    codes = np.rint(BLACK + 6 * rng.standard_normal((8, 64, 96)))
    codes[0] += 40
    taken = Recording(codes.astype(np.uint16), "MONO", per_channel(BLACK), WHITE, kind="dark", exposure_s=1.0)
    found = heavy_tails([frame_statistics(taken)])["tukey_lambda"]
    assert found.ci90[1] - found.ci90[0] < 0.05 and found.value == pytest.approx(0.135, abs=0.02)


def test_a_strength_that_is_uncertain_by_more_than_its_range_is_not_measured():
    entry = MECHANISMS["heavy_tails"]
    wide = {"tukey_lambda": normal_estimate(0.0, 600.0)}
    vague = dataclasses.replace(entry.estimator, measure=lambda *a: wide)
    (finding,) = find_mechanisms([], assumed_baseline(), [dataclasses.replace(entry, estimator=vague)])
    assert finding.verdict == "not looked for" and "more than its whole range" in finding.estimates.record


LIT = (("dark", 0.0, 16), ("flat", 400.0, 6), ("flat", 1500.0, 6))


def plain(noise, seed=5, size=(80, 96), gain=0.5):
    """Findings and gain of a camera in plain NumPy. noise(rng, shape) -> noise in the dark, DN."""
    rng = np.random.default_rng(seed)
    taken = []
    for kind, light, frames in LIT:
        values = 300 + gain * rng.poisson(light, (frames, *size)) + noise(rng, (frames, *size))
        codes = np.clip(np.rint(values), 0, 16383).astype(np.uint16)
        taken.append(Recording(codes, "MONO", (300.0,) * 4, 16383.0, "plain", kind, exposure_s=1.0))
    transfers, findings = calibrate(CaptureSet("plain", tuple(taken)))
    table = of_all_pixels(transfers[0])
    return {f.mechanism: f for f in findings}, {(q.name, q.unit): q.outcome for q in table.quantities}


def test_rows_that_take_turns_in_noise_hold_no_jumps():
    sigma = np.where(np.arange(80) % 2, 5.0, 2.0)[:, None]
    found, table = plain(lambda rng, shape: sigma * rng.standard_normal(shape))
    assert not found["rts"].measured and not found["pixel_read_noise_map"].measured
    assert table["temporal dark noise", "DN"].value == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.01)
    assert table["DSNU1288", "DN"].ci90[0] == 0


def test_pixels_of_larger_gaussian_noise_do_not_jump_and_leave_the_gain():
    loud = np.random.default_rng(6).random((80, 96)) < 0.06
    sigma = np.where(loud, 7.5, 2.5)
    found, table = plain(lambda rng, shape: sigma * rng.standard_normal(shape))
    assert not found["rts"].measured and found["pixel_read_noise_map"].measured
    gain = table["system gain", "DN/e-"]
    assert abs(gain.value - 0.5) < 3 * gain.stderr and gain.stderr < 0.004


@pytest.mark.slow
def test_pixels_that_jump_to_one_side_are_no_particle_hits():
    """1.5 % of pixels 25 DN up in a quarter of the frames."""
    jumping = np.random.default_rng(7).random((80, 96)) < 0.015

    def noise(rng, shape):
        return 2 * rng.standard_normal(shape) + 25 * jumping * (rng.random(shape) < 0.25)

    found, _ = plain(noise)
    assert isinstance(found["cosmic_rays"].estimates, NotMeasurable) and not found["hot_pixels"].measured
    assert found["rts"].measured["jump_dn"].value == pytest.approx(25, rel=0.02)
    assert found["rts"].measured["fraction"].value == pytest.approx(jumping.mean(), rel=0.1)
    assert not found["pixel_read_noise_map"].measured


def test_a_fit_that_steps_far_out_has_finite_values():
    """The first step of a search may be any; its scale is neither zero nor infinite."""
    series = np.random.default_rng(0).standard_normal((6, 40))
    for far in (-2000.0, 2000.0):
        at = np.array([far, 0.5, 0.0, 0.0])
        assert np.isfinite(_negative(series, (np.zeros(1), np.zeros(1)), ("telegraph",), at))


def test_jumps_without_a_size_explain_nothing_beside_others(monkeypatch):
    """Where a fit of all together ends with jumps at the least that can be seen, whose size nothing tells."""
    whole = loudness._estimates

    def unsure(series, offsets, laws, x, sigma):
        found = whole(series, offsets, laws, x, sigma)
        if "telegraph" in laws and len(laws) > 1:
            found["telegraph"]["jump_dn"] = Estimate(2.0, 5000.0, (2.0, 17000.0))
        return found

    monkeypatch.setattr(loudness, "_estimates", unsure)
    found = causes(statistics(("heavy_tails", "rts"), size=(48, 64)))
    assert tuple(found) == ("heavy_tails",)
