"""The weakest member decides how a model is scored; one scorer ranks a model before and after a change."""

from __future__ import annotations

import importlib

import jax
import numpy as np
import pytest

from cannoise_jax.physics.likelihood_choice import SCORERS, composite_of, likelihood_of
from cannoise_jax.physics.likelihood_composite import ruler
from cannoise_jax.physics.sensor import SensorModel, Settings


def test_the_weakest_member_decides():
    assert likelihood_of([]) == likelihood_of(["prnu", "gain_error"]) == "exact"
    for id in ("heavy_tails", "poisson_skew", "row_noise", "nonlinearity"):
        assert likelihood_of(["prnu", id]) == "approximate"
    assert likelihood_of(["row_noise", "missing_codes"]) == "none"
    with pytest.raises(ValueError, match="gremlins"):
        likelihood_of(["gremlins"])


def test_scorers_exist():
    for names in SCORERS.values():
        for name in names:
            module, function = name.split(".")
            assert callable(getattr(importlib.import_module(f"cannoise_jax.physics.{module}"), function))


def test_one_scorer_prefers_the_model_with_the_missing_codes_of_the_data():
    before = SensorModel.poisson_gaussian(1.0, 5.0, 200, 4095)
    after = before.with_mechanism("missing_codes", period=8.0)
    assert likelihood_of(f.mechanism for f in after.mechanisms) == "none"
    clean = np.full((32, 48), 0.1, np.float32)
    data, first, second = jax.random.split(jax.random.key(0), 3)
    frames = np.asarray(after.sample(data, clean, Settings(frames=8)))
    signal = 0.1 * (4095 - 200)
    by = ruler(np.full(clean.shape, 200 + signal), np.full(clean.shape, np.sqrt(signal + 25)))
    settings = Settings(frames=16)
    plain = composite_of(before, first, clean, settings, frames, by)
    comb = composite_of(after, second, clean, settings, frames, by)
    # One code in eight is moved onto its neighbour, which the flat histogram pays for with log(8/7) and more.
    assert comb.total - plain.total > 0.1
    assert comb.codes > plain.codes
