"""Every formulation of a convolution is the plain one: in float64, through second derivatives."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks.convolutions import (
    CONV,
    CONV_TRANSPOSE,
    choose_conv,
    conv2d,
)

CASES = [
    ("patches", 4, 2, 1, 6),
    ("patches", 4, 1, 1, 4),
    ("patches", 3, 1, 1, 2),
    ("patches", 1, 1, 0, 3),
    ("blocks", 3, 1, 1, 4),
    ("blocks", 7, 1, 3, 6),
    ("runs", 3, 1, 1, 4),
    ("runs", 7, 1, 3, 6),
    ("runs", 4, 2, 1, 8),
]


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


def draw(seed, *shape):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape))


def penalty(function):
    """A gradient penalty: its gradients with respect to input and kernel are second derivatives."""

    def value(x, kernel):
        slope = jax.grad(lambda x: jnp.sum(jnp.tanh(function(x, kernel))))(x)
        return jnp.sum(jnp.square(jnp.sqrt(jnp.sum(jnp.square(slope), (1, 2, 3))) - 1))

    return jax.jit(jax.value_and_grad(value, (0, 1)))


def assert_same_function(function, plain, x, kernel):
    np.testing.assert_allclose(function(x, kernel), plain(x, kernel), rtol=1e-12, atol=1e-12)
    for ours, theirs in zip(
        jax.tree.leaves(penalty(function)(x, kernel)),
        jax.tree.leaves(penalty(plain)(x, kernel)),
        strict=True,
    ):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(("name", "size", "stride", "padding", "side"), CASES)
def test_convolutions_agree(name, size, stride, padding, side):
    assert_same_function(
        lambda x, k: CONV[name](x, k, stride, padding),
        lambda x, k: CONV["plain"](x, k, stride, padding),
        draw(0, 2, side, side + 2 * (side % 2 == 0), 3),
        draw(1, size, size, 3, 5),
    )


@pytest.mark.parametrize("name", sorted(CONV_TRANSPOSE.keys() - {"plain"}))
@pytest.mark.parametrize("side", [1, 2, 5])
def test_transposed_convolutions_agree(name, side):
    assert_same_function(
        CONV_TRANSPOSE[name], CONV_TRANSPOSE["plain"], draw(0, 2, side, side + 1, 3), draw(1, 4, 4, 3, 5)
    )


def test_the_plain_transposed_convolution_is_its_definition():
    x, kernel = np.asarray(draw(0, 1, 3, 3, 2)), np.asarray(draw(1, 4, 4, 2, 3))
    expected = np.zeros((8, 8, 3))
    for i in range(3):
        for j in range(3):
            expected[2 * i : 2 * i + 4, 2 * j : 2 * j + 4] += x[0, i, j] @ kernel
    np.testing.assert_allclose(CONV_TRANSPOSE["plain"](x, kernel)[0], expected[1:-1, 1:-1], atol=1e-12)


@pytest.mark.parametrize(("size", "stride", "padding"), [(1, 1, 0), (3, 1, 1), (4, 2, 1), (7, 1, 3)])
@pytest.mark.parametrize("side", [8, 9])
def test_the_choice_is_one_that_can_be_made(size, stride, padding, side):
    """Whatever the shape, the formulation that the rule names gives the plain result."""
    x, kernel = draw(0, 1, side, side, 2), draw(1, size, size, 2, 3)
    for twice in (False, True):
        got = conv2d(x, kernel, stride, padding, twice=twice)
        np.testing.assert_allclose(got, CONV["plain"](x, kernel, stride, padding), atol=1e-12)


def test_small_maps_become_matrix_products_and_large_ones_do_not():
    assert choose_conv(4, 3, 1024, 1024, 1, False) == "patches"
    assert choose_conv(64 * 64, 3, 20, 32, 1, False) == "plain"
    assert choose_conv(64 * 64, 4, 16, 16, 2, True) == "patches"
    assert choose_conv(64 * 64, 7, 4, 16, 1, False) == choose_conv(64 * 64, 4, 8, 16, 2, False) == "runs"
