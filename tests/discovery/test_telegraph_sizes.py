"""Telegraph pixels are counted, and their jumps measured, whatever law their sizes have."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.signatures.rare import EXPONENTIAL
from cannoise_jax.signatures.squares import histogram
from cannoise_jax.signatures.telegraph import _fitted, telegraph_score
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
    ("sizes", "within"),
    [
        (lambda rng, size: rng.uniform(12, 24, size), 0.4),
        (lambda rng, size: rng.exponential(20.0, size), 0.4),
    ],
)
def test_number_and_size_of_jumps(sizes, within):
    score, rms, jump = score_of(sizes, 4)
    assert score.amplitude == pytest.approx(rms, rel=0.1)
    share, size = score.parameters["fraction"][0], score.parameters["jump"][0]
    assert share == pytest.approx(np.mean(jump > 0), rel=within)
    assert size == pytest.approx(np.mean(jump[jump > 0]), rel=within)


def test_small_jumps_of_one_size_have_the_strength_that_they_have():
    score, rms, _ = score_of(lambda rng, size: np.full(size, 12.0), 4)
    assert score.amplitude == pytest.approx(rms, rel=0.1)


def test_how_well_the_number_of_jumping_pixels_is_known():
    """Few and large jumps are told from many and small ones by little: the error says so."""
    rng, (share, mean, frames, pixels), off = np.random.default_rng(0), (2e-3, 4.0, 37, 56_000), []
    for _ in range(30):
        jump = (rng.random(pixels) < share) * rng.exponential(mean, pixels)
        values = rng.standard_normal((frames, pixels)) + jump * (rng.random((frames, pixels)) < 0.5)
        told = _fitted(*histogram(values.var(0) * frames), frames - 1, EXPONENTIAL)
        off.append((told.share - share) / told.share_error)
        assert 0 < told.mean_error < told.mean
    assert 0.7 < np.std(off) < 1.4 and abs(np.mean(off)) < 0.7
