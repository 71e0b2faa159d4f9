"""A small model as after some training, and scenes that it puts noise on."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.sampling import Camera, Model, Setting, make_model

WIDTH = 1 / 64
SHOT, READ = 2e-3, 1e-5
NLF = (SHOT, READ)


def drawn(shapes, size):
    """Variables of these shapes as after some training: no layer is at its zero start any more."""
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(size * rng.normal(size=leaf.shape), jnp.float32), shapes)


def small_model() -> Model:
    # No spectral norms and no jitted init: both only cost compile time here.
    generator, encoder = Generator(WIDTH, hidden=8, spectral=False), Encoder(WIDTH, hidden=8)
    image, latent, key = jnp.ones((1, 32, 32, 4)), jnp.ones((1, 8)), jax.random.key(0)
    g = jax.eval_shape(
        lambda: generator.init({"params": key, "noise": key}, image, image, latent, image, train=False)
    )
    e = jax.eval_shape(lambda: encoder.init(key, image, train=False))
    cameras = {
        "A/1": Camera(scene(64, 64)[None], {"100": Setting(jnp.full(4, SHOT), jnp.full(4, READ))}),
        "B": Camera(scene(32, 32)[None], {}),
    }
    return make_model(generator, drawn(g, 0.12), encoder, drawn(e, 0.15), cameras)


def scene(height, width):
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return jnp.asarray(np.repeat(0.1 + 0.05 * np.sin(x / 9 + y / 15)[..., None], 4, -1))


def noisy(key, height=64, width=64):
    clean = scene(height, width)
    return clean + jnp.sqrt(SHOT * clean + READ) * jax.random.normal(key, clean.shape)
