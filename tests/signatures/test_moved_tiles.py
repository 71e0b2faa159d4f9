"""A pattern that repeats within a frame and moves from frame to frame, against what is new in every frame and
does not repeat, or is a wave."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.signatures.moved_tiles import moved_absorb, moved_again, moved_score, moving
from tests.signatures.test_modulated import COLUMNS, FRAMES, ROWS, SIZE, SMOOTH, fields


def rolled(rows, columns, rms):
    """One tile that starts anywhere in each frame."""
    one = rms * np.random.default_rng(8).standard_normal((rows, columns))

    def more(rng):
        start = rng.integers(0, 32, (2, FRAMES))
        return np.stack([one[(ROWS + y) % rows, (COLUMNS + x) % columns] for y, x in start.T])

    return more


def waves(*frequencies):
    def more(rng):
        out = np.zeros((FRAMES, *SIZE))
        for fy, fx in frequencies:
            phase = rng.random((FRAMES, 1, 1))
            out += np.sin(2 * np.pi * (fy * ROWS + fx * COLUMNS + phase))
        return out

    return more


NOTHING = {
    "nothing": lambda rng: 0.0,
    **SMOOTH,
    "alike": lambda rng: ndimage.gaussian_filter(3 * rng.standard_normal((FRAMES, *SIZE)), (0, 0.6, 0.6)),
    "rows by turns": lambda rng: 2 * rng.standard_normal((FRAMES, SIZE[0], 1)) * (1 - 2 * (COLUMNS % 2)),
    "tails": lambda rng: np.where(rng.random((FRAMES, *SIZE)) < 0.002, 60.0, 0.0),
    "a wave": waves((0.123, 0.211)),
    "a wave that a fold holds": waves((1 / 8, 1 / 6)),
    "harmonics": waves((1 / 16, 1 / 12), (2 / 16, 2 / 12), (3 / 16, 3 / 12)),
}


@pytest.mark.parametrize("form", NOTHING)
def test_what_does_not_repeat_or_is_a_wave_is_left_to_others(form):
    rng = np.random.default_rng(2)
    p = [np.exp(moved_score(fields(rng, NOTHING[form])).log_p) for _ in range(20)]
    for level in (0.1, 0.02):
        assert np.mean(np.array(p) < level) < level + 3 * np.sqrt(level * (1 - level) / 20)


@pytest.mark.parametrize("period", [(6, 10), (16, 12), (16, 16)])
def test_its_periods_and_strength_are_told_and_the_same_on_other_frames(period):
    rng = np.random.default_rng(3)
    more = rolled(*period, 0.3)
    one = fields(rng, more)
    score = moved_score(one)
    assert score.log_p < -30 and tuple(score.payload) == period
    assert score.amplitude == pytest.approx(0.3, rel=0.25)
    again = moved_again(fields(rng, more), score)
    assert abs(again.amplitude - score.amplitude) < 5 * np.hypot(again.error, score.error)
    assert moved_again(fields(rng, lambda r: 0.0), score).gain < 8
    assert moved_score(moved_absorb(one, score)).log_p > np.log(1e-3)


def test_its_kind_says_how_often_it_repeats():
    score = moved_score(fields(np.random.default_rng(4), rolled(6, 10, 0.4)))
    assert "every 6 rows and 10 columns" in moving(name="any", covers=(), before=()).kind(score)
