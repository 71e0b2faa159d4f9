"""The kind of every file: by its header, its name, its folder and its values."""

import json

import numpy as np
import pytest

from cannoise_jax.recordings.folders.plan import check, plan_folder
from cannoise_jax.recordings.recording import BadInput
from tests.recordings.folders.night import labels, night, notes, shot


def test_flats_that_are_headed_light_and_lights_themselves(tmp_path):
    night(tmp_path)
    for n in (1, 2):
        shot(
            tmp_path / "flats" / f"x{n}.fits",
            "flat",
            IMAGETYP="Light Frame",
            EXPTIME=2.0,
            INSTRUME="Acme 100",
        )
        shot(
            tmp_path / "m31" / f"x{n}.fits",
            "light",
            IMAGETYP="Light Frame",
            EXPTIME=30.0,
            INSTRUME="Acme 100",
        )
    plan = plan_folder(tmp_path)
    assert labels(plan)["flat_2s"] == 4 and labels(plan, 1) == {"scene_30s": 2}
    assert plan.sets[1].folder == "lights" and "headed 'Light Frame', flat by name" in notes(plan)
    assert plan.sets[1].levels.values["black_level"] == plan.sets[0].levels.values["black_level"]


@pytest.mark.parametrize(
    "names",
    [
        "{kind}/{kind}_{n}.fits",
        "night1/{kind}frames/IMG_{n}.fits",
        "{kind}_60.0s_Bin1_gain100_-10.0C_000{n}.fit",
        "2024-01-01_{kind}-{n}.fts",
        "x{kind}z{n}.fits",
    ],
)
def test_kinds_from_names_alone(tmp_path, names):
    plan = plan_folder(night(tmp_path, names, IMAGETYP="", EXPTIME="n/a"))
    if "z" in names:
        assert "neither header nor name says the kind" in plan.problems[0]
        assigned = plan_folder(tmp_path, assign=[(f"*{k}*", k) for k in ("bias", "dark", "flat")])
        assert not assigned.problems
        return
    assert not plan.problems and {g.kind for g in plan.sets[0].groups} == {"bias", "dark", "flat"}
    if "gain100" in names:
        dark = next(g for g in plan.sets[0].groups if g.kind == "dark")
        assert (dark.settings["exposure_s"], dark.settings["temperature_c"]) == (60.0, -10.0)
        assert dark.mode[4] == 100


def test_words_of_several_languages(tmp_path):
    said = {
        "flat": ("Campo plano", "Flatfeld"),
        "dark": ("Dunkelbild", "Oscuro"),
        "bias": ("Sesgo", "Nullbild"),
    }
    for kind, words in said.items():
        for n, word in enumerate(words):
            keywords = {"EXPTIME": {"bias": 0.0, "dark": 60.0, "flat": 2.0}[kind], "INSTRUME": "Acme 100"}
            shot(tmp_path / f"img_{kind[0]}{n}.fits", kind, IMAGETYP=word, **keywords)
    shot(tmp_path / "Lumière" / "img.fits", "light", EXPTIME=9.0, INSTRUME="Acme 100")
    plan = plan_folder(tmp_path)
    assert labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2} and labels(plan, 1) == {"scene_9s": 1}


def test_words_that_are_unknown_in_several_ways_are_no_lights(tmp_path):
    night(tmp_path)
    shot(tmp_path / "img_1.fits", "light", IMAGETYP="Zorbl", EXPTIME=60.0, INSTRUME="Acme 100")
    assert not plan_folder(tmp_path).problems
    shot(tmp_path / "img_2.fits", "dark", IMAGETYP="Gnarf", EXPTIME=60.0, INSTRUME="Acme 100")
    said = "\n".join(plan_folder(tmp_path).problems)
    assert "img_1.fits: IMAGETYP 'Zorbl'" in said and "img_2.fits: IMAGETYP 'Gnarf'" in said


@pytest.mark.parametrize(
    "target, kind", [("Dark Shark", "light"), ("LDN 1235", "dark"), ("Dark", "dark"), ("dark frame", "dark")]
)
def test_the_name_of_what_was_looked_at_is_no_kind(tmp_path, target, kind):
    """Files of software that heads all it takes as lights are what their names say."""
    night(tmp_path)
    folder = tmp_path / ("Dark_Shark" if "Shark" in target else "dark_60s")
    for n in (1, 2):
        about = {"IMAGETYP": "LIGHT", "EXPTIME": 60.0, "INSTRUME": "Acme 100", "OBJECT": target}
        shot(folder / f"x_{n}.fits", "dark", seed=n, **about)
    groups = labels(plan_folder(tmp_path))
    assert groups.get("dark_60s") == (2 if kind == "light" else 4)


