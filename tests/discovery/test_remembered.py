"""Results that are kept while the arrays that they come from are the same."""

from __future__ import annotations

import gc

import numpy as np

from cannoise_jax.signatures.remembered import remembered
from tests.discovery.looks import white


def test_a_result_is_kept_for_the_same_arrays_and_for_no_others():
    calls = []

    @remembered("contrasts", "static")
    def power(field):
        calls.append(field.name)
        return float(np.sum(field.contrasts**2))

    (field,) = white(np.random.default_rng(0), kinds=("dark",), frames=4, size=(8, 8))
    first = power(field)
    assert power(field._replace(sigma=2 * field.sigma)) == first and len(calls) == 1
    assert power(field._replace(contrasts=2 * field.contrasts)) == np.float64(4) * first and len(calls) == 2
    assert power(field._replace(static=None)) == first and len(calls) == 3


def test_an_array_at_the_address_of_another_is_not_taken_for_it():
    @remembered("contrasts")
    def total(field):
        return float(field.contrasts.sum())

    (field,) = white(np.random.default_rng(1), kinds=("dark",), frames=3, size=(8, 8))
    for n in range(200):
        assert total(field._replace(contrasts=np.full((2, 8, 8), n, np.float32))) == 128.0 * n
        gc.collect(0)
