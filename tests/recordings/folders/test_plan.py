"""What becomes of folders: groups, their settings, and what is set apart."""

import gzip
import os

import numpy as np
import pytest
from astropy.io import fits

from cannoise_jax import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.plan_text import text
from cannoise_jax.recordings.folders.store import Options, capture_of, write_plan
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.native import read_recording
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.night import labels, night, notes, shot


def test_files_of_one_setting_become_one_recording(tmp_path):
    plan = plan_folder(night(tmp_path))
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2}
    assert not plan.problems and len(plan.sets) == 1
    levels = plan.sets[0].levels
    assert abs(levels.values["black_level"][0] - 1000) <= 2 and levels.values["white_level"] == 16383
    assert levels.values["cfa"] == "MONO"
    assert "median of the biases" in notes(plan) and "equally bright" in notes(plan)
    out = tmp_path / "out"
    written = [path.name for path, _ in write_plan(plan, out)]
    capture = load_capture_set(out)
    assert sorted(written) == ["bias.h5", "dark_60s.h5", "flat_2s.h5"] and capture.camera == "Acme 100"
    (flat,) = capture.of_kind("flat")
    raw = [np.asarray(fits.getdata(tmp_path / f"flat_{n}.fits")) for n in (1, 2)]
    np.testing.assert_array_equal(flat.frames[:], raw)
    assert (flat.exposure_s, flat.count) == (2.0, 2)


def test_frames_are_in_the_order_they_were_taken(tmp_path):
    """By DATE-OBS, or as numbers in their names count up."""
    for folder, dated in (("plain", False), ("dated", True)):
        for n in range(1, 13):
            taken = {"DATE-OBS": f"2026-01-01T00:00:{59 - n:02d}.5"} if dated else {}
            shot(
                tmp_path / folder / f"flat_{n}.fits", "flat", electrons=4000.0 - 20 * n, EXPTIME=2.0, **taken
            )
            shot(tmp_path / folder / f"dark_{n}.fits", "dark", EXPTIME=2.0)
        plan = plan_folder(tmp_path / folder)
        (flats,) = [g for g in plan.sets[0].groups if g.kind == "flat"]
        order = [int(s.path.stem[5:]) for s in flats.shots]
        assert order == sorted(order, reverse=dated)
    one = shot(tmp_path / "dated" / "flat_13.fits", "flat", EXPTIME=2.0, DATE_OBS="01/02/98")
    (flats,) = [g for g in plan_folder(tmp_path / "dated").sets[0].groups if g.kind == "flat"]
    assert flats.shots[-1].path == one and flats.shots[0].path.stem == "flat_1"


def test_biases_of_two_temperatures_are_kept_apart(tmp_path):
    night(tmp_path, CCD_TEMP=-5.1, SET_TEMP=-5.0)
    for n, actual in enumerate((-4.8, -5.3)):  # what a regulated camera drifts by
        shot(tmp_path / f"bias_more{n}.fits", "bias", IMAGETYP="Bias", INSTRUME="Acme 100", EXPTIME=0.0,
             CCD_TEMP=actual, SET_TEMP=-5.0)  # fmt: skip
    shot(tmp_path / "bias_cold.fits", "bias", IMAGETYP="Bias Frame", INSTRUME="Acme 100", EXPTIME=0.0,
         CCD_TEMP=-10.2, SET_TEMP=-10.0)  # fmt: skip
    plan = plan_folder(tmp_path)
    assert labels(plan)["bias_-5C"] == 4 and labels(plan, 1) == {"bias_-10C": 1}
    assert plan.sets[1].reason == "temperature is -10, not -5"
    paths = [p.relative_to(tmp_path / "out") for p, _ in write_plan(plan, tmp_path / "out")]
    assert str(paths[-1]) == "temperature_-10/bias_-10C.h5"
    assert read_recording(tmp_path / "out" / "bias_-5C.h5").temperature_c == pytest.approx(-5.08, abs=0.01)
    assert {r.temperature_c for r in load_capture_set(tmp_path / "out").recordings} == {-5.08, -5.1}


