"""What the four sites of a sensor without colours share is told once, and kept apart where it differs."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.transfer.black import stand_in
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.physics.transfer.noise_profile import darktable_profiles, profile_rows
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (64, 96)


def taken(kind, light, seconds, rng, gain=0.6, read=4.0):
    charge = rng.poisson(light, (8, *SIZE)) + read * rng.standard_normal((8, *SIZE))
    codes = np.rint(180 + gain * charge).astype(np.uint16)
    return Recording(codes, "MONO", (180.0,) * 4, 4095.0, "Maker C", kind, exposure_s=seconds)


def captures(gain=0.6, read=4.0, dark_s=1.0, seed=4):
    rng = np.random.default_rng(seed)
    plan = (("flat", 700.0, 1.0), ("flat", 2000.0, 1.0), ("dark", 0.0, dark_s))
    return CaptureSet("Maker C", tuple(taken(k, light, t, rng, gain, read) for k, light, t in plan))


def test_one_gain_and_one_read_noise_as_in_the_table():
    transfers, findings = calibrate(captures())
    model, table = sensor_model(transfers, findings), of_all_pixels(transfers[0]).baseline
    for stored, told in ((model.gain_dn_per_e, table.gain), (model.read_noise_e, table.read_noise_e)):
        assert np.ptp(np.asarray(stored)) == 0 and np.asarray(stored)[0] == pytest.approx(told, rel=1e-5)


def test_columns_of_two_converters_keep_their_gains():
    gain = np.where(np.arange(SIZE[1]) % 2, 0.66, 0.6)
    transfers, findings = calibrate(captures(gain))
    found = np.asarray(sensor_model(transfers, findings).gain_dn_per_e)[0]
    assert found[[0, 2]] == pytest.approx(0.6, rel=0.02) and found[[1, 3]] == pytest.approx(0.66, rel=0.02)


def test_an_iso_that_stands_for_none_is_said():
    transfers, _ = calibrate(captures())
    (camera,) = darktable_profiles("Maker C", profile_rows(transfers))["noiseprofiles"]
    (profile,) = camera["models"][0]["profiles"]
    assert profile["iso"] == 100 and profile["name"] == "Maker C iso 100 (not stated)"
    assert profile_rows(transfers)[0]["iso"] is None


@pytest.mark.parametrize(("dark_s", "said"), [(1.0, False), (1.01, False), (1.7, True), (0.6, True)])
def test_a_dark_of_another_exposure_that_stands_for_one_as_long_is_said(dark_s, said):
    statistics = [frame_statistics(r) for r in captures(dark_s=dark_s).recordings]
    assert stand_in(statistics) == ((1.0, dark_s) if said else None)
    assert ("dark charge counts as that of the flats" in faults(statistics).longer) == said


def test_row_noise_of_even_and_odd_columns_leaves_no_other():
    """Two converters read the even and the odd columns of a row, each with row noise of its own."""
    rng = np.random.default_rng(9)
    frames = 300 + 3 * rng.standard_normal((10, 96, 128))
    for k in (0, 1):
        frames[:, :, k::2] += 1.5 * rng.standard_normal((10, 96, 1))
    flats = 300 + 0.5 * rng.poisson(3000, (6, 96, 128)) + 3 * rng.standard_normal((6, 96, 128))
    own = [
        Recording(np.rint(v).astype(np.uint16), "MONO", (300.0,) * 4, 4095.0, "c", kind, exposure_s=1.0)
        for kind, v in (("dark", frames), ("flat", flats))
    ]
    transfers, findings = calibrate(CaptureSet("c", tuple(own)))
    found = {f.mechanism: f for f in findings}
    assert found["row_noise"].measured["sigma_dn"].value == pytest.approx(1.5, rel=0.06)
    assert found["column_noise"].measured is None and found["dsnu"].measured is None
    for pattern in of_all_pixels(transfers[0]).outcomes("DSNU1288", "DN"):
        assert pattern.ci90[0] == 0
