"""Every declared likelihood is that of the frames drawn: its mean over them is minus the entropy."""

from __future__ import annotations

import dataclasses
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.fields import power_law_correlation
from cannoise_jax.physics.core.registry import MECHANISMS
from cannoise_jax.physics.likelihood.model import frame_log_prob, pixel_form, pixel_law, pixel_log_prob
from tests.physics.harness import (
    FRAMES,
    PER_RECORDING,
    SETTINGS,
    SIZE,
    camera,
    frames_of,
    key_of,
    prepared,
    scene,
)

SCORED = [id for id, m in MECHANISMS.items() if m.likelihood != "none"]
SHARED = ("row_noise", "column_noise", "row_pink_noise", "offset_drift", "illumination_drift")
# Nats per pixel that the approximate ones are known to be off, as their documentation states them.
STATED = {
    "saturation": 1.5e-3, "nonlinearity": 3e-4, "reference_error": 3e-4, "row_pink_noise": 3e-5,
}  # fmt: skip
WHITE = 1060


@partial(jax.jit, static_argnames="form")
def pixels(law, codes, form):
    return pixel_log_prob(law._replace(shared=None), codes, form)


def drawn(model, id: str, frames: int) -> np.ndarray:
    settings = dataclasses.replace(SETTINGS, frames=frames)
    if id not in PER_RECORDING:
        return frames_of(model, key_of(id), settings)
    context, values, _ = prepared(model)  # one error a recording: recordings of one frame

    def one(key):
        y, step = chain.run_chain(model, key, context, values, 1)
        return chain.to_codes(model, key, y, step, context, values)[0]

    return np.asarray(jax.vmap(one)(jax.random.split(key_of(id), frames)), np.float64)


def of_all_codes(law) -> np.ndarray:
    """Log-probability of every code in every pixel, [codes, H, W]: -inf where none is stored."""
    step, low, high = (np.asarray(v, np.float64) for v in law.grid)
    codes = np.arange(WHITE + 1.0)[:, None, None]
    found = np.array(pixels(law, jnp.asarray(codes, jnp.float32), pixel_form(law)), np.float64)
    found[(codes < low) | (codes > np.floor(high / step) * step) | (codes % step != 0)] = -np.inf
    return found


def entropy_of_normals(id: str) -> float:
    """Nats per pixel of rounded normal values whose covariance is written down in full."""
    context, (values,), _ = prepared(camera(id))
    (height, width), p = SIZE, {name: float(np.mean(v)) for name, v in values.items()}
    ones_h, ones_w = np.ones((height, height)), np.ones((width, width))
    light = np.asarray(context.mean_dn, np.float64).ravel()
    lag = np.abs(np.subtract.outer(np.arange(height), np.arange(height)))
    shared = {
        "row_noise": lambda s: s**2 * np.kron(np.eye(height), ones_w),
        "column_noise": lambda s: s**2 * np.kron(ones_h, np.eye(width)),
        "offset_drift": lambda s: s**2 * np.kron(ones_h, ones_w),
        "illumination_drift": lambda s: s**2 * np.outer(light, light),
        "row_pink_noise": lambda s: (
            s**2 * np.kron(np.asarray(power_law_correlation(p["exponent"], height), np.float64)[lag], ones_w)
        ),
    }[id](p.get("sigma_dn", p.get("sigma")))
    own = np.asarray(context.own_variance(), np.float64).ravel() + 1 / 12
    gain, electrons = float(np.mean(context.gain_dn_per_e)), light / float(np.mean(context.gain_dn_per_e))
    skewness = gain**3 * electrons / own**1.5
    whole = np.linalg.slogdet(np.diag(own) + shared)[1] / own.size
    return (np.log(2 * np.pi * np.e) + whole) / 2 - float(np.mean(skewness**2)) / 12


ALONE = [id for id in SCORED if id not in SHARED]


@pytest.mark.parametrize("id", ALONE)
def test_mean_log_likelihood_of_lone_pixels_is_minus_their_entropy(id):
    model = camera(id)
    codes = drawn(model, id, FRAMES).astype(int)
    log_prob = of_all_codes(pixel_law(model, scene(), SETTINGS))
    seen = np.take_along_axis(log_prob, codes, axis=0)
    mass, stated = np.exp(log_prob), STATED.get(id, 1e-5)
    np.testing.assert_allclose(mass.sum(0), 1, atol=2e-4 + 2 * stated)
    entropy = -np.sum(mass * np.where(mass > 0, log_prob, 0)) / codes[0].size
    error = seen.std() / np.sqrt(seen.size)
    assert error < 0.003
    assert seen.mean() == pytest.approx(-entropy, abs=4 * error + stated)


# Columns and frames go the way of rows; each has to be compiled by itself.
TRIED = [pytest.param(id, marks=pytest.mark.slow if id in SHARED[1::2] else ()) for id in SHARED]


@pytest.mark.parametrize("id", TRIED)
def test_mean_log_likelihood_of_pixels_with_a_shared_term_is_minus_their_entropy(id):
    model, count = camera(id), 300
    codes = drawn(model, id, FRAMES)[:count].astype(np.float32)  # drawn in the shapes of the harness
    form = pixel_form(pixel_law(model, scene(), SETTINGS))
    per_frame = np.asarray(frame_log_prob(model, codes, scene(), SETTINGS, form), np.float64) / codes[0].size
    error = per_frame.std() / np.sqrt(count)
    assert error < 0.006
    assert per_frame.mean() == pytest.approx(-entropy_of_normals(id), abs=4 * error + STATED.get(id, 1e-5))
