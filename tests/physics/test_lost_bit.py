"""A bit of the codes that never changes is told, whatever else makes codes uneven is not."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.codes import missing_codes
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.lost_bit import lost_bit
from cannoise_jax.recordings.recording import Recording


def statistics(change=lambda codes: codes):
    rng, out = np.random.default_rng(0), []
    for kind, light in (("bias", 0.0), ("flat", 8000.0), ("flat", 24000.0)):
        charge = rng.poisson(light, (4, 96, 128)) + 6 * rng.standard_normal((4, 96, 128))
        codes = change(np.rint(500 + 0.5 * charge).astype(int)).astype(np.uint16)
        out.append(
            frame_statistics(Recording(codes, "MONO", (500.0,) * 4, 65535.0, "c", kind, exposure_s=1.0))
        )
    return out


@pytest.mark.parametrize(
    ("change", "bit", "state"),
    [(lambda v: v & ~8, 3, 0), (lambda v: v | 4, 2, 1), (lambda v: (v & ~2) << 2, 3, 0)],
    ids=("3 at 0", "2 at 1", "3 of codes shifted by two"),
)
def test_a_bit_that_never_changes_is_told(change, bit, state):
    stats = statistics(change)
    said = lost_bit(stats)
    assert said.startswith(f"bit {bit} of the codes ({1 << bit} DN) is {state} in all frames")
    assert said in faults(stats).stated
    found = missing_codes(stats)
    assert isinstance(found, NotMeasurable) and found.record == said


@pytest.mark.parametrize(
    "change",
    [
        lambda v: v,
        lambda v: v << 4,
        lambda v: np.rint(v * 1.37).astype(int),
        lambda v: np.rint(np.rint(np.sqrt(v * 4)) ** 2 / 4).astype(int),
        lambda v: np.where(v % 8 == 3, v + 1, v),
    ],
    ids=("raw", "shifted", "digital gain", "table", "missing codes"),
)
def test_other_uneven_codes_have_no_lost_bit(change):
    assert lost_bit(statistics(change)) == ""
