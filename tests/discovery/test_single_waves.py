"""A wave beside which as strong lines are left is one of a pattern that repeats."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.single_waves import one_of_many
from cannoise_jax.physics.core.sensor import SensorModel
from tests.discovery.capture import SIZE, capture_set, wave


def rolled_tile(rng):
    """A tile of 16 x 16 offsets all over the frame, elsewhere in every frame."""
    tile = rng.standard_normal((16, 16))
    whole = np.tile(tile, (SIZE[0] // 16, SIZE[1] // 16))
    return lambda dn, *_: dn + np.roll(whole, tuple(rng.integers(0, 16, 2)), (0, 1))


@pytest.mark.parametrize(("alter", "doubted"), [(rolled_tile, True), (wave(0.5), False)])
def test_lines_that_are_left_speak_against_a_wave(alter, doubted):
    capture = capture_set(4, alter, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    signature = next(s for s in prepared.signatures if s.name == "wave_redrawn")
    score = signature.score(prepared.fields)
    plain = SensorModel.poisson_gaussian([[1.5] * 4], [[3.0] * 4], (200.0,) * 4, 16383.0, "RGGB")
    shown = plain if doubted else plain.with_mechanism("banding", amplitude_dn=0.5, frequency=0.137)
    whole = compare_bank(capture, modelled(shown, jax.random.key(2)), sets=2, alpha=0.002)
    step = SimpleNamespace(
        named=SimpleNamespace(mechanism="banding", signature=signature, score=score), before=prepared.fields
    )
    against = one_of_many([step], 0, whole)
    assert (against is not None) == doubted
    assert not doubted or "more lines" in against.against[0]
