"""The likelihood of what alters the charge and the light itself, against laws known in other ways."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.likelihood.model import frame_log_prob, pixel_form, pixel_law

SIZE, LEVEL, SPAN = (16, 24), 0.3, 16183.0
ELECTRONS = LEVEL * SPAN / 2
SETTINGS = Settings(exposure_s=1.0)
BASE = SensorModel.poisson_gaussian(2.0, 4.0, 200, 16383, "MONO", unit_key=jax.random.key(2))
CLEAN = np.full(SIZE, LEVEL, np.float32)


def bent(charge, loss):
    return charge * (1 - loss * 2 / SPAN * charge)


@pytest.mark.parametrize(
    ("dark", "full", "loss"),
    [
        (0, 1500, 0),
        (0, ELECTRONS, 0),
        (0, ELECTRONS + 40, 0),
        (0, None, 0.2),
        (0, None, 0.4),
        (200, 1000, 0),
        (1500, None, 0.4),
        (800, ELECTRONS + 800, 0.3),
    ],
)
def test_altered_charge_has_the_log_probability_of_all_its_counts(dark, full, loss):
    model = BASE.with_mechanism("dark_current", e_per_s=float(dark)) if dark else BASE
    if full is not None:
        model = model.with_mechanism("saturation", full_well_e=float(full))
    if loss:
        model = model.with_mechanism("nonlinearity", loss=loss)
    rng, mean = np.random.default_rng(4), ELECTRONS + dark
    counts = np.arange(int(mean - 9 * np.sqrt(mean)), int(mean + 9 * np.sqrt(mean)))
    top = np.inf if full is None else full
    levels = 200 + 2 * bent(np.minimum(counts, top), loss)
    drawn = 200 + 2 * bent(np.minimum(rng.poisson(mean, (3, *SIZE)), top), loss)
    codes = np.round(drawn + 8 * rng.normal(size=drawn.shape))
    each, place = np.unique(codes, return_inverse=True)
    edges = (each[:, None] + np.array([-0.5, 0.5])[:, None, None] - levels) / 8
    known = np.log(np.diff(stats.norm.cdf(edges), axis=0)[0] @ stats.poisson.pmf(counts, mean))
    found = np.asarray(frame_log_prob(model, codes.astype(np.float32), CLEAN, SETTINGS)).sum()
    # Of bent charge only the mean and variance are kept; a full well leaves the skewness of what is cut.
    assert found / codes.size == pytest.approx(known[place].mean(), abs=3e-3)
    law = pixel_law(model, CLEAN, SETTINGS)
    weight = stats.poisson.pmf(counts, mean)
    expected = weight @ levels
    np.testing.assert_allclose(law.mean, expected, atol=0.5)
    np.testing.assert_allclose(law.variance, weight @ (levels - expected) ** 2 + 64, rtol=0.02)


def test_a_full_pixel_shows_no_pattern_and_no_drift_of_the_light():
    model = BASE.with_mechanism("prnu", sigma=0.05).with_mechanism("saturation", full_well_e=1500.0)
    law = pixel_law(model.with_mechanism("illumination_drift", sigma=0.02), CLEAN, SETTINGS)
    np.testing.assert_allclose(law.mean, 3200.0, atol=0.01)
    np.testing.assert_allclose(law.variance, 64.0, rtol=1e-3)
    assert np.abs(law.shared.lit).max() < 1e-3


def test_drifting_light_does_not_move_the_dark_charge():
    model = SensorModel.poisson_gaussian(1.0, 4.0, 200, 16383, "MONO")
    model = model.with_mechanism("dark_current", e_per_s=4000.0)
    rng, frames, sigma = np.random.default_rng(0), 12, 0.05
    light = 500 * (1 + sigma * rng.normal(size=(frames, 1, 1)))
    drawn = 200 + rng.poisson(light + 4000, (frames, *SIZE)) + 4 * rng.normal(size=(frames, *SIZE))
    codes, clean = np.round(drawn).astype(np.float32), np.full(SIZE, 500 / SPAN, np.float32)

    @jax.jit
    def total(sigma):
        drifting = model.with_mechanism("illumination_drift", sigma=sigma)
        return frame_log_prob(drifting, codes, clean, SETTINGS, "skewed").sum()

    tried = np.array([0.02, 0.03, 0.04, 0.05, 0.06, 0.08, 0.12])
    best = tried[np.argmax([float(total(s)) for s in tried])]
    assert abs(best - sigma) < 2.5 * sigma / np.sqrt(2 * frames)


PARAMETERS = {"gain": 2.0, "read": 4.0, "prnu": 0.02, "row": 3.0}


def model_of(gain, read, prnu, row=None) -> SensorModel:
    base = SensorModel.poisson_gaussian(gain, read, 64, 1023, "RGGB", unit_key=jax.random.key(2))
    model = base.with_mechanism("prnu", sigma=prnu)
    return model if row is None else model.with_mechanism("row_noise", sigma_dn=row)


@pytest.mark.parametrize(
    "names", [tuple(PARAMETERS)[:3], pytest.param(tuple(PARAMETERS), marks=pytest.mark.slow)]
)
def test_gradients_of_frames_are_finite_differences_and_jit_agrees(names):
    clean = np.linspace(0.1, 0.5, SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE)
    start = {name: jnp.float32(PARAMETERS[name]) for name in names}
    model = model_of(**start)
    frames = jnp.asarray(model.sample(jax.random.key(1), clean, Settings(frames=2)), jnp.float32)
    form = pixel_form(pixel_law(model, clean, SETTINGS))
    assert form == "skewed"

    @jax.jit
    @partial(jax.value_and_grad, has_aux=True)
    def total(parameters):
        each = frame_log_prob(model_of(**parameters), frames, clean, SETTINGS, form)
        return each.sum(), each

    (middle, each), slopes = total(start)
    np.testing.assert_allclose(each, frame_log_prob(model, frames, clean, SETTINGS), rtol=2e-5)
    for name in names:
        value = PARAMETERS[name]
        # Long enough that float32 sums do not tell, short enough for the curvature.
        step = 0.02 * value
        above, below = (
            np.asarray(total({**start, name: jnp.float32(value + s)})[0][1], np.float64).sum()
            for s in (step, -step)
        )
        slope = (above - below) / (2 * step)
        scale = abs(above + below - 2 * float(middle)) / step**2 * step
        assert float(slopes[name]) == pytest.approx(slope, rel=0.02, abs=0.1 * scale + 0.02 / step)
