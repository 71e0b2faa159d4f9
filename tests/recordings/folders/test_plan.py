"""What becomes of folders: groups, what is set apart, what is said, and what is refused, all at once."""

import gzip
import json
import os
import shutil

import numpy as np
import pytest
from astropy.io import fits

from cannoise_jax import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.folders.plan import check, plan_folder, text
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


def test_a_white_level_is_not_guessed_from_darks_alone(tmp_path):
    for n in (1, 2):
        shot(tmp_path / f"dark_{n}.fits", "dark", IMAGETYP="Dark", EXPTIME=60.0, INSTRUME="Acme 100")
    plan = plan_folder(tmp_path, {"cfa": "MONO"})
    assert (
        "the white level: darks alone, here of 10" in plan.problems[0] and "--white-level" in plan.problems[0]
    )
    assert not plan_folder(tmp_path, {"cfa": "MONO", "white_level": 16383.0}).problems
    hot = np.asarray(fits.getdata(tmp_path / "dark_1.fits")).copy()
    hot[3, 5] = 16383  # a hot pixel reaches the highest code
    fits.PrimaryHDU(hot, fits.getheader(tmp_path / "dark_1.fits")).writeto(tmp_path / "dark_3.fits")
    seen = plan_folder(tmp_path, {"cfa": "MONO"})
    assert not seen.problems and seen.sets[0].levels.values["white_level"] == 16383


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


def test_reasons_that_differ_by_a_number_are_said_once(tmp_path):
    night(tmp_path)
    for n in range(9):
        planes = np.stack([np.full((24, 32), 1000 * (k + 1) + n, np.uint16) for k in range(3)])
        fits.PrimaryHDU(planes).writeto(tmp_path / f"colour_{n}.fits")
    problems = plan_folder(tmp_path).problems
    assert len(problems) == 1 and "and 6 more: the first: " in problems[0]


def test_a_refusal_says_what_was_left_out(tmp_path):
    night(tmp_path)
    for path in tmp_path.glob("flat*"):
        path.unlink()
    for n in (1, 2):
        fits.PrimaryHDU(np.full((24, 32), 65535, np.uint16)).writeto(tmp_path / f"flat_{n}.fits")
    with pytest.raises(BadInput, match=r"flat_1.fits, flat_2.fits: every pixel is 65535 \(saturated\)"):
        check(plan_folder(tmp_path))


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


def test_darks_of_another_size_are_named_where_the_black_level_is_missing(tmp_path):
    for n in range(2):
        shot(tmp_path / f"flat{n}.fits", "flat", EXPTIME=1.0)
        shot(tmp_path / f"dark{n}.fits", "dark", EXPTIME=1.0, size=(24, 48))
    with pytest.raises(
        BadInput, match="--black-level; dark0.fits: of no use to flat0.fits, for size is 24x48"
    ):
        check(plan_folder(tmp_path))


def test_everything_missing_is_said_at_once(tmp_path):
    for n in (1, 2):
        shot(tmp_path / f"flat{n}.fits", "flat", colours=1.6, EXPTIME=1.0)
        shot(tmp_path / f"other{n}.fits", "flat", colours=1.6, EXPTIME=1.0, IMAGETYP="Focus")
    shot(tmp_path / "flat_x.fits", "flat", IMAGETYP="Dark Frame", EXPTIME=1.0)
    (tmp_path / "broken.fits").write_bytes(b"SIMPLE")
    plan = plan_folder(tmp_path)
    assert "other1.fits, other2.fits: IMAGETYP 'Focus' is unknown: taken as lights" in notes(plan)
    said = "\n".join(plan.problems)
    for words in ("broken.fits: not a readable", "--cfa", "--black-level", "--assign",
                  "headed 'Dark Frame' but named flat", "--leave-out"):  # fmt: skip
        assert words in said
    with pytest.raises(BadInput, match="broken.fits.*flat_x.fits.*--black-level") as caught:
        check(plan)
    assert "\n" not in str(caught.value)
    with pytest.raises(BadInput, match="--leave-out passes over every recording"):
        plan_folder(tmp_path, leave_out=["*"])
    mended = plan_folder(
        tmp_path,
        {"cfa": "RGGB", "black_level": (1000.0,)},
        assign=[("other*", "flat")],
        leave_out=["broken*", "flat_x*"],
    )
    assert not mended.problems and labels(mended) == {"flat_1s": 4}
    assert mended.sets[0].groups[0].frames == 4


