"""How far the approximate likelihood of a noisy reference is from the exact one."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.likelihood.model import frame_log_prob, pixel_form, pixel_law, pixel_log_prob

SIZE, SPAN, FRAMES = (24, 32), 4000.0, 8


@pytest.mark.parametrize(("electrons", "sigma"), [(80.0, 3.0), (800.0, 10.0)])
def test_one_frame_is_close_and_what_frames_share_is_what_is_lost(electrons, sigma):
    base = SensorModel.poisson_gaussian(1.0, 3.0, 200, 200 + SPAN, "MONO")
    model = base.with_mechanism("reference_error", sigma_dn=sigma)
    clean = np.full(SIZE, electrons / SPAN, np.float32)
    taken = [np.asarray(model.sample(jax.random.key(k), clean, Settings(frames=FRAMES))) for k in range(16)]
    frames = jnp.asarray(np.stack(taken), jnp.float32)
    # The exact one: over the error of each pixel's reference, one in all frames of a recording.
    points, weights = np.polynomial.hermite_e.hermegauss(31)
    law = pixel_law(base, clean, Settings())._replace(shared=None)
    form = pixel_form(law)
    of_mean = jax.jit(lambda more: pixel_log_prob(law._replace(electrons=law.electrons + more), frames, form))
    known = np.stack([np.asarray(of_mean(sigma * x), np.float64) for x in points])
    log_weight = np.log(weights / np.sqrt(2 * np.pi)).reshape(-1, 1, 1, 1)
    alone = logsumexp(known[:, :, 0] + log_weight, axis=0)
    together = logsumexp(known.sum(2) + log_weight, axis=0)

    def approximate(frames):
        return np.asarray(frame_log_prob(model, np.asarray(frames), clean, Settings()), np.float64)

    assert abs(approximate(frames[:, 0]).sum() / alone.size - alone.mean()) < 3e-4
    lost = together.mean() / FRAMES - approximate(frames.reshape(-1, *SIZE)).sum() / frames.size
    r = sigma**2 / (electrons + 9 + 1 / 12)
    expected = np.log1p(r) / 2 - np.log1p(FRAMES * r) / (2 * FRAMES)
    assert lost == pytest.approx(expected, rel=0.06)
