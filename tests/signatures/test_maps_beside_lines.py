"""Maps of pixels under lines that are stronger than they are: neither takes what is the other's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.signatures.fields import Fields
from tests.discovery.looks import SIGNATURES, white

SIZE = (96, 120)
LIGHT = 4000.0


def camera(seed: int, pixels: float, columns: float, share: float) -> tuple[Fields, ...]:
    """Two darks and two flats of white noise of one DN, with offsets of pixels and columns, DN, and gains of
    pixels."""
    rng = np.random.default_rng(seed)
    offset = pixels * rng.standard_normal(SIZE) + columns * rng.standard_normal((1, SIZE[1]))
    gain = share * rng.standard_normal(SIZE)
    out = []
    for f in white(rng, kinds=("dark", "dark", "flat", "flat"), size=SIZE, signal=LIGHT):
        change = offset + (gain * f.signal if f.lit else 0.0)
        moved = f.static + np.sqrt(f.frames) * f.weight * change
        out.append(f._replace(static=moved.astype(np.float32)))
    return tuple(out)


@pytest.mark.parametrize("columns", (0.0, 6.0))
def test_a_map_is_as_strong_as_it_is_under_lines(columns):
    score = SIGNATURES["pixel_additive_static"].score(camera(1, 1.5, columns, 0.0))
    assert score is not None
    assert score.payload == pytest.approx(1.5**2, rel=0.05)


def test_lines_alone_are_no_map_of_pixels():
    score = SIGNATURES["pixel_additive_static"].score(camera(2, 0.0, 6.0, 0.0))
    assert score is not None and score.log_p > np.log(1e-3)


def test_what_maps_and_lines_leave_is_noise_for_the_gains_of_columns():
    """p-values of gains of columns where there are none, once both maps and the columns are taken out."""
    p = []
    for seed in range(30):
        fields = camera(10 + seed, 0.8, 2.0, 0.001)
        for name in ("pixel_relative_static", "pixel_additive_static", "column_additive_static"):
            fields = SIGNATURES[name].absorb(fields, SIGNATURES[name].score(fields))
        p.append(np.exp(SIGNATURES["column_relative_static"].score(fields).log_p))
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    assert min(p) > 1e-4
