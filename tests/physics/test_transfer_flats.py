"""PRNU and gain beside hot pixels, uneven dark current, pixels that are full and light that leans"""

from __future__ import annotations

import re

import jax
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.as_recorded import as_recorded
from cannoise_jax.physics.transfer.black import black_at
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimators.dark_map import dark_map
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.full_well import full_signal
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer, transfer_at
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE, GAIN, READ_E, BLACK, PRNU = (64, 96), 0.5, 4.0, 100.0, 0.008


class Camera:
    """A camera in plain NumPy. rates: dark current of every pixel, e-/s; full: charge at which pixels end."""

    def __init__(self, seed, rates=0.0, full=np.inf, cfa="MONO", curve=lambda x: x):
        self.rng = np.random.default_rng(seed)
        self.response = 1 + PRNU * self.rng.standard_normal(SIZE)
        self.rates, self.full, self.cfa, self.curve = rates, full, cfa, curve

    def taken(self, kind, light, seconds, frames=8):
        charge = self.rng.poisson(light * self.response + self.rates * seconds, (frames, *SIZE))
        volts = self.curve(np.minimum(charge, self.full)) + READ_E * self.rng.standard_normal((frames, *SIZE))
        codes = np.clip(np.rint(BLACK + GAIN * volts), 0, 4095).astype(np.uint16)
        recording = Recording(codes, self.cfa, (BLACK,) * 4, 4095.0, "made", kind, exposure_s=seconds)
        return frame_statistics(recording)


def prnu_of(statistics):
    transfer = transfer_at(statistics)
    (table,) = of_all_pixels(transfer).outcomes("PRNU1288")
    found = MECHANISMS["prnu"].estimator(transfer.statistics, transfer.baseline)["sigma"]
    return table.value / 100, found.value


@pytest.mark.parametrize("darks", [(4.0,), (1.0, 20.0), (1.0, 4.0, 20.0)])
def test_hot_pixels_and_uneven_dark_current_are_no_prnu(darks):
    rng = np.random.default_rng(1)
    rates = 30 * np.exp(0.3 * rng.standard_normal(SIZE)) + rng.exponential(60, SIZE) * (
        rng.random(SIZE) < 0.02
    )
    camera = Camera(2, rates)
    statistics = [camera.taken("flat", 3000.0, 4.0)] + [camera.taken("dark", 0.0, t) for t in darks]
    for found in prnu_of(statistics):
        assert found == pytest.approx(camera.response.std(), rel=0.06)
    notes = {q.name: q.note for q in of_all_pixels(transfer_at(statistics)).quantities}
    assert len(darks) < 3 or "dark currents differ from pixel to pixel" in notes["dark current, by mean"]


def test_the_pattern_with_hot_pixels_is_said_beside_that_without():
    rng = np.random.default_rng(11)
    camera = Camera(12, rng.exponential(60, SIZE) * (rng.random(SIZE) < 0.02))
    dark = camera.taken("dark", 0.0, 4.0)
    shown = of_all_pixels(transfer_at([camera.taken("flat", 3000.0, 4.0), dark]))
    (note,) = [q.note for q in shown.quantities if q.name == "DSNU1288" and q.unit == "DN"]
    said = float(note.split("; ")[1].split(" DN with them")[0])
    assert said == pytest.approx(dark.mean.std(), rel=0.02)


def test_a_dark_between_two_exposures_is_made_of_both():
    rates = np.random.default_rng(3).uniform(0, 40, SIZE)
    camera = Camera(4, rates)
    flat, *darks = (
        camera.taken("flat", 2000.0, 10.0),
        camera.taken("bias", 0, 0.0),
        camera.taken("dark", 0, 30.0),
    )
    found = dark_map([flat, *darks], flat)
    assert [round(w, 3) for _, w in found.darks] == [0.667, 0.333]
    truth = GAIN * 10 * (rates - rates.mean())
    left = (found.offsets - truth)[found.keep]
    assert left.std() < 3 * np.sqrt(np.mean([found.noise(c) for c in range(4)]))


