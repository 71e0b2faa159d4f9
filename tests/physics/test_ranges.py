"""What no camera has, or cannot record, is refused in one line when a model is composed or asked."""

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.core.sensor import IsoTable, SensorModel, Settings

SIZE = (32, 32)
FLAT = np.full(SIZE, 0.2, np.float32)
MODEL = SensorModel.poisson_gaussian(0.5, 3.0, (60, 64, 68, 72), 1084, "RGGB")
KEY = jax.random.key(1)


def poisson_gaussian(**changes):
    known = {"gain_dn_per_e": 0.5, "read_noise_e": 3.0, "black_level": 64.0, "white_level": 1023.0}
    return SensorModel.poisson_gaussian(**{**known, **changes})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain_dn_per_e": 0.0}, "gain_dn_per_e must be positive"),
        ({"gain_dn_per_e": float("nan")}, "gain_dn_per_e is nan, not a finite number"),
        ({"gain_dn_per_e": "high"}, "not a finite number"),
        ({"read_noise_e": -1.0}, "read_noise_e must be positive"),
        ({"read_noise_e": float("inf")}, "not a finite number"),
        (
            {"read_noise_e": 1e300},
            r"is 1e\+300, more than 3.4e\+38, the largest number that is kept",
        ),
        ({"read_noise_e": 10**400}, r"read_noise_e is 1000.*, more than 3.4e\+38"),
        ({"black_level": 2000.0}, "not above black_level"),
        ({"black_level": float("nan")}, "black_level is nan"),
        ({"white_level": 65536.0}, "above 65535"),
        ({"code_step": -1.0}, "code_step -1"),
        ({"gain_dn_per_e": 5e5}, "500000 is more than the 959 DN from black to white, so that one electron"),
        ({"gain_dn_per_e": [0.5, 0.5, 0.5, 960.0]}, "960 is more than the 959 DN"),
        ({"code_step": 1000.0}, "code_step 1000 leaves 1 codes from black to white"),
        ({"code_step": 64.0}, "code_step 64 leaves 15 codes"),
        ({"iso": 0.0}, "iso must be above 0"),
        ({"iso": 1e-40}, "iso must be above 0"),
        ({"iso": 2e9}, "iso must be at most 1e\\+09, got 2e\\+09"),
        ({"read_noise_e": 1e6}, "wider than the"),
        ({"cfa": "RGBW"}, "cfa is 'RGBW'"),
        ({"cfa": np.array([[0, 1], [1, 2]])}, r"cfa is array\(\[\[0, 1\], \[1, 2\]\]\), not one of RGGB"),
    ],
    ids=lambda v: str(v) if isinstance(v, dict) else "",
)
def test_a_baseline_that_no_camera_has_is_refused_in_one_line(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        poisson_gaussian(**change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "change",
    [
        {"gain_dn_per_e": 1.0, "black_level": 0.0, "white_level": 3.0},  # photons counted in two bits
        {"black_level": 0.0, "white_level": 65280.0, "code_step": 256.0},  # eight bits, shifted to sixteen
        {"code_step": 63.0},
        {"gain_dn_per_e": 900.0, "read_noise_e": 0.5},
    ],
)
def test_few_shades_and_high_gains_that_cameras_have_are_taken(change):
    poisson_gaussian(**change).sample(KEY, FLAT)


@pytest.mark.parametrize("key", [0, None, "0", FLAT, np.zeros(2), jax.random.split(KEY, 3)])
def test_what_is_no_key_is_refused_in_one_line(key):
    with pytest.raises(
        TypeError, match=r"key is .*: expected (a|one) key.*, as jax.random.key\(0\)"
    ) as caught:
        MODEL.sample(key, FLAT)
    assert "\n" not in str(caught.value)


def test_keys_of_both_kinds_draw_with_and_without_jit():
    for key in (KEY, jax.random.PRNGKey(1), np.asarray(jax.random.PRNGKey(1))):
        assert np.array_equal(jax.jit(MODEL.sample)(key, FLAT), MODEL.sample(key, FLAT))


@pytest.mark.parametrize("mechanism", [None, 3, Point])
def test_what_is_no_mechanism_is_refused_in_one_line(mechanism):
    with pytest.raises(TypeError, match="mechanism is of type .*: expected its name, or an entry") as caught:
        MODEL.with_mechanism(mechanism)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("id", "change", "message"),
    [
        ("row_noise", {"sigma_dn": -1.0}, "sigma_dn = -1 is outside 0 to"),
        ("row_noise", {"sigma_dn": float("nan")}, "sigma_dn is nan"),
        ("row_noise", {"sigma_dn": None}, "sigma_dn is None"),
        ("heavy_tails", {"tukey_lambda": -0.5}, "outside -0.45 to 0.3"),
        ("rts", {"fraction": 1.5}, "outside 1e-06 to 1"),
        ("row_noise", {"sigma_dn": IsoTable(np.array([400.0, 100.0]), np.ones(2))}, "ascend"),
        ("row_noise", {"sigma_dn": IsoTable(np.array([100.0]), np.array([-1.0]))}, "outside"),
        ("dark_current", {"scaling": Scaling(doubling_c=0.0)}, "doubling_c is 0, not above 0"),
        ("dsnu", {"maps": {"fild": np.zeros(SIZE, np.float32)}}, "maps are fild, it has field"),
        ("dsnu", {"maps": {"field": np.full(SIZE, np.nan, np.float32)}}, "not finite"),
        ("stripes", {"point": Point("readout", "signal", "moon", "redrawn")}, "grammar over is 'moon'"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_mechanism_outside_its_ranges_is_refused_in_one_line(id, change, message):
    with pytest.raises(ValueError, match=message) as caught:
        MODEL.with_mechanism(id, **change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("clean", "settings", "message"),
    [
        (FLAT, jax.tree.map(np.zeros_like, Settings()), "iso must be above 0"),
        (FLAT, Settings(iso=np.array([100.0, 200.0])), "iso has 2 values"),
        (FLAT, Settings(exposure_s=None), "exposure_s is None"),
        (800 * FLAT + 300, Settings(), "so it is not normalised"),
        (FLAT - 3, Settings(), "so it is not normalised"),
        (500.0 * np.eye(len(FLAT)), Settings(), "clean holds whole numbers up to 500"),
        (np.ma.masked_less(FLAT, 0), Settings(), "clean is a masked array"),
        (FLAT > 0, Settings(), "clean holds truths, as a mask does"),
        (np.where(np.arange(32) == 3, np.nan, FLAT), Settings(), "clean holds values that are not finite"),
        (FLAT[None], Settings(), r"clean must be a mosaic \[H, W\]"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_what_cannot_be_recorded_is_refused_in_one_line(clean, settings, message):
    with pytest.raises(ValueError, match=message) as caught:
        MODEL.sample(KEY, clean, settings)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"frames": 0}, "frames must be a whole number from 1"),
        ({"frames": 1.5}, "frames must be a whole number from 1"),
        ({"frames": 2.0}, "frames must be a whole number from 1"),
        ({"iso": 0.0}, "iso must be above 0"),
        ({"iso": 0}, "iso must be above 0, at most 1e\\+09, got 0"),
        ({"iso": 1e-40}, "iso must be above 0"),
        ({"iso": -100}, "iso must be above 0"),
        ({"iso": True}, "iso must be above 0.*, got True"),
        ({"iso": np.array([100.0, np.inf])}, "iso must be above 0.*, got inf"),
        ({"iso": jax.numpy.zeros(())}, "iso must be above 0"),
        ({"iso": "800"}, "iso must be above 0.*, got '800'"),
        ({"iso": [100, 200]}, "iso must be above 0"),
        ({"exposure_s": -1.0}, "exposure_s must be 0 or 1e-09 to 1e\\+06, got -1"),
        ({"exposure_s": float("inf")}, "exposure_s must be"),
        ({"exposure_s": 1e9}, "exposure_s must be"),
        ({"temperature_c": float("nan")}, "temperature_c must be"),
        ({"temperature_c": -400.0}, "temperature_c must be -273.15 to 150, got -400"),
        ({"temperature_c": 1000.0}, "temperature_c must be"),
    ],
)
def test_settings_that_no_recording_has_are_refused_when_they_are_made(given, message):
    with pytest.raises(ValueError, match=message) as caught:
        Settings(**given)
    assert "\n" not in str(caught.value)
