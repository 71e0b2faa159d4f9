"""Cameras that tell single electrons apart: their histograms are combs and their darks have tails of chance
by themselves, without any effect."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.signatures import known_shape, shape
from tests.discovery.capture import capture_set
from tests.discovery.looks import white

QUIET = {"gain": 6.0, "read": 0.28, "size": (96, 128)}
"""Gain, DN per electron, and read noise, electrons."""


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_electrons_one_by_one_are_no_missing_codes_and_no_tails(seed):
    assert diagnose(capture_set(seed, **QUIET), compare=False).findings == []


@pytest.mark.slow
def test_codes_that_are_skipped_are_found_where_electrons_run_together():
    def skip(rng):
        return lambda dn, signal, kind, exposure: np.rint(dn) - (np.rint(dn) % 8 == 3)

    assert diagnose(capture_set(3, skip, gain=3.5, read=1.1), compare=False).findings == ["missing_codes"]


def test_poisson_kurtosis_of_a_dark_is_known_as_well_as_its_level():
    """z of the kurtosis where the level of the dark, off by its own standard error, says how much of it is
    Poisson's."""
    rng = np.random.default_rng(4)
    gain, sigma, frames, size = 6.0, 1.7, 8, (64, 96)
    z = []
    for seed in range(60):
        fields = white(np.random.default_rng(seed), kinds=("dark",), frames=frames, size=size, sigma=sigma)
        off = rng.standard_normal() * sigma * np.sqrt(2 / (frames * np.prod(size)))
        dark = fields[0]._replace(signal=np.full(size, off, np.float32), gain=np.full(4, gain))
        low, high = (shape.kurtosis_score((dark,), tails=t).log_p for t in (1, -1))
        z.append(min(low, high))
    assert min(z) > np.log(1e-4)
    assert known_shape.kurtosis_doubt(dark) > 0.05


def test_light_tails_are_no_heavy_ones():
    rng = np.random.default_rng(5)
    fields = tuple(
        f._replace(
            contrasts=rng.uniform(-np.sqrt(3), np.sqrt(3), f.contrasts.shape).astype(np.float32),
            static=rng.uniform(-np.sqrt(3), np.sqrt(3), f.static.shape).astype(np.float32),
        )
        for f in white(rng, kinds=("dark", "dark"))
    )
    heavy, light = (shape.kurtosis_score(fields, tails=t) for t in (1, -1))
    assert heavy.log_p > -0.1 and heavy.amplitude == 0
    assert light.log_p < -50 and -1.2 < light.parameters["excess_kurtosis"][0] < -0.5
