"""The networks have the parameters of the paper's tables, and the default starts as its own initial noise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks import Discriminator, Encoder, Generator


def shape(*size):
    return jax.ShapeDtypeStruct(size, jnp.float32)


def count(variables):
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(variables["params"]))


@pytest.fixture
def keys():
    return {"params": jax.random.key(0), "noise": jax.random.key(1)}


def test_literal_generator_has_the_papers_parameters(keys):
    x, latent = shape(1, 64, 64, 4), shape(1, 512)
    init = lambda x, latent: Generator(literal=True).init(keys, x, x, latent, x, train=True)  # noqa: E731
    assert count(jax.eval_shape(init, x, latent)) == 68_053_640


def test_the_paper_without_its_impossible_norms_lacks_their_parameters_alone(keys):
    x, latent = shape(1, 64, 64, 4), shape(1, 512)
    module = Generator(literal=True, output_norm=False)
    init = lambda x, latent: module.init(keys, x, x, latent, x, train=True)  # noqa: E731
    assert count(jax.eval_shape(init, x, latent)) == 68_053_640 - 2 * 4
    critic = lambda x: Discriminator(literal=True, output_norm=False).init(keys, x, x, x, train=True)  # noqa: E731
    assert count(jax.eval_shape(critic, x)) == 668_416


def test_literal_encoder_has_the_papers_parameters(keys):
    init = lambda x: Encoder(literal=True).init(keys, x, train=True)  # noqa: E731
    assert count(jax.eval_shape(init, shape(1, 64, 64, 4))) == 2_766_848


def test_literal_discriminator_has_the_papers_parameters_and_two_of_its_output_norm(keys):
    init = lambda x: Discriminator(literal=True).init(keys, x, x, x, train=True)  # noqa: E731
    assert count(jax.eval_shape(init, shape(1, 64, 64, 4))) == 668_416 + 2
