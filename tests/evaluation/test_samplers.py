"""A model in parts, as evaluation takes it, gives what the whole gives, and reads no image twice."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from cannoise_jax.evaluation.samplers import by_latents
from cannoise_jax.sampling import sample_noise
from cannoise_jax.training.result import samplers_of
from tests.small_model import NLF, noisy, scene, small_model


def test_every_image_is_encoded_once_and_goes_where_it_is_asked_for():
    images = np.random.default_rng(0).uniform(size=(20, 16, 16, 4)).astype(np.float32)
    encoded = []

    def encode(some):
        encoded.extend({image.tobytes() for image in some})
        return some.mean((1, 2))

    def draw(key, clean, latents, level):
        return latents, level

    sample = by_latents(encode, draw)
    right, other = np.arange(20).reshape(10, 2), np.arange(20)[::-1].reshape(10, 2)
    for places in (right, other, right[:, :1]):
        latents, level = sample(None, None, images[places], NLF)
        np.testing.assert_array_equal(latents, images[places].mean((2, 3)))
        assert (np.asarray(level.shown) == places.shape[1]).all() and (np.asarray(level.known) == 1).all()
    assert len(encoded) == len(set(encoded)) == len(images)
    assert (np.asarray(sample(None, None, images[right], None)[1].known) == 0).all()


@pytest.mark.parametrize(
    ("way", "references"),
    [
        ("usual", 3),
        pytest.param("given", 1, marks=pytest.mark.slow),
        pytest.param("usual", 1, marks=pytest.mark.slow),
        pytest.param("given", 3, marks=pytest.mark.slow),
    ],
)
def test_a_model_in_parts_is_sample_noise(way, references):
    model, key = small_model(), jax.random.key(3)
    clean = jnp.stack([scene(32, 32), scene(32, 32)[::-1]])
    shown = jnp.stack([noisy(k) for k in jax.random.split(key, 2 * references)])
    shown = shown.reshape(2, references, *shown.shape[1:])
    shot, read = (jnp.full((2, 4), v) for v in NLF)
    made = getattr(samplers_of(model, ConfigDict({"compiler": {}})), way)(key, clean, shown, shot, read)
    nlf = (shot, read) if way == "given" else None
    each = jax.jit(jax.vmap(sample_noise, (None, 0, 0, 0, 0)))
    whole = each(model, jax.random.split(key, 2), clean, shown, nlf)
    np.testing.assert_allclose(made, whole, atol=1e-6)
