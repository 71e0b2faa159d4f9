"""Colours are told from light that changes along the frame, and a wrong colour order is said."""

import re

import numpy as np
import pytest

from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.sites import other_colours, site_levels, two_gains

from .night import notes, shot


def slope(most, size=(24, 32)):
    return np.linspace(500, 500 * most, size[1])[None, :] * np.ones((size[0], 1))


def folder_of(path, electrons, **keywords):
    for n in range(2):
        shot(path / f"flat{n}.fits", "flat", electrons=electrons, EXPTIME=1.0, **keywords)
        shot(path / f"dark{n}.fits", "dark", EXPTIME=1.0, **keywords)
    return plan_folder(path)


def test_flats_with_a_slope_are_no_mosaic(tmp_path):
    plan = folder_of(tmp_path, slope(6.5))
    assert not plan.problems and "MONO: no header states colours" in notes(plan)


@pytest.mark.parametrize("size", [(24, 32), (25, 33), (24, 33), (3, 3)])
def test_sites_are_compared_at_the_same_places(size):
    even = np.add.outer(100.0 * np.arange(size[0]), 7.0 * np.arange(size[1]))
    assert np.ptp(site_levels(even).levels) == 0
    even[0::2, 1::2] += 30
    levels = site_levels(even).levels
    assert np.allclose(np.subtract(levels, levels[0]), [0, 30, 0, 0])
    assert site_levels(np.array([[4, 8]], np.uint16)).levels == (4, 8, 4, 4)


def test_dim_flats_of_one_colour_are_no_mosaic(tmp_path):
    for seed in range(4):
        rng = np.random.default_rng(seed)
        folder = tmp_path / str(seed)
        folder.mkdir()
        for n in range(2):
            frames = {"flat": 50 + 0.5 * rng.poisson(20, (96, 128)), "dark": np.full((96, 128), 50.0)}
            for kind, clean in frames.items():
                noisy = np.round(clean + rng.normal(0, 1.5, clean.shape)).astype(np.uint16)
                np.save(folder / f"{kind}_10ms_{n}.npy", noisy)
        assert not plan_folder(folder).problems


def test_a_weak_mosaic_under_a_slope_is_still_one(tmp_path):
    weak = slope(1.5, (96, 96))
    weak[0::2, 1::2] *= 1.04
    weak[1::2, 0::2] *= 1.04
    for n in range(2):
        shot(tmp_path / f"flat{n}.fits", "flat", electrons=40 * weak, size=weak.shape, EXPTIME=1.0)
    assert any("show a mosaic" in problem for problem in plan_folder(tmp_path).problems)


def test_an_order_whose_greens_are_red_and_blue_is_said(tmp_path):
    colours = np.full((24, 32), 3000.0)
    colours[0::2, 0::2], colours[1::2, 1::2] = 1200, 2000
    for cfa, said in (("GBRG", True), ("RGGB", False)):
        plan = folder_of(tmp_path / cfa, colours, BAYERPAT=cfa)
        assert ("the two greens of GBRG differ by" in notes(plan)) == said and not plan.problems
    assert "differ by" in notes(plan_folder(tmp_path / "RGGB", {"cfa": "GRBG"}))
    assert other_colours(np.array([1200.0, 3000, 2000, 900]), "GBRG") is None  # no order has equal greens
    # Red and blue of one grey wall may be near each other; greens never are so far apart beside equal ones.
    assert other_colours(np.array([3000.0, 1800, 1500, 3001]), "RGGB")
    assert other_colours(np.array([3000.0, 3240, 3000, 3090]), "RGGB") is None


@pytest.mark.parametrize("lines", ["columns", "rows"])
def test_lines_with_gains_of_their_own_are_no_mosaic(tmp_path, lines):
    light = np.full((24, 32), 3000.0)
    light[(slice(None), slice(None, None, 2)) if lines == "columns" else slice(None, None, 2)] *= 1.2
    plan = folder_of(tmp_path, light)
    assert not plan.problems and plan.sets[0].levels.values["cfa"] == "MONO"
    assert re.search(
        rf"odd and even {lines} of the flats differ by 1[6-9] %, which no mosaic does", notes(plan)
    )


@pytest.mark.parametrize(
    ("light", "said"),
    [
        ([1000.0, 1200, 1010, 1190], "odd and even columns of the flats differ by 18 %"),
        ([1000.0, 990, 1200, 1210], "odd and even rows"),
        ([1000.0, 1020, 1000, 1020], None),  # by some per cent, as columns do
        ([1200.0, 3000, 2990, 900], None),  # colours
        ([0.0, 0, 0, 0], None),
    ],
)
def test_two_gains_of_a_sensor_without_colours_are_said(light, said):
    found = two_gains(np.array(light), "MONO")
    assert found is None if said is None else found.startswith(said)
    assert two_gains(np.array(light), "RGGB") is None


@pytest.mark.parametrize(
    ("light", "coloured"),
    [
        ([1200.0, 3000, 2990, 900], True),
        ([3000.0, 1200, 2400, 2950], True),
        ([1000.0, 1030, 1030, 1010], False),  # a pattern of the camera's own
        ([1000.0, 1100, 1000, 1100], False),  # columns with gains of their own
        ([1000.0, 1000, 1200, 1200], False),
        ([1000.0, 1100, 1210, 1320], False),
        ([0.0, 0, 0, 0], False),
    ],
)
def test_a_mosaic_that_is_said_to_be_without_colours_is_told(light, coloured):
    said = other_colours(np.array(light), "MONO")
    assert ("the flats show a mosaic" in said) if coloured else said is None
