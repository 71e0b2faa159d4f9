"""Charge that comes out late is named with its direction, and hot pixels are counted without their tails."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.blind.chain import Camera, Context, Effect, Shot, expose
from cannoise_jax.blind.effects import effect
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, HOT = (96, 128), 0.006
CAMERA = Camera(1.0, 4.0, (300.0,) * 4, 16383.0, 1.0, "MONO", 100.0, 5, 1.0)
SHOTS = (("dark", 0.0, 0.02), ("dark", 0.0, 1.0), ("flat", 0.1, 0.02), ("flat", 0.4, 0.02))


def hot(amplitude: float) -> Effect:
    """Pixels of strong dark current."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        rng = c.frozen("hot")
        return x + c.shot.exposure_s * amplitude * (rng.random(c.size) < HOT) * rng.exponential(size=c.size)

    return Effect("hot_pixels", amplitude, "pixel", apply)


def recorded(*effects: Effect) -> CaptureSet:
    rng, out = np.random.default_rng(4), []
    for kind, level, seconds in SHOTS:
        shot = Shot(kind, kind, np.full(SIZE, level), 8, seconds)
        out.append(
            Recording(
                expose(CAMERA, shot, effects, rng), CAMERA.cfa, CAMERA.black, CAMERA.white, kind=kind,
                iso=100.0, exposure_s=seconds, path=f"{len(out)}_{kind}.h5",
            )
        )  # fmt: skip
    return CaptureSet("one with tails", tuple(out))


def found(*effects: Effect):
    looking = splits_of(recorded(hot(3000.0), *effects)).looking
    steps = stepwise(looking.fields, looking.signatures, frozenset(MECHANISMS), float(np.log(0.01))).steps
    return {s.named.mechanism: s.named.score for s in steps}


@pytest.fixture(scope="module")
def plain():
    return found()


@pytest.mark.parametrize("name", [pytest.param("parallel_cti", marks=pytest.mark.slow), "serial_cti"])
def test_it_is_named_and_no_tail_counts_as_hot(name, plain):
    scores = found(effect(name, 0.1))
    assert {"parallel_cti", "serial_cti"} & set(scores) == {name}
    assert scores[name].parameters["fraction"][0] == pytest.approx(0.1, abs=0.02)
    share, without = (s["hot_pixels"].parameters["fraction"][0] for s in (scores, plain))
    assert share == pytest.approx(without, rel=0.25)


def test_it_is_not_named_where_there_is_none(plain):
    assert "hot_pixels" in plain and not {"parallel_cti", "serial_cti"} & set(plain)


def test_coupling_to_all_sides_is_not_named_so():
    scores = found(effect("crosstalk", 0.1))
    assert "crosstalk" in scores and not {"parallel_cti", "serial_cti"} & set(scores)
