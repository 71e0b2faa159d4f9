"""Whole images: tiles give what the whole gives, at sides of any length."""

from __future__ import annotations

import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax import tiles
from cannoise_jax.networks import Generator
from cannoise_jax.networks.denoiser import DnCNN
from cannoise_jax.physics.initial_noise import poisson_gaussian
from cannoise_jax.sampling import make_model

NLF = (2e-3, 1e-5)
KEY = jax.random.key(5)


def drawn(shapes, size):
    rng = np.random.default_rng(0)
    return jax.tree.map(lambda leaf: jnp.asarray(size * rng.normal(size=leaf.shape), jnp.float32), shapes)


@pytest.fixture(scope="module", params=[True, False], ids=["branches", "networks"])
def model(request):
    """As after some training, rows and all; no encoder, which tiles do not concern."""
    generator = Generator(1 / 64, hidden=4, spectral=False, physics=request.param)
    image, key = jnp.ones((1, 32, 32, 4)), jax.random.key(0)
    shapes = jax.eval_shape(
        lambda: generator.init(
            {"params": key, "noise": key}, image, image, jnp.zeros((1, 1)), image, train=False
        )
    )
    return make_model(generator, drawn(shapes, 0.15), None, {})


def scene(height, width):
    y, x = np.mgrid[:height, :width].astype(np.float32)
    return 0.2 + 0.15 * np.sin(x / 9 + y / 15) * np.cos(x / 70)


REFERENCE = np.full((16, 16, 4), 0.1, np.float32)


def test_tiles_give_what_the_whole_gives(model, monkeypatch):
    """The image is wider than a tile with its surroundings, so that inner tiles lose real surroundings; with
    less than the reach the seams show."""
    clean = np.repeat(scene(32, 1100)[..., None], 4, -1)
    whole, tiled = (tiles.sample_image(model, KEY, clean, REFERENCE, NLF, tile=size) for size in (2048, 128))
    assert whole.std() > 0.01
    np.testing.assert_allclose(tiled, whole, atol=2e-5 * whole.std())
    monkeypatch.setattr(tiles, "REACH", 32)
    near = tiles.sample_image(model, KEY, clean, REFERENCE, NLF, tile=128)
    assert np.abs(near - whole).max() > 1e-3 * whole.std()


def test_noise_is_not_repeated_from_block_to_block(model):
    clean = np.full((64, 128, 4), 0.2, np.float32)
    noise = tiles.sample_image(model, KEY, clean, REFERENCE, NLF)
    blocks = noise.reshape(2, 32, 4, 32, 4).swapaxes(1, 2).reshape(8, -1)
    correlation = np.corrcoef(blocks) - np.eye(8)
    assert np.abs(correlation).max() < 0.3  # the rows that they share; a repeated draw: 1


def test_initial_noise_of_a_function_is_drawn_for_the_whole(model):
    clean = np.repeat(scene(64, 96)[..., None], 4, -1)
    own = model.replace(initial_noise=poisson_gaussian)
    a, b = (tiles.sample_image(own, KEY, clean, REFERENCE, NLF, tile=size) for size in (64, 512))
    np.testing.assert_allclose(a, b, atol=2e-5 * a.std())


@pytest.mark.parametrize("size", [(33, 57), (64, 65), (38, 46)])
def test_mosaics_of_any_size(model, size):
    counted = []
    noise = tiles.sample_mosaic(model, KEY, scene(*size), "GRBG", REFERENCE, NLF, progress=counted.append)
    assert noise.shape == size and np.isfinite(noise).all() and noise.std() > 0
    assert size[0] * size[1] <= sum(counted) <= (size[0] + 1) * (size[1] + 1)


def test_wrong_shapes_are_refused(model):
    with pytest.raises(ValueError, match="packed"):
        tiles.sample_image(model, KEY, np.zeros((64, 64), np.float32), REFERENCE, NLF)
    with pytest.raises(ValueError, match="multiple of 32"):
        tiles.sample_image(model, KEY, np.zeros((64, 64, 4), np.float32), REFERENCE, NLF, tile=100)


@pytest.mark.parametrize("size", [(61, 90), (64, 64), (3, 130)])
def test_a_denoiser_in_tiles_gives_what_it_gives_on_the_whole(size):
    module = DnCNN(depth=4, features=6)
    variables = module.init(jax.random.key(1), jnp.ones((1, 8, 8, 4)), train=False)
    variables = {**variables, "params": drawn(variables["params"], 0.3)}  # its last layer starts at zero
    run = partial(jax.jit(partial(module.apply, train=False)), variables)
    image = np.random.default_rng(0).normal(size=size).astype(np.float32)
    whole, tiled = (tiles.filter_mosaic(run, module.reach, image, "BGGR", tile=t) for t in (512, 16))
    assert whole.shape == size and np.abs(whole - image).max() > 0.1
    np.testing.assert_allclose(tiled, whole, atol=1e-5)


def test_the_papers_networks_take_the_image_as_it_is():
    """One piece without a margin: constant noise in, and what G makes of just that image out."""
    generator = Generator(1 / 64, literal=True)
    image, key = jnp.ones((1, 64, 64, 4)), jax.random.key(0)
    shapes = jax.eval_shape(lambda: generator.init(key, image, image, jnp.zeros((1, 1)), image, train=False))
    own = make_model(generator, drawn(shapes, 0.15), None, {}, initial_noise=constant, level="given")
    clean = np.repeat(scene(64, 64)[..., None], 4, -1)
    made = tiles.sample_image(own, KEY, clean, REFERENCE, NLF, tile=32)
    n_init, sigma = constant(KEY, clean[None], None, None)
    whole = jax.jit(lambda *given: generator.apply(own.generator, *given, train=False))
    wanted = whole(clean[None], n_init, jnp.zeros((1, 1)), sigma)
    np.testing.assert_allclose(made, wanted[0], atol=1e-5)


def constant(key, clean, shot, read):
    return jnp.full(clean.shape, 0.01), jnp.full(clean.shape, 0.02)


_GROWTH = """
from pathlib import Path

import jax
import numpy as np

from cannoise_jax.commands.freed_memory import give_back_large
from cannoise_jax.networks import Generator
from cannoise_jax.sampling import make_model
from cannoise_jax.tiles import sample_mosaic

def kilobytes(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))

give_back_large()
generator, key = Generator(1 / 16, hidden=16, spectral=False), jax.random.key(0)
image = np.ones((1, 32, 32, 4), np.float32)
keys = {"params": key, "noise": key}
latent = np.zeros((1, 1), np.float32)
variables = jax.jit(lambda: generator.init(keys, image, image, latent, image, train=False))()
model = make_model(generator, variables, None, {})
reference, nlf = np.full((64, 64, 4), 0.1, np.float32), (1e-3, 1e-5)
sample_mosaic(model, key, np.full((256, 256), 0.1, np.float32), "RGGB", reference, nlf)
clean = np.full((4000, 6000), 0.1, np.float32)
before = kilobytes("VmRSS")
sample_mosaic(model, key, clean, "RGGB", reference, nlf)
print((kilobytes("VmHWM") - before) / 1024)
"""


@pytest.mark.slow
def test_24_megapixels_take_less_than_a_gigabyte_beside_the_image():
    """At the width of the default, in a process of its own, as bin/sample draws."""
    run = subprocess.run([sys.executable, "-c", _GROWTH], capture_output=True, text=True, check=True)
    assert float(run.stdout) < 1024, run.stdout
