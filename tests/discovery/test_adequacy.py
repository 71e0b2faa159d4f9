"""A name stays where it accounts for its own part of the mismatch, and goes where it only comes nearest."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.adequacy import LEFT, doubt, own_part
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.name import UNKNOWN, Doubt, Named
from cannoise_jax.physics.core.sensor import SensorModel
from tests.discovery.capture import capture_set, row_offsets

KEY = jax.random.key(5)
GAIN, READ, BLACK, WHITE, SIGMA = 1.5, 3.0, 200.0, 16383.0, 1.5


def parts_of_rows(rng):
    """Offsets of the first 70 columns of every row, new in every frame."""
    return lambda dn, signal, kind, t: (
        dn + np.where(np.arange(dn.shape[1]) < 70, 1.0, 0.0) * 1.6 * rng.standard_normal((dn.shape[0], 1))
    )


def both(alter):
    """The layer with row noise in the simulator, and without."""
    capture = capture_set(8, alter, kinds="d")
    plain = SensorModel.poisson_gaussian([[GAIN] * 4], [[READ] * 4], (BLACK,) * 4, WHITE, "RGGB")
    with_rows = plain.with_mechanism("row_noise", sigma_dn=SIGMA)
    return [compare_bank(capture, modelled(m, KEY), sets=2, alpha=0.002) for m in (with_rows, plain)]


def test_a_mechanism_that_is_there_is_not_doubted():
    full, less = both(row_offsets(SIGMA))
    part = own_part(full, less)
    assert part.before > 500 and part.after < 0.1 * part.before
    assert doubt(full, less) is None


def test_one_that_only_resembles_what_is_there_is_doubted_and_why_is_said():
    full, less = both(parts_of_rows)
    found = doubt(full, less)
    assert found is not None and found.left > LEFT
    assert any("rows" in line for line in found.against)


def test_a_withdrawn_name_hands_its_probability_to_the_unknown():
    named = Named(None, None, "row_noise", (("row_noise", 0.9), (UNKNOWN, 0.06), ("banding", 0.04)), True)  # type: ignore[arg-type]
    gone = named.withdrawn(Doubt(0.6, ("rows (frame to frame)",)))
    assert gone.mechanism == gone.candidates[0][0] == UNKNOWN and not gone.ambiguous
    assert dict(gone.candidates) == pytest.approx({UNKNOWN: 0.96, "banding": 0.04, "row_noise": 0.0})
    assert gone.doubt is not None and gone.doubt.nearest == "row_noise"