def test_cameras_without_cooling_may_drift(tmp_path):
    night(tmp_path, CCD_TEMP=24.0)
    shot(tmp_path / "dark_x.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0, INSTRUME="Acme 100", CCD_TEMP=12.0)
    plan = plan_folder(tmp_path)
    assert len(plan.sets) == 1 and labels(plan)["dark_60s_12C"] == 1
    assert "temperatures from 12 to 24 C" in notes(plan)


def test_two_settings_of_a_cooled_camera_that_does_not_state_them_are_said(tmp_path):
    night(tmp_path, CCD_TEMP=-10.0)
    bias = {"IMAGETYP": "Bias", "EXPTIME": 0.0, "INSTRUME": "Acme 100", "CCD_TEMP": -5.0}
    shot(tmp_path / "bias_x.fits", "bias", **bias)
    assert "temperatures from -10 to -5 C in one set" in notes(plan_folder(tmp_path))


def test_a_cooler_that_is_not_there_yet_makes_another_recording_of_the_same_set(tmp_path):
    """All frames state what it is set to; four biases what the sensor was at before."""
    for n, celsius in enumerate((-10.1, -9.4, -10.0, -8.9, 3.0, 2.0, 1.5, 1.0)):
        shot(tmp_path / "in" / f"bias_{n}.fits", "bias", IMAGETYP="Bias Frame", EXPTIME=0.0, INSTRUME="Acme",
             CCD_TEMP=celsius, SET_TEMP=-10.0)  # fmt: skip
    for n in (1, 2):
        shot(tmp_path / "in" / f"flat_{n}.fits", "flat", IMAGETYP="Flat Field", EXPTIME=2.0, INSTRUME="Acme",
             CCD_TEMP=-10.0, SET_TEMP=-10.0)  # fmt: skip
    plan = plan_folder(tmp_path / "in")
    assert len(plan.sets) == 1
    assert labels(plan) == {"flat_2s_-10C": 2, "bias_-10C": 4, "bias_2C": 4}
    assert "temperatures from -10 to 1.88 C in one set" in notes(plan)


def test_recordings_are_called_after_their_own_temperature(tmp_path):
    night(tmp_path, CCD_TEMP=-10.0)
    for n in (1, 2, 3):
        shot(tmp_path / f"dark_w{n}.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0, INSTRUME="Acme 100",
             CCD_TEMP=-10 + 0.8 * n)  # fmt: skip
    assert set(labels(plan_folder(tmp_path))) == {"flat_2s_-10C", "bias_-10C", "dark_60s_-9C"}


def test_temperatures_that_drift_on_and_on_are_no_one_setting(tmp_path):
    for celsius in range(20, 26):
        for n in (1, 2):
            shot(tmp_path / f"dark_{celsius}_{n}.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0,
                 INSTRUME="Acme 100", CCD_TEMP=celsius + 0.1 * n, seed=10 * celsius + n)  # fmt: skip
    night(tmp_path, CCD_TEMP=20.5)
    groups = {g.label: g for g in plan_folder(tmp_path).sets[0].groups if g.kind == "dark"}
    spans = {label: np.ptp([s.known["temperature_c"] for s in g.shots]) for label, g in groups.items()}
    assert len(groups) == 2 and sum(g.frames for g in groups.values()) == 14
    assert max(spans.values()) <= 2.5
    middles = sorted(g.settings["temperature_c"] for g in groups.values())
    assert middles == pytest.approx([21.0, 24.15], abs=0.1)


def test_tight_groups_of_temperatures_are_not_cut_through(tmp_path):
    for n, celsius in enumerate((15.0, 15.3, 15.6, 17.0, 17.2, 17.4, 19.0, 19.1)):
        shot(tmp_path / f"dark_{n}.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0, INSTRUME="Acme 100",
             CCD_TEMP=celsius)  # fmt: skip
    plan = plan_folder(tmp_path, {"white_level": 16383.0})
    counts = sorted(g.frames for g in plan.sets[0].groups)
    assert counts in ([2, 6], [3, 5])


@pytest.mark.parametrize(
    "change, label",
    [
        ({"EXPTIME": 61.5}, "dark_61.5s"),
        ({"GAIN": 200}, "dark_60s_gain200"),
        ({"XBINNING": 2}, "dark_60s"),
        ({"OFFSET": 30}, "dark_60s"),
        ({"size": (24, 48)}, "dark_60s"),
        ({"INSTRUME": "Other"}, "dark_60s"),
    ],
)
def test_another_setting_is_another_recording(tmp_path, change, label):
    night(tmp_path)
    shot(tmp_path / "dark_odd.fits", "dark",
         **({"IMAGETYP": "Dark Frame", "EXPTIME": 60.0, "INSTRUME": "Acme 100"} | change))  # fmt: skip
    plan = plan_folder(tmp_path)
    where = 0 if "EXPTIME" in change else 1
    assert labels(plan, where)[label] == 1 and labels(plan)["dark_60s"] == 2
    if "INSTRUME" in change:
        assert "2 cameras (Acme 100, Other): if they are one, name it with --camera" in notes(plan)
        assert labels(plan_folder(tmp_path, {"camera": "Acme"}))["dark_60s"] == 3


def test_filters_are_recordings_of_their_own(tmp_path):
    night(tmp_path, FILTER="Ha 7nm")
    for n in (1, 2):
        shot(tmp_path / f"flat_r{n}.fits", "flat", IMAGETYP="Flat Field", EXPTIME=2.0, INSTRUME="Acme 100",
             FILTER="R")  # fmt: skip
    assert labels(plan_folder(tmp_path)) == {"flat_2s_Ha-7nm": 2, "flat_2s_R": 2, "dark_60s": 2, "bias": 2}


def test_numbered_offsets_are_biases_and_settings_are_none(tmp_path):
    for n in range(2):
        shot(tmp_path / f"Offset_000{n}.fits", "bias", EXPTIME=0.0)
        shot(tmp_path / f"Dark_offset50_000{n}.fits", "dark", EXPTIME=60.0)
        shot(tmp_path / f"PLU_000{n}.fits", "flat", EXPTIME=2.0)
    assert {g.kind for g in plan_folder(tmp_path, {"camera": "C"}).sets[0].groups} == {"bias", "dark", "flat"}


def test_a_colour_order_that_flats_alone_state_is_that_of_all(tmp_path):
    night(tmp_path)
    for n in (3, 4):
        shot(tmp_path / f"flat_{n}.fits", "flat", BAYERPAT="RGGB",
             IMAGETYP="Flat Field", EXPTIME=2.0, INSTRUME="Acme 100")  # fmt: skip
    plan = plan_folder(tmp_path)
    assert len(plan.sets) == 1 and not plan.problems and "RGGB, as the others" in notes(plan)


def test_gains_in_short_and_darks_of_unknown_exposures_are_not_joined(tmp_path):
    rng = np.random.default_rng(0)

    def stack(name, level):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        np.save(tmp_path / name, rng.poisson(level, (3, 16, 16)).astype(np.uint16))

    for gain in ("g1", "g2"):
        stack(f"a/dark_10ms_{gain}.npy", 100)
        stack(f"a/flat_10ms_{gain}.npy", 900)
    first, second = plan_folder(tmp_path / "a").sets
    assert {g.mode[4] for g in first.groups} | {g.mode[4] for g in second.groups} == {1.0, 2.0}
    assert labels(plan_folder(tmp_path / "a")).keys() < {
        f"{k}_10ms_gain{n}" for k in ("dark", "flat") for n in "12"
    }
    for name, level in (("darks_short", 100), ("darks_long", 140), ("flats", 900)):
        for n in range(2):
            stack(f"b/{name}/raw_{n}.npy", level)
    plan = plan_folder(tmp_path / "b")
    assert labels(plan) == {"flat": 6, "dark_1": 6, "dark_2": 6}
    assert plan.sets[0].levels.values["black_level"][0] < 110 and "median of the darks\n" in notes(plan)


def test_values_of_any_type_that_are_whole_numbers(tmp_path):
    night(tmp_path)
    for n, kind in enumerate((np.int16, np.int32, np.float32)):
        shot(
            tmp_path / f"dark_t{n}.fits",
            "dark",
            dtype=kind,
            IMAGETYP="Dark",
            EXPTIME=60.0,
            INSTRUME="Acme 100",
        )
    packed = tmp_path / "dark_z.fits.gz"
    path = shot(tmp_path / "dark_z.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0, INSTRUME="Acme 100")
    packed.write_bytes(gzip.compress(path.read_bytes()))
    path.unlink()
    plan = plan_folder(tmp_path)
    assert labels(plan)["dark_60s"] == 6 and not plan.problems
    for _ in write_plan(plan, tmp_path / "out"):
        pass
    assert read_recording(tmp_path / "out" / "dark_60s.h5").frames[:].mean() == pytest.approx(1000, abs=1)


def test_a_camera_model_kept_with_its_recordings_is_none_of_them(tmp_path):
    night(tmp_path / "in")
    before = labels(plan_folder(tmp_path / "in"))
    model = SensorModel.poisson_gaussian(2.0, 3.0, 1000, 65535, "MONO").with_mechanism("dsnu", sigma_dn=1.0)
    write_sensor(tmp_path / "in" / "sensor.json", model.with_maps((24, 32)))
    assert (tmp_path / "in" / "sensor.npz").is_file()
    plan = plan_folder(tmp_path / "in")
    assert labels(plan) == before and not plan.problems and "sensor.npz" not in text(plan)
    for path in (tmp_path / "in").glob("*.fits"):
        path.unlink()
    with pytest.raises(BadInput, match="holds no recordings"):
        load_capture_set(tmp_path / "in")


def test_a_real_night(real_data):
    plan = plan_folder(real_data / "night_fits")
    assert labels(plan) == {"flat_23s_Visible_-5C": 2, "dark_60s_-5C": 2, "dark_300s_-5C": 1, "bias_-5C": 2}
    assert labels(plan, 1) == {"bias_-10C": 1} and not plan.problems
    assert "headed 'Light Frame', flat by name" in notes(plan)
    assert plan.sets[0].levels.values == {
        "cfa": "MONO",
        "black_level": (992.5,) * 4,
        "white_level": 65535.0,
    }


def test_dim_frames_of_a_wider_word_are_no_camera_of_8_bits(tmp_path):
    for n in range(2):
        values = np.random.default_rng(n).integers(90, 110, (24, 32)).astype(np.uint16)
        fits.PrimaryHDU(values, fits.Header({"IMAGETYP": "Flat"})).writeto(tmp_path / f"flat_{n}.fits")
    plan = plan_folder(tmp_path, {"cfa": "MONO", "black_level": 64.0})
    assert "white level 1023 DN: the highest value is 109, so of 10 bits" in notes(plan)


@pytest.mark.parametrize(
    ("step", "top", "white"),
    [(2, 900, 1022), (2, 3000, 4094), (16, 3000, 65520), (2, 40000, 65534), (8, 900, 1016)],
)
def test_codes_apart_are_shifted_where_a_converter_has_them(tmp_path, step, top, white):
    """No converter of 15 or 13 bits is common: such codes are some of those of a shorter word."""
    for n in range(2):
        values = np.random.default_rng(n).integers(64 // step, top // step, (24, 32)).astype(np.uint16) * step
        fits.PrimaryHDU(values, fits.Header({"IMAGETYP": "Flat"})).writeto(tmp_path / f"flat_{n}.fits")
    plan = plan_folder(tmp_path, {"cfa": "MONO", "black_level": 32.0})
    assert plan.sets[0].levels.values["white_level"] == white


def test_files_of_8_bits_are_kept_apart_from_those_of_16(tmp_path):
    """Their values are in other units."""
    night(tmp_path)
    for n in (1, 2):
        values = np.random.default_rng(n).integers(10, 200, (24, 32), np.uint8)
        header = fits.Header({"IMAGETYP": "Dark", "INSTRUME": "Acme 100", "EXPTIME": 60.0})
        fits.PrimaryHDU(values, header).writeto(tmp_path / f"dark_small{n}.fits")
    plan = plan_folder(tmp_path)
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2}
    assert "bits is 8, not 16" in plan.sets[1].reason


def test_names_that_are_no_text_reach_the_cache_and_its_plan(tmp_path):
    folder = tmp_path / os.fsdecode(b"in\xff")
    night(folder, INSTRUME="")
    os.rename(folder / "flat_1.fits", folder / os.fsdecode(b"flat_\xff.fits"))
    capture, said = capture_of(folder, Options({}), tmp_path / "cache")
    assert capture.camera == "in?" and "flat_" in said
    again, _ = capture_of(folder, Options({}), tmp_path / "cache")
    assert [r.count for r in again.recordings] == [2, 2, 2]
    assert any("\udcff" in "".join(r.sources) for r in again.recordings)


def test_files_that_are_full_show_where_the_codes_of_their_gain_end(tmp_path):
    values = np.random.default_rng(0).integers(90, 9000, (24, 32)).astype(np.uint16)
    for name, frame, gain in (("a", values, 1), ("b", np.full_like(values, 65535), 1), ("c", values + 1, 2)):
        header = fits.Header({"IMAGETYP": "Flat", "GAIN": gain})
        fits.PrimaryHDU(frame, header).writeto(tmp_path / f"flat_{name}.fits")
    plan = plan_folder(tmp_path, {"cfa": "MONO", "black_level": 64.0})
    ends = {g.mode[4]: g.settings.get("full_code") for one in plan.sets for g in one.groups}
    assert ends == {1: 65535.0, 2: None}
    assert {s.levels.values["white_level"] for s in plan.sets if s.groups[0].mode[4] == 1} == {65535.0}
    assert "every pixel is 65535 (saturated): left out" in notes(plan)
