"""Recordings of one exposure say nothing of what grows with it."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.mechanisms import signatures
from cannoise_jax.signatures.levels import dark_rise
from tests.discovery.looks import RECORDED, white


def names(seconds):
    return {s.name for s in signatures(RECORDED._replace(seconds=seconds))}


@pytest.mark.parametrize("seconds", [(), (0.1,), (0.1, 0.1, 0.1000001)])
def test_no_pattern_is_said_to_grow(seconds):
    assert not {n for n in names(seconds) if "thermal_static" in n or n == "dark_level"}
    assert {"pixel_additive_static", "column_additive_static"} <= names(seconds)


def test_of_two_exposures_it_may_be():
    more = names((0.1, 0.1, 0.2)) - names((0.1, 0.1, 0.1))
    maps = {f"{of}_thermal_static" for of in ("pixel", "row", "column")}
    assert more == maps | {"dark_level", "smooth_thermal", "modulated_thermal"}


def fields_of(*exposures: tuple[str, float]):
    drawn = white(np.random.default_rng(1), kinds=tuple(kind for kind, _ in exposures))
    return tuple(f._replace(exposure_s=s) for f, (_, s) in zip(drawn, exposures, strict=True))


@pytest.mark.parametrize("name", ["pixel_thermal_static", "row_thermal_static", "column_thermal_static"])
def test_light_alone_does_not_show_what_grows(name):
    """A flat of some seconds beside a bias: its pattern may as well be of the light."""
    look = next(s for s in signatures(RECORDED._replace(seconds=(0.0, 20.0))) if s.name == name)
    lit, dark = ("flat", 20.0), ("dark", 60.0)
    assert look.score(fields_of(("bias", 0.0), lit)) is None
    assert look.score(fields_of(("bias", 0.0), lit, dark)) is not None
    single = fields_of(("bias", 0.0), lit, dark)
    assert look.score((*single[:2], single[2]._replace(static=None))) is None


@pytest.mark.parametrize("number", range(1, 8))
def test_darks_of_one_exposure_have_no_slope(number):
    """Means of equal numbers differ from them by rounding."""
    fields = [f._replace(exposure_s=0.1) for f in white(np.random.default_rng(0), kinds=("dark",) * number)]
    for error in np.linspace(0.01, 0.1, 20):
        levels = [(f, np.full(4, 100.0 + n), error * (n + 1)) for n, f in enumerate(fields)]
        assert dark_rise(levels) == (0.0, np.inf)
