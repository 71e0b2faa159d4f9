"""1/f noise of rows is drawn as strong within a frame as it was found there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.fields import colour, within_frame
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import Settings
from cannoise_jax.signatures.fields import helmert, refit
from cannoise_jax.signatures.handed import Found
from tests.discovery.looks import SIGNATURES, white

SIZE, FRAMES, NOISE = (140, 96), 10, 2.0


def slow_rows(rng, sigma):
    """Rows of 1/f noise, of which a frame is an eighth of a long record."""
    frequency = np.fft.rfftfreq(8 * SIZE[0])[1:]
    waves = rng.standard_normal((FRAMES, frequency.size, 2)) @ np.array([1, 1j]) / np.sqrt(frequency)
    rows = np.fft.irfft(np.pad(waves, ((0, 0), (1, 0))), axis=1)[:, : SIZE[0]]
    return sigma * rows / np.sqrt(np.mean(rows**2))


def within(frames):
    """Variance of the means of rows within a frame."""
    return np.mean(frames.mean(2).var(1))


@pytest.mark.parametrize("sigma", [0.5, 2.0])
def test_draws_have_the_rows_of_the_recordings(sigma):
    rng, out, recorded = np.random.default_rng(1), [], []
    for f in white(rng, kinds=("dark",) * 4, frames=FRAMES, size=SIZE, sigma=NOISE):
        rows = slow_rows(rng, sigma)
        recorded.append(rows.var(1).mean())
        frames = rng.standard_normal((FRAMES, *SIZE)) + rows[:, :, None] / NOISE
        out.append(f._replace(contrasts=np.einsum("nt,tij->nij", helmert(FRAMES), frames).astype(np.float32)))
    fields = refit(tuple(out))
    signature = SIGNATURES["row_slope"]
    score = signature.score(fields)
    found = Found(
        mechanism="row_pink_noise", score=score, fields=fields, pattern=None, gain=1.0, read_dn=NOISE,
        seconds=1.0, longest=1.0, span=4000.0, size=SIZE,
    )  # fmt: skip
    model = SensorModel.poisson_gaussian(1.0, NOISE, 500.0, 4095.0, "MONO")
    model = model.with_mechanism("row_pink_noise", **signature.simulate(found).values)
    settings = Settings(frames=200)
    drawn = np.asarray(model.sample(jax.random.key(2), jnp.zeros(SIZE), settings), float)
    pixels = (NOISE**2 + 1 / 12) / SIZE[1]
    assert within(drawn) - pixels == pytest.approx(np.mean(recorded), rel=0.1)


@pytest.mark.parametrize("exponent", [0.5, 1.0, 1.5])
def test_the_strength_within_a_frame_is_that_of_draws(exponent):
    white_noise = np.random.default_rng(5).standard_normal((20_000, 2 * SIZE[0]))
    rows = np.asarray(colour(jnp.asarray(white_noise, jnp.float32), exponent))
    assert np.sqrt(rows.var(1).mean()) == pytest.approx(within_frame(exponent, "row", SIZE), rel=0.01)
