"""Noise Flow: its count of parameters, its inverse, its determinant, and that it is a density."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks.noise_flow import NoiseFlow, log_likelihood, with_levels

FLOW = NoiseFlow()
CAMERA, ISO = jnp.array([1, 3]), jnp.array([4, 0])


@pytest.fixture(scope="module")
def variables():
    """As after some training: no layer at its start, all layers different, statistics of its own."""
    image = jnp.ones((2, 3, 5, 4))
    made = FLOW.init(jax.random.key(0), image, image, CAMERA, ISO)
    rng = np.random.default_rng(1)

    def moved(leaf):
        return leaf + jnp.asarray(0.2 * rng.normal(size=leaf.shape), jnp.float32)

    params = jax.tree.map(moved, made["params"])
    for name, part in params.items():
        if name.startswith("couple"):
            part["size"] = part["size"] + 0.5
    stats = jax.tree.map(lambda leaf: jnp.abs(moved(leaf)) + 0.3, made["batch_stats"])
    return {**made, "params": params, "batch_stats": stats}


def images(size=(3, 5)):
    rng = np.random.default_rng(2)
    clean = jnp.asarray(rng.uniform(0, 1, (2, *size, 4)), jnp.float32)
    return jnp.asarray(0.1 * rng.normal(size=(2, *size, 4)), jnp.float32), clean


def test_it_has_the_parameters_of_the_reference(variables):
    def count(tree):
        return sum(leaf.size for leaf in jax.tree.leaves(tree))

    assert count(variables["params"]) == 2433
    assert count(variables["batch_stats"]) == 128
    assert count(variables["fixed"]) == 8 * (16 + 4)


def test_the_inverse_gives_the_noise_back_at_any_size(variables):
    for size in ((3, 5), (8, 8)):
        noise, clean = images(size)
        latent, _ = FLOW.apply(variables, noise, clean, CAMERA, ISO)
        back = FLOW.apply(variables, latent, clean, CAMERA, ISO, method="inverse")
        np.testing.assert_allclose(back, noise, atol=2e-6 * float(jnp.abs(latent).max()))
        assert float(jnp.std(latent)) > 2 * float(jnp.std(noise))  # it is not the identity


def test_the_layers_weights_are_not_interchangeable(variables):
    """Reversing the coupling networks, as the reference's sampler does, is seen by the inverse."""
    noise, clean = images()
    latent, _ = FLOW.apply(variables, noise, clean, CAMERA, ISO)
    params = dict(variables["params"])
    for i in range(8):
        params[f"couple{i}"] = variables["params"][f"couple{7 - i}"]
    back = FLOW.apply({**variables, "params": params}, latent, clean, CAMERA, ISO, method="inverse")
    assert float(jnp.std(back - noise)) > 0.1 * float(jnp.std(noise))


def test_the_determinant_is_that_of_the_jacobian(variables):
    noise, clean = images()
    _, log_det = FLOW.apply(variables, noise, clean, CAMERA, ISO)
    for b in range(2):

        def latent(x, b=b):
            one = (x.reshape(1, 3, 5, 4), clean[b : b + 1], CAMERA[b : b + 1], ISO[b : b + 1])
            return FLOW.apply(variables, *one)[0].ravel()

        sign, size = np.linalg.slogdet(np.asarray(jax.jacfwd(latent)(noise[b].ravel()), np.float64))
        assert sign != 0
        assert float(log_det[b]) == pytest.approx(size, abs=2e-3)


def test_without_its_layers_it_is_the_density_of_poisson_gaussian_noise():
    """At the start the couplings do nothing and the mixings turn: only the signal layer is left."""
    shot, read = np.array([1e-3, 2e-3, 4e-3, 8e-3, 1.6e-2]), 1e-4
    noise, clean = images()
    start = FLOW.init(jax.random.key(0), noise, clean, CAMERA, ISO)
    flow = with_levels(start, FLOW.isos, shot, read)
    latent, log_det = FLOW.apply(flow, noise, clean, CAMERA, ISO)
    variance = shot[np.asarray(ISO)][:, None, None, None] * np.asarray(clean) + read
    exact = -0.5 * (np.square(noise) / variance + np.log(2 * np.pi * variance)).mean((1, 2, 3))
    np.testing.assert_allclose(log_likelihood(latent, log_det), exact, rtol=1e-4)
    drawn = FLOW.apply(
        flow, jax.random.normal(jax.random.key(1), (2, 64, 64, 4)), jnp.full((2, 64, 64, 4), 0.3),
        CAMERA, ISO, method="inverse",
    )  # fmt: skip
    expected = shot[np.asarray(ISO)] * 0.3 + read
    np.testing.assert_allclose(np.var(drawn, axis=(1, 2, 3)), expected, rtol=5 * (2 / 16384) ** 0.5)


def test_batch_statistics_move_in_training_only(variables):
    noise, clean = images()
    _, moved = FLOW.apply(variables, noise, clean, CAMERA, ISO, train=True, mutable=["batch_stats"])
    old, new = (jax.tree.leaves(v["batch_stats"]) for v in (variables, moved))
    assert all(float(jnp.abs(a - b).max()) > 0 for a, b in zip(old, new, strict=True))
