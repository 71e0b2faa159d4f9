"""Places: every one is known to all that read them, and one that there is not is refused when a record is
made."""

from __future__ import annotations

from typing import get_args

import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.places import NO_LINE, NOT_DRAWN, PLACES, SITES, PlaceName
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Axes

SIZE = (6, 10)


def test_the_types_and_the_table_name_the_same_places():
    assert {name for part in get_args(PlaceName) for name in get_args(part)} == set(PLACES)
    assert {name for name, place in PLACES.items() if place.sites is not NOT_DRAWN} == set(SITES)
    assert all(place.over and place.at for place in PLACES.values())


@pytest.mark.parametrize("name", SITES)
def test_every_number_of_a_place_is_seen_and_follows_its_line(name):
    shape = PLACES[name].sites(SIZE, (2, 5))
    count = int(np.prod(shape))
    numbers = jnp.arange(count, dtype=jnp.float32).reshape(1, *shape)
    seen = np.broadcast_to(np.asarray(PLACES[name].spread(numbers, SIZE))[0], SIZE)
    assert set(np.unique(seen)) == set(range(count))
    if PLACES[name].lag is not NO_LINE:
        dy, dx = PLACES[name].lag(1, SIZE[1])
        assert seen[2 + dy, 3 + dx] == seen[2, 3] + 1


def test_a_place_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="'pixle' is no place"):
        Axes("readout", "pixle", "redrawn", "additive", "white")
    for where in ({}, {"axis": "whole"}):
        with pytest.raises(ValueError, match="is no place that anything varies over"):
            Score(
                log_p=0.0, gain=0.0, penalty=0.0, amplitude=1.0, error=0.1, shift=0.1, power=2,
                parameters={}, where=where,
            )  # fmt: skip
