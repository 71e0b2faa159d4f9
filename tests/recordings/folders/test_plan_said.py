"""What is said of folders, and what is refused, all at once."""

import json
import os
import shutil

import h5py
import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.recordings.folders.aside import guessed_white_of
from cannoise_jax.recordings.folders.plan import check, plan_folder
from cannoise_jax.recordings.folders.plan_text import text
from cannoise_jax.recordings.folders.store import Options, capture_of, write_plan
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.night import labels, night, notes, shot


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


def test_a_white_level_that_was_guessed_is_told_from_one_that_is_stated(tmp_path):
    guessed = guessed_white_of(text(plan_folder(night(tmp_path))))
    assert guessed.startswith("Guessed, and with it what is normalised: white level 16383 DN: the highest")
    assert guessed_white_of(text(plan_folder(tmp_path, {"white_level": 16383.0}))) == ""


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
        "b.fits: an average or sum, no frame (20 frames by NCOMBINE)",
        "c.fits: an average or sum",
    ):
        assert name in said


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
    (tmp_path / "dark_1.fits").rename(tmp_path / "dark_1\x1b[31m.fits")
    assert "dark_1?[31m.fits" in text(plan_folder(tmp_path))


def test_exposures_that_nothing_states_are_said(tmp_path):
    stated, silent = (
        plan_folder(night(tmp_path / n, **more)) for n, more in (("a", {}), ("b", {"EXPTIME": ""}))
    )
    assert "no exposure time" not in notes(stated)
    (said,) = [note for note in silent.notes if "no exposure time in headers or names" in note]
    assert said.startswith("flat, dark: ") and not silent.problems


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
    if "X-Trans" in said:  # whatever order the caller states
        assert any(said in p for p in plan_folder(tmp_path, {"cfa": "RGGB"}).problems)
    elif field != "kind":
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


def test_averages_of_one_kind_are_one_note(tmp_path):
    night(tmp_path)
    for n in range(8):
        shot(tmp_path / f"sum_{n}.fits", "flat", IMAGETYP="Flat Field", NCOMBINE=4, INSTRUME="Acme 100")
    said = [note for note in plan_folder(tmp_path).notes if "averages" in note]
    assert len(said) == 1 and "and 5 more" in said[0]


def test_a_negative_black_level_that_is_stated_is_a_problem(tmp_path):
    problems = plan_folder(night(tmp_path), {"black_level": (-5.0,)}).problems
    assert len(problems) == 1 and "-5 DN" in problems[0]


def test_flats_are_compared_with_darks_of_their_own_gain(tmp_path):
    """Light reached the darks of one gain: its flats are named, and not the brighter ones of the other."""
    for gain, flat, dark in ((100, 500.0, 0.0), (200, 1500.0, 2000.0)):
        for n in range(2):
            more = {"EXPTIME": 1.0, "GAIN": gain, "INSTRUME": "ZWO ASI1600"}
            shot(tmp_path / f"flat{gain}_{n}.fits", "flat", electrons=flat, **more)
            shot(tmp_path / f"dark{gain}_{n}.fits", "dark", electrons=dark, **more)
    (said,) = [note for note in plan_folder(tmp_path).notes if "no brighter than the darks" in note]
    assert said.startswith("flat200_0.fits, flat200_1.fits: ")


def test_a_bias_that_was_exposed_is_said(tmp_path):
    night(tmp_path)
    assert "a bias has the shortest exposure" not in notes(plan_folder(tmp_path))
    fits.setval(tmp_path / "bias_1.fits", "EXPTIME", value=20.0)
    assert "bias_1.fits: a bias has the shortest exposure" in notes(plan_folder(tmp_path))


@pytest.mark.parametrize(("name", "said"), [("EGAIN", (1.6, 0.7)), ("GAIN", (1.6, 0.7)), ("GAIN", (2, 1))])
def test_frames_of_two_gains_are_set_apart_however_they_state_them(tmp_path, name, said):
    night(tmp_path)
    for path in tmp_path.glob("*.fits"):
        fits.setval(path, name, value=said["flat" in path.name])
    plan = plan_folder(tmp_path)
    assert len(plan.sets) == 2 and "gain" in plan.sets[1].reason
    for path in tmp_path.glob("*.fits"):
        fits.setval(path, name, value=said[0])
    assert len(plan_folder(tmp_path).sets) == 1


