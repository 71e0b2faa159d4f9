"""Simulated moments recover what was put in; the composite score prefers the model that made the frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.likelihood_composite import composite_score, profile, ruler
from cannoise_jax.physics.mechanism import Parameter
from cannoise_jax.physics.moments import (
    fit_mechanism,
    fit_moments,
    from_line,
    level_weights,
    summary_statistics,
    to_line,
)
from cannoise_jax.physics.sensor import SensorModel, Settings

CLEAN = np.linspace(0, 0.3, 32 * 32).reshape(32, 32).astype(np.float32)
CAMERA = SensorModel.poisson_gaussian(2.0, 2.0, 64.0, 4095.0)


def test_parameters_go_to_the_line_and_back():
    for p in (
        Parameter("a", "1", 0.3, 0.0, 1.0, "logit"),
        Parameter("b", "DN", 5.0, 0.0, 1e3, "log"),
        Parameter("c", "1", -2.0, -10.0, 10.0),
    ):
        assert abs(float(from_line(to_line(p.default, p), p)) - p.default) < 1e-5 * abs(p.default)


def test_errors_of_a_known_law_are_the_textbook_ones():
    # log-variance of n normal numbers: standard error sqrt(2 / n), times sqrt(1 + 1 / simulations).
    count, parameter = 500, (Parameter("sigma2", "1", 1.0, 0.0, 100.0, "log"),)

    def simulate(key, x):
        drawn = jnp.exp(x[0] / 2) * jax.random.normal(key, (count,))
        return jnp.stack([jnp.log(jnp.mean(drawn**2)), jnp.mean(drawn)])

    pulls = []
    for seed in range(12):
        observed = np.asarray(simulate(jax.random.key(100 + seed), jnp.log(jnp.array([2.5]))), float)
        fit = fit_moments(simulate, observed, parameter, jax.random.key(seed), bootstrap=64)
        e = fit.estimates["sigma2"]
        assert fit.converged and 0.6 < e.stderr / e.value / np.sqrt(2 / count * 9 / 8) < 1.5
        pulls.append(np.log(e.value / 2.5) / (e.stderr / e.value))
    assert np.sqrt(np.mean(np.square(pulls))) < 1.8  # chi-square of 12: exceeded once in 10^4


@pytest.mark.parametrize(
    "id,parameters", [("excess_noise", {"excess": 0.45}), ("lens_shading", {"sigma": 0.15})]
)
def test_mechanisms_without_a_likelihood_are_recovered(id, parameters):
    truth = CAMERA.with_mechanism(id, **parameters).with_unit(jax.random.key(99))
    frames = truth.sample(jax.random.key(7), CLEAN, Settings(frames=8))
    fit = fit_mechanism(
        id, CAMERA, np.asarray(frames), CLEAN, jax.random.key(3), simulations=8, bootstrap=24, steps=5
    )
    for name, true in parameters.items():
        estimate = fit.estimates[name]
        assert abs(estimate.value - true) < 4 * estimate.stderr
        assert estimate.stderr < 0.3 * true
    assert fit.misfit < 3


def test_statistics_see_rows_but_not_which_rows():
    rng = np.random.default_rng(0)
    mean, sigma = np.full((16, 16), 100.0), np.full((16, 16), 4.0)
    weights = level_weights(mean)
    frames = 100 + 4 * rng.normal(size=(6, 16, 16))
    rows = 8 * rng.normal(size=(6, 16, 1))
    plain, striped, moved = (
        np.asarray(summary_statistics(jnp.asarray(f), mean, sigma, weights))
        for f in (frames, frames + rows, np.roll(frames + rows, 4, axis=1))
    )
    row_variance = 6 + 6 + 4 + 16 + 9  # after levels, spreads, sites, blocks and lags
    assert striped[row_variance] > plain[row_variance] + 2
    assert abs(moved[row_variance] - striped[row_variance]) < 1e-4


def test_composite_score_prefers_the_model_that_made_the_frames():
    rng = np.random.default_rng(1)
    mean = np.tile(np.linspace(100, 300, 48), (32, 1))
    sigma = np.sqrt(9 + (mean - 100) / 4)

    def draw(count, row=0.0, tail=0.0, missing=False):
        noise = rng.normal(size=(count, *mean.shape)) * np.where(
            rng.random((count, *mean.shape)) < tail, 3, 1
        )
        codes = np.round(mean + sigma * noise + row * rng.normal(size=(count, 32, 1)))
        return np.where(missing & (codes % 8 == 3), codes - 1, codes)

    by = ruler(mean, sigma)
    baseline = profile(draw(60), by)
    for part, more in (("means", {"row": 3.0}), ("marginal", {"tail": 0.05}), ("codes", {"missing": True})):
        observed = draw(20, **more)
        before = composite_score(baseline, observed, by)
        after = composite_score(profile(draw(60, **more), by), observed, by)
        error = np.std(after.per_frame - before.per_frame) / np.sqrt(20)
        assert after.total - before.total > 5 * error
        gains = {
            name: getattr(after, name) - getattr(before, name) for name in ("marginal", "codes", "means")
        }
        assert max(gains, key=gains.__getitem__) == part
    # Frames of the baseline itself score no better under a model with rows.
    observed = draw(20)
    wrong = composite_score(profile(draw(60, row=3.0), by), observed, by)
    assert composite_score(baseline, observed, by).total > wrong.total