def test_an_average_a_copy_and_a_picture_are_no_frames(tmp_path):
    night(tmp_path)
    shutil.copy(tmp_path / "dark_1.fits", tmp_path / "dark_again.fits")
    shot(tmp_path / "master_bias.fits", "bias", IMAGETYP="Bias Frame")
    shot(tmp_path / "b.fits", "bias", IMAGETYP="Bias Frame", NCOMBINE=20, INSTRUME="Acme 100")
    shot(tmp_path / "c.fits", "bias", IMAGETYP="Master Bias", INSTRUME="Acme 100")
    (tmp_path / "view.jpg").write_bytes(b"\xff\xd8")
    plan = plan_folder(tmp_path)
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2}
    said = notes(plan)
    assert "dark_again.fits: the same pixels as dark_1.fits" in said and "1 .jpg" in said
    for name in (
        "master_bias.fits: an average",
        "b.fits: an average, no frame (20 frames)",
        "c.fits: an average",
    ):
        assert name in said


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


def test_the_folder_names_a_camera_that_no_header_names(tmp_path):
    plan = plan_folder(night(tmp_path / "bench", INSTRUME=""))
    assert {g.settings["camera"] for g in plan.sets[0].groups} == {"bench"}
    assert "called bench" in notes(plan)


def test_text_names_every_file_and_note(tmp_path):
    night(tmp_path)
    plan = plan_folder(tmp_path)
    said = text(plan)
    assert "Acme 100, 24 x 32, MONO" in said and "dark_1.fits to dark_2.fits" in said
    assert said.count("note: ") == len(plan.notes)


def test_exposures_that_nothing_states_are_said(tmp_path):
    stated, silent = (
        plan_folder(night(tmp_path / n, **more)) for n, more in (("a", {}), ("b", {"EXPTIME": ""}))
    )
    assert "no exposure time" not in notes(stated)
    (said,) = [note for note in silent.notes if "no exposure time in headers or names" in note]
    assert said.startswith("flat, dark: ") and not silent.problems


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


def test_files_of_one_value_are_left_out_and_said(tmp_path):
    night(tmp_path)
    for n in range(3):
        blank = np.zeros((32, 48), np.uint16)
        fits.writeto(tmp_path / f"dark_blank{n}.fits", blank, fits.Header({"IMAGETYP": "Dark", "EXPTIME": 9}))
    plan = plan_folder(tmp_path)
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2} and not plan.problems
    assert "dark_blank0.fits, dark_blank1.fits, dark_blank2.fits: every pixel is 0 (" in notes(plan)
    for path in tmp_path.glob("*[1-2].fits"):
        path.unlink()
    blanks = plan_folder(tmp_path)
    assert blanks.sets == () and "every pixel is 0" in blanks.problems[0]


def test_doubtful_exposures_links_and_odd_names_are_said_in_one_line_each(tmp_path):
    folder = night(tmp_path / "in")
    for name, seconds in (("a", {"EXPTIME": "1,500"}), ("b\n", {"EXPTIME": 2.0, "EXPOSURE": 20.0})):
        shot(folder / f"dark_{name}.fits", "dark", IMAGETYP="Dark", INSTRUME="Acme 100", **seconds)
    (folder / "night before").symlink_to(tmp_path)  # and back in here
    (folder / "darks of June").symlink_to(tmp_path / "gone")
    (folder / "more.fits.bz2").write_bytes(b"BZh9")
    plan = plan_folder(folder)
    assert "darks of June: not read, a link to nothing" in notes(plan)
    assert "not read: 1 .bz2 (unpack them)" in notes(plan)
    assert "dark_a.fits: EXPTIME '1,500': no time: not used" in notes(plan)
    assert "EXPTIME 2 s and EXPOSURE 20 s contradict: EXPTIME 2 s is used" in notes(plan)
    assert "night before: not read, links to folders are not followed" in notes(plan)
    assert "dark_b .fits" in text(plan) and len(plan.shots) == 8
    (folder / "dark_b\n.fits").write_bytes(b"no header")
    with pytest.raises(BadInput) as refused:
        check(plan_folder(folder))
    assert "\n" not in str(refused.value) and "not a readable FITS file" in str(refused.value)


