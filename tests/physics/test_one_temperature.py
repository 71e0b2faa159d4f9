"""Darks of one exposure and two temperatures are two dark currents; a sensor that warms has one."""

import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.transfer.doubling import NAME
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.physics.transfer.one_temperature import no_dark_as_warm, of_one_temperature
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (48, 64)
PRNU = 0.01
SENSITIVITY = 1 + PRNU * np.random.default_rng(3).standard_normal(SIZE)
HEAT = np.exp(0.5 * np.random.default_rng(4).standard_normal(SIZE) - 0.125)


def recording(kind, seconds, celsius, light=0.0, sensitivity=1.0, heat=1.0):
    rng = np.random.default_rng(round(100 + 10 * seconds + (celsius or 0) + light))
    rate = 2.0 * 2.6 ** ((0.0 if celsius is None else celsius) / 10 + 1)
    electrons = light * sensitivity + rate * seconds * heat
    charge = rng.poisson(electrons, (6, *SIZE)) + 4 * rng.standard_normal((6, *SIZE))
    codes = np.rint(300 + 0.8 * charge).astype(np.uint16)
    return Recording(
        codes, "MONO", (300.0,) * 4, 16383.0, "cooled", kind, exposure_s=seconds, temperature_c=celsius
    )


def series(*celsius):
    return [recording("dark", s, c) for c in celsius for s in (0.001, 5.0, 30.0)]


@pytest.mark.parametrize(
    ("flat", "rate"), [pytest.param(-10.0, 2.0, marks=pytest.mark.slow), (0.0, 5.2), (None, 2.0)]
)
def test_darks_as_warm_as_the_flats_give_the_dark_current(flat, rate):
    own = [*series(-10.0, 0.0), recording("flat", 0.001, flat, 8000.0)]
    (transfer,) = photon_transfer(CaptureSet("cooled", tuple(own)))
    (found,) = of_all_pixels(transfer).outcomes("dark current, by mean")
    assert found.value == pytest.approx(rate, rel=0.03)


def test_what_is_left_out_is_said_and_nothing_else_is():
    statistics = [frame_statistics(r) for r in series(-10.0, 0.0)]
    kept, line = of_one_temperature(statistics)
    assert {s.recording.temperature_c for s in kept} == {-10.0}
    assert "those of -10 C are used" in line and line.count("(0 C)") == 3
    warming = [
        frame_statistics(recording("dark", s, c)) for s, c in ((0.001, 20.0), (5.0, 24.0), (30.0, 31.0))
    ]
    assert of_one_temperature(warming) == (warming, "")
    unknown = [frame_statistics(r) for r in series(None)]
    assert of_one_temperature(unknown) == (unknown, "")


def test_flats_as_warm_as_no_dark_are_said_where_dark_charge_gathers():
    flat = recording("flat", 5.0, -5.0, 8000.0)
    line = no_dark_as_warm([*series(-10.0, 0.0), flat])
    assert "flats of -5 C, darks of -10 and 0 C" in line and line.endswith("record darks of 5 s at -5 C")
    _, said = of_one_temperature([frame_statistics(r) for r in (*series(-10.0, 0.0), flat)])
    assert said.endswith(line) and "are used, not" in said
    assert not no_dark_as_warm([*series(-10.0, -4.0), flat])
    assert not no_dark_as_warm([*series(-10.0), recording("flat", 0.001, -5.0, 8000.0)])
    assert not no_dark_as_warm([*series(None), flat]) and not no_dark_as_warm([*series(-10.0)])


def warm_flats(*lights):
    """Darks of 0 C, and flats of 30 C whose dark charge differs from pixel to pixel far more than their
    answer to light."""
    flats = [recording("flat", 20.0, 30.0, light, SENSITIVITY, HEAT) for light in lights]
    return [*(recording("dark", s, 0.0, heat=HEAT) for s in (0.001, 20.0)), *flats]


def test_what_warm_flats_hold_in_the_dark_is_no_light():
    captures = CaptureSet("cooled", tuple(warm_flats(3000.0, 11000.0)))
    (transfer,), findings = calibrate(captures)
    seen = of_all_pixels(transfer)
    (found,) = seen.outcomes("PRNU1288")
    assert found.value == pytest.approx(100 * PRNU, rel=0.15)
    assert found.ci90[0] < 100 * PRNU < found.ci90[1]
    (note,) = (q.note for q in seen.quantities if q.name == "PRNU1288")
    assert "between two flats of 20 s" in note
    own = next(f for f in findings if f.mechanism == "prnu")
    assert own.measured["sigma"].value == pytest.approx(PRNU, rel=0.15)
    model = sensor_model((transfer,), findings)
    field = np.asarray(next(m for m in model.mechanisms if m.mechanism == "prnu").maps["field"])[0]
    assert np.corrcoef(field.ravel(), SENSITIVITY.ravel())[0, 1] > 0.5
    assert abs(np.corrcoef(field.ravel(), HEAT.ravel())[0, 1]) < 0.1


def test_one_warm_flat_tells_no_sensitivities():
    (transfer,), findings = calibrate(CaptureSet("cooled", tuple(warm_flats(11000.0))))
    lacking = "record darks of 20 s at 30 C, or flats of two levels"
    assert all(lacking in o.record for o in of_all_pixels(transfer).outcomes("PRNU1288"))
    assert {f.mechanism for f in findings if lacking in getattr(f.estimates, "record", "")} >= {
        "prnu", "column_gain",
    }  # fmt: skip


def test_darks_of_two_temperatures_tell_by_how_many_kelvin_the_dark_current_doubles():
    own = [*series(-10.0, 10.0), recording("flat", 0.001, -10.0, 8000.0)]
    (transfer,), findings = calibrate(CaptureSet("cooled", tuple(own)))
    (found,) = transfer.outcomes(NAME)
    true = 10 * np.log(2) / np.log(2.6)
    assert found.ci90[0] < true < found.ci90[1] and found.value == pytest.approx(true, rel=0.05)
    model = sensor_model((transfer,), findings)
    laws = {m.mechanism: m.scaling for m in model.mechanisms}
    assert laws["dark_current"].doubling_c == pytest.approx(found.value)
    # Within the recordings' own darks only those as warm as the flats are used for the rate.
    (rate,) = of_all_pixels(transfer).outcomes("dark current, by mean")
    assert rate.value == pytest.approx(2.0, rel=0.03)


def test_one_temperature_tells_no_doubling_and_says_so():
    own = [*series(-10.0), recording("flat", 0.001, -10.0, 8000.0)]
    (transfer,) = photon_transfer(CaptureSet("cooled", tuple(own)))
    (found,) = transfer.outcomes(NAME)
    assert "at another temperature" in found.record
    flats = CaptureSet("cooled", (recording("dark", 0.001, -10.0), recording("flat", 0.001, -10.0, 8000.0)))
    assert not photon_transfer(flats)[0].outcomes(NAME)
