"""column_turns_additive and column_turns_relative: columns whose pattern turns its sign from row to row."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax import SensorModel, Settings
from cannoise_jax.signatures.fields import refit
from tests.discovery.drawn import SIZE, drawn
from tests.discovery.looks import SIGNATURES

TURNS = ((-1.0) ** np.arange(SIZE[0]))[:, None]
SCALINGS = {"additive": ("column_turns_additive", "column_additive_static"),
            "relative": ("column_turns_relative", "column_relative_static")}  # fmt: skip


def with_columns(fields, scaling: str, pattern):
    """The fields with a pattern [h, w] of offsets in DN, or of factors of the light."""

    def own(f):
        unit = (f.signal if f.lit else 0.0) if scaling == "relative" else 1.0
        return f._replace(
            static=(f.static + np.sqrt(f.frames) * pattern * unit * f.weight).astype(np.float32)
        )

    return tuple(own(f) for f in fields)


def columns(seed: int):
    return np.random.default_rng(seed).standard_normal((1, SIZE[1]))


@pytest.mark.parametrize("scaling", SCALINGS)
def test_columns_that_turn_are_found_beside_columns_and_taken_out(scaling):
    turning, plain = (SIGNATURES[name] for name in SCALINGS[scaling])
    size = {"additive": 1.0, "relative": 0.02}[scaling]
    pattern = size * (0.5 * columns(1) + TURNS * columns(2))
    fields = with_columns(drawn(6), scaling, pattern)
    score = turning.score(fields)
    assert score.log_p < -15
    assert score.amplitude == pytest.approx(size * columns(2).std(), abs=4 * score.error + 0.02 * size)
    assert (
        np.mean(turning.predict(fields, score).pattern * TURNS * columns(2)) > 0.7 * size * columns(2).var()
    )
    whole = plain.score(fields)
    assert whole.amplitude == pytest.approx(0.5 * size * columns(1).std(), abs=4 * whole.error + 0.05 * size)
    for first, second in ((turning, plain), (plain, turning)):  # in either order each takes its own
        left = refit(first.absorb(fields, first.score(fields)), fields)
        own = second.score(left)
        assert own.amplitude == pytest.approx(second.score(fields).amplitude, rel=0.15)
        assert first.score(left).log_p > np.log(1e-3)
        done = refit(second.absorb(left, own), left)
        assert min(first.score(done).log_p, second.score(done).log_p) > np.log(1e-3)


@pytest.mark.parametrize("scaling", SCALINGS)
def test_a_map_of_pixels_leaves_them(scaling):
    turning, _ = (SIGNATURES[name] for name in SCALINGS[scaling])
    pixels = SIGNATURES[{"additive": "pixel_additive_static", "relative": "pixel_relative_static"}[scaling]]
    size = {"additive": 1.0, "relative": 0.02}[scaling]
    own = np.random.default_rng(3).standard_normal(SIZE)
    fields = with_columns(drawn(6), scaling, size * (TURNS * columns(2) + 2 * own))
    left = refit(turning.absorb(fields, turning.score(fields)), fields)
    found = pixels.score(left)
    assert found.amplitude == pytest.approx(2 * size, rel=0.15)
    assert turning.score(refit(pixels.absorb(left, found), left)).log_p > np.log(1e-3)


@pytest.mark.parametrize("scaling", SCALINGS)
def test_plain_columns_and_pixels_do_not_turn(scaling):
    turning, _ = (SIGNATURES[name] for name in SCALINGS[scaling])
    size = {"additive": 2.0, "relative": 0.04}[scaling]
    for seed in range(8):
        own = np.random.default_rng(seed).standard_normal(SIZE)
        fields = with_columns(drawn(seed), scaling, size * (columns(seed) + own))
        assert turning.score(fields).log_p > np.log(1e-3)


def test_drawn_columns_turn_from_row_to_row_by_the_strength_that_is_stated():
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(
        "odd_even_column_fpn", sigma_dn=4.0
    )
    frames = np.asarray(
        camera.sample(jax.random.key(0), np.zeros((64, 400)), Settings(frames=16)), np.float64
    )
    even, odd = (frames[:, k::2].mean((0, 1)) - frames.mean() for k in (0, 1))
    assert even.std() == pytest.approx(4.0, rel=0.15)
    assert np.corrcoef(even, odd)[0, 1] < -0.95