def test_dim_frames_of_a_wider_word_are_no_camera_of_8_bits(tmp_path):
    for n in range(2):
        values = np.random.default_rng(n).integers(90, 110, (24, 32)).astype(np.uint16)
        fits.PrimaryHDU(values, fits.Header({"IMAGETYP": "Flat"})).writeto(tmp_path / f"flat_{n}.fits")
    plan = plan_folder(tmp_path, {"cfa": "MONO", "black_level": 64.0})
    assert "white level 1023 DN: the highest value is 109, so of 10 bits" in notes(plan)


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


def test_values_without_a_header_are_named_with_what_to_do(tmp_path):
    packed = np.arange(5 * 6 * 8 // 4, dtype=np.uint8)
    packed.tofile(tmp_path / "dark_10ms_8x6_10bit.bin")
    with pytest.raises(BadInput, match=r"only 1 \.bin: values without a header: .*numpy\.save"):
        plan_folder(tmp_path)
    night(tmp_path)
    assert "not read: 1 .bin (values without a header" in notes(plan_folder(tmp_path))
    packed.tofile(tmp_path / "dark_10ms_8x6_10bit.raw")
    (problem,) = plan_folder(tmp_path).problems
    assert "8x6_10bit.raw: not a readable camera raw file, perhaps values without a header: read" in problem


def test_columns_of_a_plan_stand_below_each_other(tmp_path):
    night(tmp_path, FILTER="A narrow band of nitrogen")
    lines = [line for line in text(plan_folder(tmp_path)).splitlines() if ".h5" in line]
    assert len(lines) == 3 and len({line.index(" frames") for line in lines}) == 1


@pytest.mark.parametrize(
    "field, value, said",
    [
        ("cfa", ["R", "G"], "expected text"),
        ("cfa", "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG", "an X-Trans mosaic"),
        ("white_level", [1, 2], "expected one number"),
        ("iso", True, "expected one number"),
        ("black_level", "x", "expected 1 or 4 numbers"),
        ("kind", {"a": 1}, "expected text"),
        ("gain_db", -400, "at least -200"),
        ("temperature_c", -400, "at least -273"),
    ],
)
def test_what_side_cars_say_is_held_to_the_rules_of_single_files(tmp_path, field, value, said):
    rng = np.random.default_rng(0)
    for kind, level in (("bias", 100), ("flat", 2000)):
        for n in range(2):
            np.save(tmp_path / f"{kind}_{n}.npy", rng.normal(level, 9, (16, 24)).astype(np.uint16))
    (tmp_path / "flat_0.json").write_text(json.dumps({field: value}))
    (problem,) = [p for p in plan_folder(tmp_path).problems if p.startswith("flat_0.npy")]
    assert said in problem and "\n" not in problem
    if field != "kind":
        stated = plan_folder(tmp_path, {field: {"cfa": "MONO", "black_level": 100.0}.get(field, 4095.0)})
        assert not [p for p in stated.problems if p.startswith("flat_0.npy")]


def test_a_pattern_without_a_file_and_levels_the_wrong_way_round_are_said(tmp_path):
    patterns = {"assign": [("darc*", "dark")], "leave_out": ["zzz*", "bias_1*"]}
    plan = plan_folder(night(tmp_path), {"white_level": 10.0}, **patterns)
    assert "--assign darc*=dark: no file of such a name" in notes(plan)
    assert "--leave-out zzz*: no file of such a name" in notes(plan) and "bias_1" not in notes(plan)
    assert any("the white level of 10 DN is not above the black level" in p for p in plan.problems)


def test_a_folder_that_cannot_be_read_is_named(tmp_path, monkeypatch):
    """Permissions do not bind every user that runs tests: what lists a folder stands in for them."""
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    shot(folder / "more" / "dark_3.fits", "dark", IMAGETYP="Dark Frame", EXPTIME=60.0, INSTRUME="Acme 100")
    options = Options({"white_level": 16383.0})
    assert len(capture_of(folder, options, cache)[0].recordings) == 3
    listed, closed = os.scandir, folder / "more"

    def scandir(path):
        if os.fspath(path) == str(closed):
            raise PermissionError(13, "Permission denied", str(path))
        return listed(path)

    monkeypatch.setattr(os, "scandir", scandir)
    for read in (lambda: plan_folder(folder), lambda: capture_of(folder, options, cache)):
        with pytest.raises(
            BadInput, match="/in/more: cannot be read .Permission denied.: .*--leave-out 'more'"
        ):
            read()
    assert labels(plan_folder(folder, leave_out=["more"]))["dark_60s"] == 2
    assert len(capture_of(folder, options._replace(leave_out=["more"]), cache)[0].recordings) == 3
    closed = folder
    with pytest.raises(BadInput, match="/in: cannot be read .Permission denied.: make it readable$"):
        plan_folder(folder)


def test_levels_of_one_camera_are_none_of_another(tmp_path):
    night(tmp_path)
    for n in (1, 2):
        shot(tmp_path / f"other/flat_{n}.fits", "flat", IMAGETYP="Flat", EXPTIME=2.0, INSTRUME="Other 5")
    plan = plan_folder(tmp_path)
    (problem,) = plan.problems
    assert problem.startswith("other/flat_1.fits, other/flat_2.fits, of Other 5: the black level: add bias")
    with pytest.raises(BadInput, match="holds 2 cameras"):
        capture_of(tmp_path, Options({}), tmp_path.parent / "cache")
    assert not plan_folder(tmp_path, {"black_level": (990.0,)}).problems
    assert not plan_folder(tmp_path, {"camera": "one"}).problems
    assert not plan_folder(tmp_path, leave_out=["other"]).problems


def test_levels_that_a_set_apart_takes_from_the_first_are_said(tmp_path):
    night(tmp_path)
    for n in (1, 2):
        shot(
            tmp_path / f"b{n}.fits", "flat", size=(12, 16), IMAGETYP="Flat", EXPTIME=2.0, INSTRUME="Acme 100"
        )
    plan = plan_folder(tmp_path)
    assert not plan.problems and "size_12x16/: black level as in the first set" in plan.notes


def test_names_that_are_no_text_reach_the_cache_and_its_plan(tmp_path):
    folder = tmp_path / os.fsdecode(b"in\xff")
    night(folder, INSTRUME="")
    os.rename(folder / "flat_1.fits", folder / os.fsdecode(b"flat_\xff.fits"))
    capture, said = capture_of(folder, Options({}), tmp_path / "cache")
    assert capture.camera == "in?" and "flat_" in said
    again, _ = capture_of(folder, Options({}), tmp_path / "cache")
    assert [r.count for r in again.recordings] == [2, 2, 2]
    assert any("\udcff" in "".join(r.sources) for r in again.recordings)


def test_averages_of_one_kind_are_one_note(tmp_path):
    night(tmp_path)
    for n in range(8):
        shot(tmp_path / f"sum_{n}.fits", "flat", IMAGETYP="Flat Field", NCOMBINE=4, INSTRUME="Acme 100")
    said = [note for note in plan_folder(tmp_path).notes if "averages" in note]
    assert len(said) == 1 and "and 5 more" in said[0]


def test_a_negative_black_level_that_is_stated_is_a_problem(tmp_path):
    problems = plan_folder(night(tmp_path), {"black_level": (-5.0,)}).problems
    assert len(problems) == 1 and "-5 DN" in problems[0]