@pytest.mark.parametrize(
    "spread", [0.0, pytest.param(0.02, marks=pytest.mark.slow), pytest.param(0.05, marks=pytest.mark.slow)]
)
def test_pixels_that_are_full_below_the_highest_code_are_told_by_their_noise(spread):
    full = 5000 * (1 + spread * np.random.default_rng(5).standard_normal(SIZE))
    camera = Camera(6, full=full)
    times = (0.1, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
    statistics = [camera.taken("flat", 1000.0 * t, t) for t in times] + [
        camera.taken("dark", 0.0, t) for t in (0.1, 2.0, 8.0)
    ]
    assert full_signal(statistics, 0) == pytest.approx(BLACK + GAIN * 5000, rel=0.01)
    for found in prnu_of(statistics):
        assert found == pytest.approx(PRNU, rel=0.06)
    transfer = transfer_at(statistics)
    (end,) = of_all_pixels(transfer).outcomes("saturation level", "DN")
    assert isinstance(end, Estimate) and end.value == pytest.approx(GAIN * 5000, rel=0.01)
    bent = MECHANISMS["nonlinearity"].estimator(transfer.statistics, transfer.baseline)
    assert not isinstance(bent, NotMeasurable) and abs(bent["loss"].value) < 0.005
    full_well = MECHANISMS["saturation"].estimator(transfer.statistics, transfer.baseline)["full_well_e"]
    assert full_well.ci90[0] < 5000 * 1.005 and full_well.ci90[1] > 5000 * 0.995


def test_no_flat_is_full_where_the_response_bends():
    camera = Camera(7, curve=lambda x: x - 0.4 * x**2 / 8000)
    flats = [camera.taken("flat", light, 1.0) for light in (500.0, 2000.0, 4000.0, 7500.0)]
    assert full_signal(flats, 0) == float("inf")


def test_light_that_leans_is_no_difference_of_the_greens():
    camera = Camera(8, cfa="RGGB")
    lean = np.add.outer(np.linspace(0.7, 1.3, SIZE[0]), np.linspace(-0.3, 0.3, SIZE[1]))
    dark = camera.taken("dark", 0.0, 1.0)
    for unlike in (0.0, 0.01):
        greens = np.ones(SIZE)
        greens[::2, 1::2] += unlike  # twice sigma apart, beside red
        statistics = [camera.taken("flat", 2500 * lean * greens, 1.0), dark]
        found = MECHANISMS["green_imbalance"].estimator(statistics, None)["sigma"]
        assert found.value == pytest.approx(unlike / 2, abs=4e-4) and found.significant == bool(unlike)


def test_flats_through_which_no_line_goes_are_said():
    """Two gains in one frame, as sensors of high dynamic range have: above a level the noise is another."""
    rng = np.random.default_rng(9)
    plain, odd = Camera(9), Camera(10, curve=lambda x: x + 30 * (x > 1500) * rng.standard_normal(x.shape))
    for camera, said in ((plain, False), (odd, True)):
        flats = [camera.taken("flat", light, 1.0) for light in (800.0, 2000.0, 4000.0)]
        shown = of_all_pixels(transfer_at([*flats, camera.taken("dark", 0.0, 1.0)]))
        (note,) = [q.note for q in shown.quantities if q.name == "system gain"]
        assert ("not one straight line" in note) == said


@pytest.mark.parametrize(("electrons", "read_dn", "size"), [(20, 0.2, (96, 128)), (100, 1.0, (64, 64))])
def test_steady_light_that_is_dim_does_not_flicker(electrons, read_dn, size):
    rng = np.random.default_rng(electrons)
    frames = [50 + read_dn * rng.standard_normal((8, *size)) for _ in range(2)]
    frames[1] += rng.poisson(electrons, frames[1].shape)
    own = [
        Recording(np.rint(f).astype(np.uint16), "MONO", (50.0,) * 4, 4095.0, kind=kind, exposure_s=0.01)
        for kind, f in zip(("dark", "flat"), frames, strict=True)
    ]
    (transfer,) = photon_transfer(CaptureSet("dim", tuple(own)))
    for rows in transfer.outcomes("PRNU1288, rows"):
        assert not isinstance(rows, NotMeasurable)


def test_sensitivities_are_those_before_the_response_bends():
    """At white a quarter of the slope is lost: the brightest flat shows less of the sensitivities than there
    is, and a model that bends the light again has them once."""
    full = (4095 - BLACK) / GAIN
    camera = Camera(8, curve=lambda x: x * (1 - 0.12 * x / full))
    statistics = [camera.taken("flat", 1500.0 * t, t) for t in (0.5, 1.0, 2.0, 3.0, 4.0)]
    statistics += [camera.taken("dark", 0.0, t, 12) for t in (0.5, 4.0)]
    statistics = transfer_at(statistics)
    findings = find_mechanisms(statistics.statistics, statistics.baseline, LISTED)
    found = {f.mechanism: f.measured for f in findings}
    assert found["nonlinearity"]["loss"].value == pytest.approx(0.12, rel=0.05)
    low, high = found["prnu"]["sigma"].ci90
    truth = camera.response.std()
    assert low - 0.01 * truth < truth < high + 0.01 * truth
    model = sensor_model([statistics], findings)
    light = np.full(SIZE, 6000.0 * GAIN / (4095 - BLACK))
    drawn = np.asarray(model.sample(jax.random.key(2), light, Settings(100.0, 1.0, frames=8)))
    recorded = next(s for s in statistics.statistics if s.recording.exposure_s == 4.0).recording.frames
    spread = [np.asarray(f, float).mean(0).std() for f in (drawn, recorded)]
    assert spread[0] == pytest.approx(spread[1], rel=0.1)
    (said,) = as_recorded(model, [statistics], findings)
    table, own = (float(v) for v in re.findall(r"([\d.]+) DN/e-", said))
    assert table < 0.95 * GAIN and own == pytest.approx(GAIN, rel=0.02)
    share = float(re.findall(r"prnu of ([\d.]+) %", said)[0])
    assert share == pytest.approx(100 * truth, rel=0.03) and "not corrected for it" in said


def test_nothing_is_said_where_table_and_model_agree():
    camera = Camera(9)
    statistics = [
        camera.taken(*of) for of in (("flat", 2000.0, 1.0), ("flat", 4000.0, 1.0), ("dark", 0, 1.0))
    ]
    transfer = transfer_at(statistics)
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    assert as_recorded(sensor_model([transfer], findings), [transfer], findings) == ()


def test_flats_that_are_wholly_full_show_where_the_codes_end():
    camera = Camera(12)
    kept = [
        camera.taken(kind, light, 1.0) for kind, light in (("flat", 2000.0), ("flat", 5000.0), ("dark", 0))
    ]
    recordings = [s.recording for s in kept]
    full = Recording(np.full((4, *SIZE), 4095, np.uint16), "MONO", (BLACK,) * 4, 4095.0, "made", "flat")
    capture, lines = usable(CaptureSet("made", (*recordings, full)))
    assert len(lines) == 1
    (transfer,) = photon_transfer(capture)
    transfer = of_all_pixels(transfer)
    (codes,), (charge,) = (transfer.outcomes("saturation level", unit) for unit in ("DN", "e-"))
    assert codes.value == pytest.approx(4095 - BLACK, abs=0.1)
    assert charge.value == pytest.approx((4095 - BLACK) / GAIN, rel=0.02)
    well = MECHANISMS["saturation"].estimator(transfer.statistics, transfer.baseline)
    assert isinstance(well, NotMeasurable) and "codes end before" in well.record


def test_light_that_fades_makes_no_other_sensitivities():
    """Over ten flats to 0.4 of the first: what their average holds of shot noise is less than each has."""
    size, errors = (128, 128), []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        response = 1 + 0.006 * rng.standard_normal(size)
        light = np.geomspace(6000, 2500, 10)[:, None, None]
        recordings = []
        for kind, level in (("flat", light), ("dark", 0 * light)):
            charge = rng.poisson(level * response) + 3 * rng.standard_normal((10, *size))
            codes = np.clip(np.rint(BLACK + GAIN * charge), 0, 4095).astype(np.uint16)
            recordings.append(Recording(codes, "MONO", (BLACK,) * 4, 4095.0, kind=kind, exposure_s=1.0))
        statistics = [frame_statistics(r) for r in recordings]
        errors.append([v / response.std() - 1 for v in prnu_of(statistics)])
    assert np.abs(np.mean(errors, 0)).max() < 0.012


@pytest.mark.parametrize(("seconds", "weights"), [(9.2, [0.089, 0.911]), (9.9, [1.0]), (0.03, [1.0])])
def test_a_dark_is_as_long_as_a_flat_by_one_rule(seconds, weights):
    """For the pattern of the pixels as for the black level: exposures alike to what files round, or so short
    that nothing gathers."""
    camera = Camera(14)
    flat = camera.taken("flat", 2000.0, seconds)
    darks = [camera.taken("dark", 0, t) for t in (0.05, 1.0, 10.0)]
    found = dark_map([flat, *darks], flat)
    assert [round(w, 3) for _, w in found.darks] == weights
    assert ("line" in black_at([flat, *darks], seconds).note) == (len(weights) == 2)
