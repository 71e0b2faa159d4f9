"""Colour orders and exposures that the levels of recordings contradict are said, true ones are not."""

from __future__ import annotations

import dataclasses
import re

import numpy as np
import pytest

from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Recording

SIZE, GAIN, BLACK = (64, 80), 0.8, 200.0
RESPONSE = {"R": 0.5, "G": 1.0, "B": 0.7}
RATE = 2 + np.where(np.random.default_rng(1).random(SIZE) < 0.02, 300.0, 0.0)
"""Dark charge of every pixel, electrons a second."""


def recorded(kind, stated, seconds=None, lamp=0.0, cfa="RGGB", true=None, count=6, celsius=None):
    """Frames of an exposure of `seconds`, of which `stated` is said. lamp: electrons a second."""
    seconds = stated if seconds is None else seconds
    rng = np.random.default_rng([round(1000 * stated), round(lamp), kind == "dark"])
    colours = np.reshape([RESPONSE.get(c, 1.0) for c in (true or cfa).replace("MONO", "GGGG")], (2, 2))
    light = lamp * np.tile(colours, (SIZE[0] // 2, SIZE[1] // 2))
    charge = rng.poisson((light + RATE) * seconds, (count, *SIZE)) + 3 * rng.standard_normal((count, *SIZE))
    frames = np.rint(BLACK + GAIN * charge).clip(0, 16383).astype(np.uint16)
    return frame_statistics(
        Recording(
            frames,
            cfa,
            (BLACK,) * 4,
            16383.0,
            "c",
            kind,
            exposure_s=stated,
            temperature_c=celsius,
            path=f"{kind}_{stated:g}s.h5",
        )  # fmt: skip
    )


def series(**changes):
    darks = [recorded("dark", s, changes.get("took", {}).get(s)) for s in (0.001, 1.0, 2.0, 10.0)]
    flats = [recorded("flat", s, lamp=lamp) for s, lamp in changes.get("flats", ((1.0, 3000), (2.0, 3000)))]
    return [*darks, *flats]


@pytest.mark.parametrize("true", ["RGGB", "GBRG", "MONO"])
def test_a_mosaic_that_is_said_to_be_mono_is_said(true):
    dark, flat = recorded("dark", 0.1, cfa="MONO"), recorded("flat", 1.0, lamp=400, cfa="MONO", true=true)
    said = faults([dark, flat]).colours
    assert said.startswith("flat_1s.h5: MONO is stated, and the flats show a mosaic") == (true != "MONO")
    assert said or true == "MONO"


def test_nothing_is_said_of_what_agrees():
    found = faults(series())
    assert (found.colours, found.lights, found.charge) == ("", "", "")


@pytest.mark.parametrize("light", [30, 4000])
@pytest.mark.parametrize(("stated", "true"), [("RGGB", "GRBG"), ("GBRG", "BGGR"), ("RGGB", "BGGR")])
def test_greens_that_are_none_are_said(stated, true, light):
    dark = recorded("dark", 0.1, cfa=stated)
    found = faults([dark, recorded("flat", 1.0, lamp=light, cfa=stated, true=true)])
    wrong = (stated in ("RGGB", "BGGR")) != (true in ("RGGB", "BGGR"))  # else red and blue are exchanged
    assert bool(found.colours) == wrong
    if wrong:
        assert found.colours.startswith(f"flat_1s.h5: the two greens of {stated} differ by ")
        assert "--cfa" in found.colours and "\n" not in found.colours


@pytest.mark.parametrize("shifted", ["dark", "flat"])
def test_codes_of_two_scales_are_said(shifted):
    both = [recorded("dark", 0.1), recorded("flat", 1.0, lamp=1000)]
    assert faults(both).codes == ""
    moved = [
        frame_statistics(dataclasses.replace(s.recording, frames=np.asarray(s.recording.frames[:]) * 4))
        if s.recording.kind == shifted
        else s
        for s in both
    ]
    said = faults(moved).codes
    assert said.startswith(f"codes of {shifted}") and "lie 4 DN apart" in said and "\n" not in said


def test_flats_of_one_level_contradict_exposures_that_are_apart():
    line = faults(series(flats=((1.0, 3000), (2.0, 1500)))).lights
    assert line.startswith("flat_1s.h5 (1 s) and flat_2s.h5 (2 s) are of one level") and "\n" not in line
    assert faults(series(flats=((1.0, 3000), (1.1, 2727)))).lights == ""  # exposures that are near
    assert faults(series(flats=((1.0, 3000), (2.0, 1600)))).lights == ""


@pytest.mark.parametrize(("took", "share"), [(2.0, 1.0), (0.5, 0.5)])
def test_hot_pixels_contradict_exposures_of_darks(took, share):
    line = faults(series(took={10.0: took})).charge
    found = re.search(r" and dark_10s.h5 \(10 s\): in the longer hot pixels hold (\S+) times", line)
    assert found and float(found[1]) == pytest.approx(share, rel=0.05) and "\n" not in line


def test_a_longer_dark_that_was_colder_contradicts_nothing():
    asked = ((0.001, None, 20), (1.0, None, 20), (4.0, 1.0, 5))
    assert faults([recorded("dark", s, t, celsius=c) for s, t, c in asked]).charge == ""


def test_darks_without_hot_pixels_say_nothing(monkeypatch):
    monkeypatch.setattr(f"{__name__}.RATE", np.zeros(SIZE))
    assert faults(series(took={10.0: 2.0})).charge == ""


@pytest.mark.parametrize("swapped", [False, True])
def test_a_dark_that_is_brighter_than_a_flat_exposed_for_as_long_is_said(swapped):
    lit, unlit = ("dark", "flat") if swapped else ("flat", "dark")
    said = faults([recorded(lit, 1.0, lamp=1500.0), recorded(unlit, 1.0), recorded("dark", 4.0)]).lights
    assert bool(re.match(r"dark_1s.h5 is a dark and \d+ DN brighter than flat_1s.h5", said)) == swapped


def creeping(drift, kind="bias", count=8, scatter=0.0, seed=0):
    """A dark whose level moves by `drift` DN a frame, and scatters."""
    rng = np.random.default_rng(seed)
    level = BLACK + drift * np.arange(count) + scatter * rng.standard_normal(count)
    frames = np.rint(level[:, None, None] + 3 * rng.standard_normal((count, *SIZE))).astype(np.uint16)
    return frame_statistics(Recording(frames, "RGGB", (BLACK,) * 4, 16383.0, "c", kind, path=f"{kind}.h5"))


@pytest.mark.parametrize("drift", (3.0, -3.0))
def test_a_black_level_that_creeps_is_said_with_how_far(drift):
    said = faults([creeping(drift), *series()[4:]]).levels
    assert said.startswith("bias.h5: its level moves by")
    assert float(re.search(r"moves by ([+-][\d.]+) DN", said)[1]) == pytest.approx(7 * drift, rel=0.03)


def test_levels_that_scatter_or_hardly_move_do_not_creep():
    assert faults([creeping(0.02), *series()[4:]]).levels == ""
    for seed in range(6):
        assert faults([creeping(0.0, scatter=10.0, seed=seed), *series()[4:]]).levels == "", seed
