"""Initial noise of a sensor model at its own baseline and an exposure: against closed forms and counting."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_noise import nearest_iso

GAIN, READ, BLACK, WHITE = 2.0, 3.0, 200.0, 4095.0
SPAN = WHITE - BLACK
PLAIN = SensorModel.poisson_gaussian(GAIN, READ, BLACK, WHITE)
DARK = jnp.zeros((4, 32, 32, 4))


def drawn(model, exposure_s, clean=DARK, shot=GAIN / SPAN, read=1.0, key=0):
    levels = [jnp.full((clean.shape[0], 4), v) for v in (shot, read)]
    draw = jax.jit(model.n_init(exposure_s=exposure_s))
    return tuple(np.asarray(v, np.float64) for v in draw(jax.random.key(key), clean, *levels))


def test_the_baseline_is_the_sensors_own_whatever_read_is_told():
    noise, sigma = drawn(PLAIN, 0.01)
    whole = np.sqrt((GAIN * READ) ** 2 + 1 / 12) / SPAN
    assert noise.std() == pytest.approx(whole, rel=0.03)
    np.testing.assert_allclose(sigma, whole, rtol=1e-4)


def test_dark_charge_grows_with_the_exposure_and_is_in_sigma():
    model = PLAIN.with_mechanism("dark_current", e_per_s=4.0)
    for exposure in (0.1, 10.0, 100.0):
        noise, sigma = drawn(model, exposure)
        charge = 4.0 * exposure
        assert noise.mean() * SPAN == pytest.approx(GAIN * charge, abs=0.1 + 0.02 * GAIN * charge)
        whole = np.sqrt(GAIN**2 * (READ**2 + charge) + 1 / 12) / SPAN
        assert noise.std() == pytest.approx(whole, rel=0.03)
        np.testing.assert_allclose(sigma, whole, rtol=1e-3)


def test_the_gain_setting_is_the_nearest_to_the_shot_noise():
    model = SensorModel.poisson_gaussian([[1.0], [4.0]], [[6.0], [2.0]], BLACK, WHITE, iso=(100.0, 400.0))
    for told, gain, read in ((0.5, 1, 6), (1.8, 1, 6), (2.2, 4, 2), (9.0, 4, 2)):
        shot = told / SPAN
        assert float(nearest_iso(model, jnp.full(4, shot))) == (100.0 if gain == 1 else 400.0)
        noise, _ = drawn(model, 0.01, shot=shot)
        assert noise.std() * SPAN == pytest.approx(np.sqrt((gain * read) ** 2 + 1 / 12), rel=0.03)


def test_frozen_patterns_lie_elsewhere_for_every_image_and_go_round_in_large_ones():
    model = PLAIN.with_mechanism("dsnu", sigma_dn=300.0).with_maps((128, 96))
    noise, _ = drawn(model, 0.01)
    first, second = noise[0].ravel(), noise[1].ravel()
    assert abs(np.corrcoef(first, second)[0, 1]) < 0.2 and first.std() * SPAN > 100
    large, _ = drawn(model, 0.01, jnp.full((1, 96, 96, 4), 0.3))
    np.testing.assert_allclose(large[0, :32], large[0, 64:96], atol=8 * 40 * GAIN / SPAN)
    assert np.corrcoef(large[0, :, :48].ravel(), large[0, :, 48:].ravel())[0, 1] > 0.95


def test_it_has_the_moments_of_frames_that_the_model_samples():
    model = PLAIN.with_mechanism("dark_current", e_per_s=4.0).with_mechanism("row_noise", sigma_dn=5.0)
    frames = model.sample(jax.random.key(1), np.full((64, 64), 0.05), Settings(exposure_s=20.0, frames=8))
    made = (np.asarray(frames, np.float64) - BLACK) / SPAN - 0.05
    noise, _ = drawn(model, 20.0, jnp.full((8, 32, 32, 4), 0.05))
    assert noise.mean() == pytest.approx(made.mean(), abs=4 * made.std() / np.sqrt(made.size / 4))
    assert noise.std() == pytest.approx(made.std(), rel=0.03)
