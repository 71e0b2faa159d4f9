"""Exposures that files state and nobody meant."""

import json

import numpy as np
import pytest

from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.store import recording_of
from cannoise_jax.recordings.load import load_recording
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.night import labels, night, notes, shot


def test_light_takes_time_so_flats_of_no_exposure_state_none(tmp_path):
    plan = plan_folder(night(tmp_path, EXPTIME=0.0))
    assert labels(plan) == {"flat": 2, "dark": 2, "bias": 2} and not plan.problems
    said = notes(plan)
    assert "flat_1.fits, flat_2.fits: an exposure of 0 s is stated, though light fell on it: not used" in said
    assert "dark_1.fits, dark_2.fits: an exposure of 0 s is stated of darks" in said
    assert "flat, dark: no exposure time in headers or names" in said
    recordings = {g.kind: recording_of(g, plan.sets[0], plan.overrides) for g in plan.sets[0].groups}
    assert recordings["flat"].exposure_s is None and recordings["bias"].exposure_s == 0


def test_no_exposure_is_stated_of_lit_frames(tmp_path):
    folder = night(tmp_path)
    plan = plan_folder(folder, {"exposure_s": 0.0})
    assert "flat_1.fits, flat_2.fits: --exposure 0, though light fell on it" in plan.problems[0]
    assert "--exposure" not in "".join(plan_folder(folder, {"exposure_s": 0.0}, leave_out=["f*"]).problems)
    levels = {"cfa": "MONO", "black_level": 1000, "white_level": 65535}
    with pytest.raises(BadInput, match="flat_1.fits: --exposure 0 of a flat: light needs time"):
        load_recording(folder / "flat_1.fits", exposure_s=0.0, **levels)
    assert load_recording(folder / "bias_1.fits", exposure_s=0.0, **levels).exposure_s == 0


def test_biases_and_darks_of_no_exposure_beside_timed_flats_stay(tmp_path):
    night(tmp_path)
    for n in (3, 4):
        shot(tmp_path / f"dark_{n}.fits", "dark", IMAGETYP="Dark", EXPTIME=0.0, INSTRUME="Acme 100")
    plan = plan_folder(tmp_path)
    assert labels(plan) == {"flat_2s": 2, "dark_0s": 2, "dark_60s": 2, "bias": 2}
    assert "0 s is stated" not in notes(plan)


def test_names_say_what_a_header_of_no_exposure_does_not(tmp_path):
    plan = plan_folder(night(tmp_path, "{kind}_30s_{n}.fits", EXPTIME=0.0))
    assert labels(plan) == {"flat_30s": 2, "dark_30s": 2, "bias": 2}


def test_the_caller_may_state_what_files_do_not(tmp_path):
    plan = plan_folder(night(tmp_path, EXPTIME=0.0), {"exposure_s": 5.0})
    assert "flat_5s" in labels(plan) and "0 s is stated" not in notes(plan)


def test_names_and_headers_that_disagree_are_said_and_the_header_is_used(tmp_path):
    night(tmp_path)
    for n in (1, 2):
        for name, seconds in (("dark_30s", 30000.0), ("dark_2min", 125.0), ("dark_20s", 10.0)):
            keywords = {"IMAGETYP": "Dark", "EXPTIME": seconds, "INSTRUME": "Acme 100"}
            shot(tmp_path / f"{name}_{n}.fits", "dark", seed=int(seconds) + n, **keywords)
    plan = plan_folder(tmp_path)
    said = [note for note in plan.notes if "by name, but" in note]
    assert len(said) == 2 and not plan.problems and "dark_3e+04s" in labels(plan)
    assert "dark_30s_1.fits, dark_30s_2.fits: 30 s by name, but 30000 s" in notes(plan)
    assert "perhaps in ms" in next(note for note in said if "30000" in note)
    assert "20 s by name, but 10 s by header or side-car: the latter" in notes(plan)


def test_side_cars_count_as_headers(tmp_path):
    for kind, level in (("bias", 100), ("flat_2s", 2000)):
        values = np.random.default_rng(level).normal(level, 9, (3, 16, 24)).astype(np.uint16)
        np.save(tmp_path / f"{kind}.npy", values)
    (tmp_path / "flat_2s.json").write_text(json.dumps({"exposure_s": 4}))
    plan = plan_folder(tmp_path, {"cfa": "MONO"})
    assert "flat_2s.npy: 2 s by name, but 4 s" in notes(plan) and "flat_4s" in labels(plan)


@pytest.mark.parametrize("seconds", [1e7, 1e-12])
def test_exposures_of_no_camera_are_refused(tmp_path, seconds):
    night(tmp_path)
    shot(tmp_path / "dark_x.fits", "dark", IMAGETYP="Dark", EXPTIME=seconds, INSTRUME="Acme 100")
    (problem,) = plan_folder(tmp_path).problems
    assert problem.startswith(f"dark_x.fits: exposure_s is {seconds:g}: expected ")
    assert not plan_folder(tmp_path, {"exposure_s": 1.0}).problems


def test_other_settings_than_names_say_are_said(tmp_path):
    """The header's holds: names are given by hand."""
    for n in (1, 2):
        for kind in ("flat", "dark"):
            path = tmp_path / f"{kind}_{n}_iso100_-20C.fits"
            shot(
                path,
                kind,
                IMAGETYP=kind,
                EXPTIME=1.0,
                INSTRUME="Acme 100",
                ISOSPEED=800,
                **{"CCD-TEMP": -5.0},
            )
    plan = plan_folder(tmp_path)
    assert "and 1 more: ISO 100 by name, but ISO 800 by header or side-car: the latter is used" in notes(plan)
    assert ": -20 C by name, but -5 C by header" in notes(plan)
    assert {g.settings["iso"] for g in plan.sets[0].groups} == {800}


def test_settings_that_names_round_are_not_said(tmp_path):
    for n in (1, 2):
        path = tmp_path / f"dark_{n}_-20C.fits"
        shot(path, "dark", IMAGETYP="dark", EXPTIME=1.0, INSTRUME="Acme 100", **{"CCD-TEMP": -19.4})
    assert "by name" not in notes(plan_folder(tmp_path))


def test_gains_in_decibels_of_names_part_recordings(tmp_path):
    for decibels in (6, 12):
        for n in (1, 2):
            for kind in ("flat", "dark"):
                path = tmp_path / f"{kind}_gain{decibels}dB_{n}.fits"
                shot(path, kind, IMAGETYP=kind, EXPTIME=1.0, INSTRUME="Acme 100")
    plan = plan_folder(tmp_path)
    assert sorted({g.settings["gain_db"] for s in plan.sets for g in s.groups}) == [6.0, 12.0]