def test_swapped_kinds_and_darks_of_another_gain_are_said(tmp_path):
    for n in range(2):
        shot(tmp_path / "a" / f"{n}.fits", "flat", IMAGETYP="Dark Frame", EXPTIME=1.0)
        shot(tmp_path / "a" / f"flat{n}.fits", "dark", IMAGETYP="Flat Field", EXPTIME=1.0)
        for kind, gain in (("flat", 100), ("dark", 40)):
            shot(tmp_path / "b" / f"{kind}{n}.fits", kind, EXPTIME=1.0, GAIN=gain, INSTRUME="ZWO ASI1600")
    assert any("darker than every dark" in p for p in plan_folder(tmp_path / "a").problems)
    plan = plan_folder(tmp_path / "b")
    assert "flat_1s_gain10dB: no dark or bias of that gain" in notes(plan) and not plan.problems
    capture, _ = capture_of(tmp_path / "b", Options({}), tmp_path / "cache")
    with pytest.raises(BadInput, match=r"at gain 10 dB \(others: gain 4 dB\): record .* with the cap on"):
        sensor_model(*calibrate(capture))


def test_a_preview_in_colours_beside_raw_frames_is_passed_over(tmp_path):
    picture = Image.fromarray(np.zeros((24, 32, 3), np.uint8))
    picture.save(tmp_path / "preview.png")
    assert "colours or a palette" in "".join(plan_folder(tmp_path).problems)
    plan = plan_folder(night(tmp_path))
    assert not plan.problems and "preview.png: not read, developed pictures in colours" in notes(plan)


def test_an_exposure_series_of_an_even_light_may_be_one_of_flats(tmp_path):
    rng = np.random.default_rng(0)
    for kind, light in (("light", 1000), ("dark", 0)):
        for ms in (2, 4, 8):
            (tmp_path / kind / f"{ms}ms").mkdir(parents=True)
            for n in range(2):
                values = 100 + rng.poisson(light * ms / 8 + 20, (24, 32)).astype(np.uint16)
                np.save(tmp_path / kind / f"{ms}ms" / f"img{n}.npy", values[None])
    stated = {"cfa": "MONO", "white_level": 4095.0}
    said = text(plan_folder(tmp_path, stated))
    assert "taken as scenes: of an even light they are flats" in said
    flats = plan_folder(tmp_path, stated, assign=[("light*", "flat")])
    assert "taken as scenes" not in text(flats)
    assert {g.kind for g in flats.sets[0].groups} == {"flat", "dark"}


def test_a_stack_whose_last_axis_is_that_of_the_frames_is_doubted(tmp_path):
    rng = np.random.default_rng(0)
    for name, light in (("dark", 0), ("flat", 1000)):
        np.save(tmp_path / f"{name}.npy", 500 + rng.poisson(light + 20, (64, 80, 8)).astype(np.uint16))
    said = text(plan_folder(tmp_path, {"cfa": "MONO", "white_level": 4095.0}))
    assert "read as 64 frames of 80 x 8 pixels" in said
    for name in ("dark", "flat"):
        np.save(tmp_path / f"{name}.npy", np.moveaxis(np.load(tmp_path / f"{name}.npy"), -1, 0))
    assert "read as" not in text(plan_folder(tmp_path, {"cfa": "MONO", "white_level": 4095.0}))


def test_a_pattern_for_files_that_are_left_out_is_no_pattern_without_files(tmp_path):
    shot(night(tmp_path) / "bias_master.fits", "bias", IMAGETYP="Bias Frame")
    said = notes(plan_folder(tmp_path, assign=[("*master*", "bias")]))
    assert "--assign *master*=bias: no file of such a name is used; bias_master.fits as averages" in said


def test_frames_named_after_their_integration_time_are_frames(tmp_path):
    plan = plan_folder(night(tmp_path, names="{kind}_integration10ms_{n}.fits"))
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2}
    assert "average" not in notes(plan)


@pytest.mark.parametrize(("names", "pattern"), [("{kind}_{n}.fits", "bias_*"), ("{n}_{kind}.fits", "NAME*")])
def test_exposed_biases_are_named_with_the_flag_that_makes_them_darks(tmp_path, names, pattern):
    plan = plan_folder(night(tmp_path, names=names, EXPTIME=5.0))
    assert f"it is a dark: --assign '{pattern}=dark' says so" in notes(plan)
    if pattern != "NAME*":
        assert "it is a dark" not in notes(plan_folder(tmp_path, assign=[(pattern, "dark")]))


def test_what_the_caller_states_of_recordings_is_not_asked_for(tmp_path):
    for kind in ("dark", "flat"):
        with h5py.File(tmp_path / f"{kind}.h5", "w") as file:
            file["frames"] = np.random.default_rng(0).integers(100, 900, (3, 16, 16), dtype=np.uint16)
    stated = {"cfa": "MONO", "black_level": 100.0, "white_level": 4095.0}
    assign = [("dark*", "dark"), ("flat*", "flat")]
    assert "--cfa" in "".join(plan_folder(tmp_path, assign=assign).problems)
    plan = plan_folder(tmp_path, stated, assign=assign)
    assert not plan.problems
    made = dict(write_plan(plan, tmp_path / "out"))
    assert {r.kind for r in made.values()} == {"dark", "flat"}
