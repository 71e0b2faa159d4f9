"""Operations are counted as by hand."""

import jax
import jax.numpy as jnp
from jax import lax

from cannoise_jax.bench.operations import operations

X, KERNEL = jnp.zeros((2, 16, 16, 3)), jnp.zeros((4, 4, 3, 8))
NHWC = ("NHWC", "HWIO", "NHWC")


def conv(x, kernel):
    return lax.conv_general_dilated(x, kernel, (2, 2), [(1, 1), (1, 1)], dimension_numbers=NHWC)


FORWARD = 2 * (2 * 8 * 8 * 8) * (4 * 4 * 3)


def test_matrix_products():
    assert operations(lambda a, b: a @ b, jnp.zeros((5, 7)), jnp.zeros((7, 11))) == 2 * 5 * 7 * 11
    batched = jax.vmap(lambda a, b: a @ b)
    assert operations(batched, jnp.zeros((3, 5, 7)), jnp.zeros((3, 7, 11))) == 3 * 2 * 5 * 7 * 11


def test_a_strided_convolution_and_its_gradients_need_the_same_each():
    assert operations(conv, X, KERNEL) == FORWARD
    total = jax.grad(lambda x, k: jnp.sum(jnp.square(conv(x, k))), (0, 1))
    # Forward, and both gradients; at the edges taps that meet padding count too: a few per cent.
    assert abs(operations(total, X, KERNEL) / (3 * FORWARD) - 1) < 0.35


def test_programs_within_programs():
    many = jax.jit(lambda x: lax.scan(lambda c, _: (c @ c, None), x, None, length=6)[0])
    assert operations(many, jnp.zeros((4, 4))) == 6 * 2 * 4**3
    assert operations(lambda x: x + 1, X) == 0
