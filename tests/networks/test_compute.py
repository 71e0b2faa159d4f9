"""Convolutions in bfloat16: near the float32 ones, on weights that stay float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks import Discriminator, Encoder, Generator

IMAGE = (2, 64, 64, 4)


def images(seed=0):
    rng = np.random.default_rng(seed)
    clean = jnp.asarray(rng.uniform(0.1, 0.5, IMAGE), jnp.float32)
    sigma = jnp.full(IMAGE, 0.02)
    return clean, sigma * jnp.asarray(rng.normal(size=IMAGE), jnp.float32), sigma


def both(network, *inputs, **named):
    """The output in float32 and in bfloat16 with the same weights, and those weights."""
    keys, low = {"params": jax.random.key(0), "noise": jax.random.key(1)}, network.clone(dtype="bfloat16")

    def of(module, variables):
        apply = jax.jit(lambda v, *given: module.apply(v, *given, rngs={"noise": jax.random.key(2)}, **named))
        return apply(variables, *inputs)

    # As programs: operations one by one are compiled for every shape.
    variables = jax.jit(lambda: network.init(keys, *inputs, **named))()
    weights = jax.eval_shape(lambda: low.init(keys, *inputs, **named))
    return of(network, variables), of(low, variables), weights


def off(exact, low):
    """Root mean square of the difference over that of the exact values about their mean."""
    return float(jnp.linalg.norm(exact - low) / jnp.linalg.norm(exact - jnp.mean(exact)))


@pytest.mark.parametrize("literal", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_networks_in_few_bits_stay_near_and_return_float32(literal):
    clean, noise, sigma = images()
    shared = {"width": 1 / 16, "literal": literal, "output_norm": False}
    latent = jnp.ones((2, 32)) / 32**0.5
    generator = Generator(**shared)
    exact, low, weights = both(generator, clean, noise, latent, sigma, train=False)
    assert low.dtype == jnp.float32
    assert off(exact, low) < 0.02
    assert {leaf.dtype for leaf in jax.tree.leaves(weights)} == {jnp.dtype("float32")}
    exact, low, _ = both(Discriminator(**shared), noise, clean, sigma, train=False)
    for e, v in zip(exact, low, strict=True):
        assert v.dtype == jnp.float32
        assert 0 < off(e, v) < 0.05
    exact, low, _ = both(Encoder(width=1 / 16, literal=literal), clean + noise, train=False)
    assert low.dtype == jnp.float32
    assert 0 < off(exact, low) < 0.05


def test_spectral_norm_of_a_rounded_layer_is_that_of_the_exact_one():
    """Sigma in eight bits would scale a whole layer: over many outputs the mean ratio shows it."""
    from cannoise_jax.networks.layers import Conv

    x = jnp.asarray(np.random.default_rng(0).normal(size=(4, 16, 16, 32)), jnp.float32)
    exact, low, _ = both(Conv(64, 4, 2, 1), x, train=False)
    ratio = float(jnp.vdot(exact, low.astype(jnp.float32)) / jnp.vdot(exact, exact))
    assert abs(ratio - 1) < 5e-4
