"""Corrected pixels hold the mean of the neighbours that the map names, with colours and without."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.defects import MEANS

SIZE = (64, 96)


def drawn(kernel, share=0.02):
    """Darks of a camera that puts these neighbours in the place of some pixels, and which."""
    sites = np.random.default_rng(3).random(SIZE) < share
    names = list(MEANS)
    maps = {"sites": (sites * (1 + names.index(kernel)))[None].astype(np.float32)}
    model = SensorModel.from_nlf(1e-4, 1e-4, 64, 4095).with_mechanism("defect_correction", maps=maps)
    frames = model.sample(jax.random.key(0), np.full(SIZE, 0.3, np.float32), Settings(100, 0.01, None, 8))
    return np.asarray(frames, np.float64), sites


@pytest.mark.parametrize("kernel", ["four", "row", "next_row", "next_column", "next_eight"])
def test_the_neighbours_that_are_named_are_put_in_place(kernel):
    frames, sites = drawn(kernel)
    inner = np.zeros_like(sites)
    inner[2:-2, 2:-2] = sites[2:-2, 2:-2]
    around = np.mean([np.roll(frames, (-y, -x), (1, 2)) for y, x in MEANS[kernel]], 0)
    off = (frames - around)[:, inner]
    assert np.median(np.abs(off)) <= 1 < np.median(np.abs(frames - frames.mean(0)))  # rounded; few meet


def test_a_model_that_knows_no_kernel_takes_the_four_of_a_colour():
    model = SensorModel.from_nlf(1e-4, 1e-4, 64, 4095).with_mechanism("defect_correction", fraction=0.02)
    model = model.with_maps(SIZE)
    (fitted,) = (f for f in model.mechanisms if f.mechanism == "defect_correction")
    assert set(np.unique(fitted.maps["sites"])) == {0.0, 1.0}


def test_what_a_diagnosis_finds_names_the_neighbours():
    frames, _ = drawn("next_row")
    recording = Recording(np.rint(frames).astype(np.uint16), "MONO", (64.0,) * 4, 4095.0, kind="flat")
    looking = splits_of(CaptureSet("made", (recording,))).looking
    (signature,) = (s for s in looking.signatures if s.name == "corrected")
    score = signature.score(looking.fields)
    found = signature.pattern(looking.fields, score, np.random.default_rng(0))
    assert score.payload == "next_row"
    assert set(np.unique(found)) == {0.0, 1.0 + list(MEANS).index("next_row")}
