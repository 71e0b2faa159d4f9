"""The median around every pixel, against scipy's."""

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.physics.robust import local_median


@pytest.mark.parametrize("size", [3, 5, 7])
@pytest.mark.parametrize("shape", [(1, 1), (7, 9), (300, 80)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_it_is_the_median_of_what_lies_around(size, shape, dtype):
    values = np.random.default_rng(size).normal(size=shape).round(1).astype(dtype)  # with many that are equal
    before = values.copy()
    for mode, padded in (("nearest", "edge"), ("reflect", "symmetric")):
        told = local_median(values, size, padded)
        assert told.dtype == dtype
        np.testing.assert_array_equal(told, ndimage.median_filter(values, size, mode=mode))
    np.testing.assert_array_equal(values, before)
