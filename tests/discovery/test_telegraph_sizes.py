"""Telegraph pixels are counted, and their jumps measured, whatever law their sizes have."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.signatures.telegraph import telegraph_score
from tests.discovery.capture import SIZE, capture_set

SHARE = 0.012


def score_of(sizes, seed):
    """Jumps of these sizes in some pixels, high half of the time, beside a dark noise of 4.5 DN; and the rms
    that they have over all pixels, DN."""
    rng = np.random.default_rng(seed)
    jump = sizes(rng, SIZE) * (rng.random(SIZE) < SHARE)
    change = lambda rng: lambda dn, *_: dn + jump * (rng.random(dn.shape) < 0.5)  # noqa: E731
    capture = capture_set(seed, change, kinds="d", frames=12)
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    return telegraph_score(prepared.fields), float(np.sqrt(np.mean(jump**2) / 4)), jump


@pytest.mark.parametrize(
    "sizes",
    [lambda rng, size: rng.uniform(12, 24, size), lambda rng, size: rng.exponential(20.0, size)],
)
def test_number_and_size_of_jumps(sizes):
    score, rms, jump = score_of(sizes, 4)
    assert score.amplitude == pytest.approx(rms, rel=0.1)
    truth = {"fraction": np.mean(jump > 0), "jump": np.mean(jump[jump > 0])}
    for name, true in truth.items():
        value, _, error = score.parameters[name]
        assert abs(value - true) < 2 * error and error < 0.4 * value
        assert value == pytest.approx(true, rel=0.4)


def test_small_jumps_of_one_size_have_the_strength_that_they_have():
    score, rms, _ = score_of(lambda rng, size: np.full(size, 12.0), 4)
    assert score.amplitude == pytest.approx(rms, rel=0.1)