@pytest.mark.parametrize("other, said", [(1200.0, True), (1008.0, False)])
def test_biases_of_two_folders_that_lie_apart_are_no_one_recording(tmp_path, other, said):
    """Without a word in their headers of which camera they are."""
    for folder, level in (("first", 1000.0), ("second", other)):
        for n in range(3):
            shot(tmp_path / folder / f"bias_{n}.fits", "bias", electrons=(level - 1000) / 2)
    problems = " ".join(plan_folder(tmp_path).problems)
    assert ("of two cameras or settings, which no header tells apart" in problems) == said


def test_dark_flats_are_darks(tmp_path):
    night(tmp_path)
    shot(tmp_path / "DARKFLAT" / "1.fits", "dark", IMAGETYP="DARKFLAT", EXPTIME=2.0, INSTRUME="Acme 100")
    shot(tmp_path / "flat_dark_2.fits", "dark", EXPTIME=2.0, INSTRUME="Acme 100")
    assert labels(plan_folder(tmp_path))["dark_2s"] == 2


def test_darks_that_were_lit_and_biases_that_were_exposed_are_named(tmp_path):
    night(tmp_path)
    more = {"IMAGETYP": "Dark Frame", "INSTRUME": "Acme 100", "EXPTIME": 60.0}
    shot(tmp_path / "dark_9.fits", "flat", electrons=9000.0, **more)
    shot(tmp_path / "bias_9.fits", "bias", IMAGETYP="Bias Frame", INSTRUME="Acme 100", EXPTIME=300.0)
    problems = "\n".join(plan_folder(tmp_path).problems)
    assert "dark_9.fits: dark of" in problems and "lit?" in problems
    assert "no brighter" not in notes(plan_folder(tmp_path))  # than it alone
    assert "bias_9.fits: a bias of 300 s beside others" in problems
    stated = plan_folder(tmp_path, assign=[("dark_9*", "flat"), ("bias_9*", "bias")])
    assert not stated.problems


def test_folders_named_in_german(tmp_path):
    for name, kind, seconds in (
        ("Weißbilder", "flat", 2.0),
        ("Dunkelbilder", "dark", 60.0),
        ("Offset", "bias", 0.0),
    ):
        for n in (1, 2):
            shot(tmp_path / name / f"img_{n}.fits", kind, EXPTIME=seconds, INSTRUME="Acme 100")
    plan = plan_folder(tmp_path)
    assert not plan.problems and labels(plan) == {"flat_2s": 2, "dark_60s": 2, "bias": 2}


def test_a_refusal_names_what_was_taken_as_lights(tmp_path):
    for n in (1, 2):
        shot(tmp_path / "Dunkelbilder" / f"img_{n}.fits", "dark", EXPTIME=60.0, INSTRUME="Acme 100")
        shot(tmp_path / "Himmel" / f"img_{n}.fits", "flat", EXPTIME=2.0, INSTRUME="Acme 100")
    with pytest.raises(BadInput, match="Himmel/img_1.fits.*taken as lights") as refused:
        check(plan_folder(tmp_path))
    assert "\n" not in str(refused.value)


def test_biases_alone_are_told_all_that_is_missing_at_once(tmp_path):
    for n in (1, 2):
        shot(tmp_path / f"bias_{n}.fits", "bias", EXPTIME=0.0, INSTRUME="Acme 100")
    with pytest.raises(BadInput) as refused:
        check(plan_folder(tmp_path))
    for what in ("colour order", "white level", "no flats"):
        assert what in str(refused.value)


def test_kinds_that_a_side_car_states_against_the_name_are_said(tmp_path):
    for kind, other in (("dark", "flat"), ("flat", "dark")):
        np.save(
            tmp_path / f"{kind}.npy", np.random.default_rng(0).poisson(900, (3, 16, 16)).astype(np.uint16)
        )
        (tmp_path / f"{kind}.json").write_text(json.dumps({"kind": other, "cfa": "MONO"}))
    said = plan_folder(tmp_path).problems
    assert "dark.npy: its side-car says flat but named dark" in said[0]
    assert "None" not in "".join(said)
