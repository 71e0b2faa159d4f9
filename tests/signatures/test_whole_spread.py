"""A map of pixels says how wide it is with those far out of it, and with nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures.patterns import pixel_score
from cannoise_jax.signatures.whole_spread import spread_of_all
from tests.discovery.looks import white

SIZE = (96, 128)


def fields_of(offsets):
    """Darks in white noise of 1 DN with these offsets, DN."""
    fields = white(np.random.default_rng(0), kinds=("dark",) * 2, size=SIZE)
    return tuple(f._replace(static=f.static + np.sqrt(f.frames) * f.weight * offsets) for f in fields)


def told(offsets):
    fields = fields_of(offsets)
    return spread_of_all(fields, "additive", pixel_score(fields, scaling="additive").amplitude)


def test_pixels_far_out_are_in_it_and_lines_are_not():
    rng = np.random.default_rng(1)
    even = 2 * rng.standard_normal(SIZE)
    far = (rng.random(SIZE) < 0.01) * rng.exponential(80.0, SIZE)
    value, error = told(even + far)
    assert value == pytest.approx(np.std(even + far), abs=4 * error)
    assert told(even) is None and told(even + 2 * rng.standard_normal(SIZE[1])) is None
