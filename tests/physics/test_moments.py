"""Simulated moments recover what was put in; the composite score prefers the model that made the frames."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.mechanism import Parameter
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.likelihood.composite import composite_score, profile, ruler
from cannoise_jax.physics.likelihood.moments import (
    fit_mechanism,
    fit_moments,
    from_line,
    level_weights,
    summary_statistics,
    to_line,
)

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


LOW = SensorModel.poisson_gaussian(20.0, 0.5, 64.0, 4095.0)  # single electrons are seen
FULL = SensorModel.poisson_gaussian(0.2, 2.0, 64.0, 4095.0)  # wells of 20000 e-
_Y, _X = np.mgrid[:64, :64]
TEXTURE = (0.15 + 0.1 * np.sin(_Y / 5) * np.cos(_X / 7) + 0.05 * np.sin((_X + 2 * _Y) / 11)).astype(
    np.float32
)
RAMP = np.linspace(0, 0.3, 64 * 64).reshape(64, 64).astype(np.float32)
DARK = np.zeros((64, 64), np.float32)
FLAT = np.full((64, 64), 0.5, np.float32)
EIGHT = Settings(frames=8)
OTHERS = {
    "excess_noise": (CAMERA, CLEAN, EIGHT, {"excess": 0.45}),
    "lens_shading": (CAMERA, CLEAN, EIGHT, {"sigma": 0.15}),
    "poisson_skew": (LOW, DARK + 0.01, EIGHT, {"strength": 0.7}),
    "clock_induced_charge": (LOW, DARK, EIGHT, {"charge_e": 0.05}),
    "dual_gain": (CAMERA, RAMP, Settings(iso=1600.0, frames=8), {"gain_ratio": 1.5, "read_ratio": 0.6}),
    "brighter_fatter": (FULL, FLAT, EIGHT, {"a00": 5e-6}),
    "dead_pixels": (CAMERA, FLAT, EIGHT, {"fraction": 0.005}),
    "cosmic_rays": (CAMERA, DARK, Settings(exposure_s=1.0, frames=8), {"rate": 2000.0, "charge_e": 300.0}),
    "image_lag": (CAMERA, TEXTURE, EIGHT, {"fraction": 0.03}),
    "smear": (CAMERA, TEXTURE, EIGHT, {"fraction": 0.01}),
    "lossy_compression": (CAMERA, RAMP, EIGHT, {"step_dn": 16.0, "exponent": 0.5}),
    "defect_correction": (CAMERA, TEXTURE, EIGHT, {"fraction": 0.05}),
    "hot_pixel_suppression": (CAMERA, RAMP, EIGHT, {"weight": 0.6}),
    "demosaicing": (CAMERA, RAMP, EIGHT, {"weight": 0.6}),
}
"""Camera, scene, settings and a moderate strength for every mechanism without an estimator of its own."""
_FAST = ("excess_noise", "lens_shading")
_WIDEST = {"cosmic_rays": 0.6, "dead_pixels": 0.4, "defect_correction": 0.4}
"""Standard error over value, where a few dozen pixels are all there is to go by."""


@pytest.mark.filterwarnings("ignore::cannoise_jax.physics.core.sensor.ExtrapolationWarning")
@pytest.mark.parametrize("id", [i if i in _FAST else pytest.param(i, marks=pytest.mark.slow) for i in OTHERS])
def test_mechanisms_without_an_estimator_are_recovered(id):
    camera, clean, settings, parameters = OTHERS[id]
    truth = camera.with_mechanism(id, **parameters).with_unit(jax.random.key(99))
    frames = np.asarray(truth.sample(jax.random.key(7), clean, settings))
    options = {"simulations": 8, "bootstrap": 24, "steps": 5}
    fit = fit_mechanism(id, camera, frames, clean, jax.random.key(3), settings, **options)
    for name, true in parameters.items():
        estimate = fit.estimates[name]
        assert abs(estimate.value - true) < 4 * estimate.stderr, (name, estimate)
        assert estimate.stderr < _WIDEST.get(id, 0.3) * true, (name, estimate)
    assert fit.misfit < 3


def test_a_parameter_that_nothing_depends_on_is_unknown():
    parameters = (Parameter("mean", "1", 1.0, -9.0, 9.0), Parameter("idle", "1", 2.0, 0.5, 90.0, "log"))

    def simulate(key, x):
        drawn = x[0] + jax.random.normal(key, (50,))
        return jnp.stack([jnp.mean(drawn), jnp.mean(drawn**2)])

    observed = np.asarray(simulate(jax.random.key(5), jnp.array([2.0, 0.0])), float)
    fit = fit_moments(simulate, observed, parameters, jax.random.key(1), bootstrap=24)
    assert abs(fit.estimates["mean"].value - 2) < 4 * fit.estimates["mean"].stderr < 2
    assert fit.estimates["idle"].stderr == np.inf and fit.estimates["idle"].ci90 == (0.5, 90.0)


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
