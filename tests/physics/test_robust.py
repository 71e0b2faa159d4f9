import numpy as np
import pytest

from cannoise_jax.physics.robust import median

SIZES = ((1,), (2,), (7,), (8,), (3, 5), (4, 6, 5))


@pytest.mark.parametrize("type_", [np.float32, np.float64, np.uint16, np.int64])
@pytest.mark.parametrize("size", SIZES)
def test_the_median_is_that_of_numpy_bit_for_bit(type_, size):
    values = (100 + 50 * np.random.default_rng(0).normal(size=size)).astype(type_)
    for axis in (None, *range(-len(size), len(size))):
        for keepdims in (False, True):
            ours, theirs = (f(values, axis, keepdims=keepdims) for f in (median, np.median))
            assert type(ours) is type(theirs) and np.shape(ours) == np.shape(theirs)
            np.testing.assert_array_equal(ours, theirs)


def test_so_is_that_of_what_is_no_number():
    values = np.array([[1.0, np.inf, 3.0, -np.inf], [np.nan, 2.0, 5.0, 1.0]])
    for axis in (None, 0, 1):
        np.testing.assert_array_equal(median(values, axis), np.median(values, axis))


def test_what_is_given_stays_as_it_is():
    values = np.array([3.0, 1.0, 2.0])
    assert median(values) == 2 and values.tolist() == [3.0, 1.0, 2.0]
