"""Dark current that a black clamp hides from the level of the darks: told from their noise alone."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.dark_noise import excess_score

SIZE = (64, 96)
GAIN, READ, BLACK = 2.0, 3.0, 400.0
EXPOSURES = (0.01, 2.0, 10.0, 30.0)
_RNG = np.random.default_rng


def darks(seed, rate, clamp, warm=0.0, drift=0.0, exposures=EXPOSURES, hidden=0.0):
    """Darks and a flat of a camera in plain NumPy. rate: e-/s of every pixel; clamp: share of its mean that
    is taken away; warm: mean of a part that differs from pixel to pixel, exponentially; drift: relative
    change of the read noise per recording; hidden: e-/s besides, all of whose mean is taken away."""
    rng = _RNG(seed)
    heat = hidden + rate + warm * rng.exponential(size=SIZE)
    shots = [("dark", t, 0.0) for t in exposures] + [("flat", 0.01, 3000.0)]
    out = []
    for kind, seconds, light in shots:
        read = READ * (1 + drift * rng.standard_normal())
        charge = (
            rng.poisson(heat * seconds + light, (8, *SIZE)) - (clamp * np.median(heat) + hidden) * seconds
        )
        values = BLACK + GAIN * (charge + read * rng.standard_normal((8, *SIZE)))
        codes = np.clip(np.round(values), 0, 16383).astype(np.uint16)
        out.append(Recording(codes, "RGGB", (BLACK,) * 4, 16383.0, kind=kind, exposure_s=seconds))
    return CaptureSet("camera", tuple(out))


def score(*args, **more):
    capture = darks(*args, **more)
    return excess_score(prepare(capture, all_frames(split_recordings(capture)), False).fields)


@pytest.mark.parametrize(
    "rate, clamp, hidden",
    [
        pytest.param(1.0, 1.0, 1.0, marks=pytest.mark.slow),
        pytest.param(0.3, 1.0, 0.3, marks=pytest.mark.slow),
        (4.0, 0.5, 2.0),
        (1.0, 1.3, 1.0),
    ],
)
def test_the_hidden_rate_comes_back(rate, clamp, hidden):
    found = [score(seed, rate, clamp) for seed in range(4)]
    assert all(f.log_p < -8 for f in found)
    assert np.mean([f.amplitude for f in found]) == pytest.approx(hidden, rel=0.06)
    taken = np.mean([f.parameters["share"][0] for f in found])
    assert taken == pytest.approx(max(clamp, 1.0), abs=0.03)  # less is a dark current beside it


@pytest.mark.parametrize(
    "rate, warm, drift, exposures",
    [
        (0.0, 0.0, 0.0, EXPOSURES),
        pytest.param(5.0, 0.0, 0.0, EXPOSURES, marks=pytest.mark.slow),
        pytest.param(0.5, 3.0, 0.0, EXPOSURES, marks=pytest.mark.slow),
        pytest.param(0.0, 0.0, 0.003, EXPOSURES, marks=pytest.mark.slow),
        pytest.param(0.0, 0.0, 0.003, (0.01, 10.0), marks=pytest.mark.slow),
    ],
)
def test_a_camera_that_hides_nothing_is_not_called_one(rate, warm, drift, exposures):
    """No dark current, much of it, a broad distribution over pixels, electronics a few kelvin warmer."""
    p = [np.exp(score(seed, rate, 0.0, warm, drift, exposures).log_p) for seed in range(20)]
    assert min(p) > 1e-3 and np.mean(np.array(p) < 0.05) <= 0.2


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_the_noise_of_a_glow_that_was_found_is_that_of_its_charge(seed):
    """Its level is taken out of the darks, its shot noise is in them."""
    fall = np.exp(-np.hypot(*np.indices(SIZE)) / 25)

    def found(hidden):
        capture = darks(seed, 0.7 + 1.5 * fall, 0.0, hidden=hidden)
        prepared = prepare(capture, all_frames(split_recordings(capture)), False)
        (glow,) = (s for s in prepared.signatures if s.name == "glow")
        return excess_score(glow.absorb(prepared.fields, glow.score(prepared.fields)))

    assert found(0.0).log_p > np.log(1e-3)
    beside = found(0.5)
    assert beside.log_p < -8 and beside.amplitude == pytest.approx(0.5, abs=0.15)


def test_a_glow_that_no_fall_has_the_form_of_hides_no_charge():
    """So steep that its darks' own levels are those of the pixels far from it: what the rest of the frame has
    above them is charge too, and so is the foot that reaches all of it."""
    y, x = np.indices(SIZE)
    fall = (1 + (np.hypot(y - 1.03 * SIZE[0], x - 0.2 * SIZE[1]) / 16) ** 2) ** -1.5

    def left(seed, hidden):
        capture = darks(seed, 40.0 * fall, 0.0, hidden=hidden)
        prepared = prepare(capture, all_frames(split_recordings(capture)), False)
        (glow,) = (s for s in prepared.signatures if s.name == "glow")
        return glow.absorb(prepared.fields, glow.score(prepared.fields))

    fields = left(0, 0.0)
    found = excess_score(fields)
    assert abs(found.parameters["e_per_s"][0]) < 3 * found.error and found.error < 0.1
    for f in (f for f in fields if f.kind == "dark"):
        level = f.mean + f.charged + f.static * f.sigma / np.sqrt(f.frames)
        charge = GAIN * 40.0 * fall.mean() * f.exposure_s
        assert np.mean(level[f.usable]) - BLACK == pytest.approx(charge, rel=0.01, abs=0.1)
    beside = excess_score(left(0, 3.0))
    assert beside.log_p < -8 and beside.amplitude == pytest.approx(3.0, abs=0.5)
