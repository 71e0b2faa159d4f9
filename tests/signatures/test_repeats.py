"""A pattern that repeats every few rows and columns, against all that has a form of its own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.signatures.repeats import repeat_absorb, repeat_again, repeat_score, staying
from tests.signatures.test_modulated import COLUMNS, FRAMES, ROWS, SIZE, fields

TURN = 1 - 2 * (np.indices(SIZE) % 2)


def tile(rng, rows, columns, rms):
    """Without a mean over rows or columns."""
    one = rng.standard_normal((rows, columns))
    one -= one.mean(0) + one.mean(1)[:, None] - one.mean()
    return (rms * one / one.std())[ROWS % rows, COLUMNS % columns]


def slanted(rng):
    fy, fx = rng.uniform(0.03, 0.45, 2)
    return np.sin(2 * np.pi * (fy * ROWS + fx * COLUMNS + rng.random()))


FORMS = {
    "nothing": lambda rng: 0.0,
    "rows": lambda rng: 2 * rng.standard_normal((SIZE[0], 1)),
    "columns by turns": lambda rng: 2 * rng.standard_normal((1, SIZE[1])) * TURN[0],
    "rows by turns": lambda rng: 2 * rng.standard_normal((SIZE[0], 1)) * TURN[1],
    "skewed pixels": lambda rng: rng.exponential(3.0, SIZE),
    "hot": lambda rng: np.where(rng.random(SIZE) < 0.01, rng.exponential(60.0, SIZE), 0.0),
    "alike": lambda rng: ndimage.gaussian_filter(3 * rng.standard_normal(SIZE), 0.5),
    "texture": lambda rng: ndimage.gaussian_filter(9 * rng.standard_normal(SIZE), 3),
    "wave": slanted,
    "areas": lambda rng: np.kron(rng.standard_normal((8, 12)), np.ones((8, 8))),
    "corner": lambda rng: 20 * np.exp(-np.hypot(ROWS, COLUMNS) / 25),
}


def darks(rng, pattern):
    return fields(rng, lambda r: np.broadcast_to(pattern, (FRAMES, *SIZE)))


@pytest.mark.parametrize(
    "form",
    [
        pytest.param(f, marks=() if f in ("nothing", "rows by turns", "hot", "texture") else pytest.mark.slow)
        for f in FORMS
    ],
)
def test_what_does_not_repeat_along_both_sides_is_left_to_others(form):
    rng = np.random.default_rng(2)
    p = [np.exp(repeat_score(darks(rng, FORMS[form](rng))).log_p) for _ in range(30)]
    for level in (0.1, 0.02):
        assert np.mean(np.array(p) < level) < level + 3 * np.sqrt(level * (1 - level) / 30)


@pytest.mark.parametrize("period", [(3, 5), (6, 10), (16, 12)])
def test_a_tile_is_measured_and_the_same_on_other_frames(period):
    rng = np.random.default_rng(3)
    pattern = tile(rng, *period, 0.2)
    one = darks(rng, pattern)
    score = repeat_score(one)
    assert score.log_p < -30 and score.payload.values.shape == period
    assert abs(score.amplitude - 0.2) < 4 * score.error
    assert np.corrcoef(score.payload.image(SIZE).ravel(), pattern.ravel())[0, 1] > 0.8
    again = repeat_again(darks(rng, pattern), score)
    assert abs(again.amplitude - score.amplitude) < 4 * np.hypot(again.error, score.error)
    assert repeat_again(darks(rng, 0.0), score).gain < 8
    left = repeat_absorb(one, score)
    assert repeat_score(left).log_p == 0
    assert np.sum(left[0].static ** 2) < np.sum(one[0].static ** 2) - 0.8 * FRAMES * np.sum(pattern**2)


def test_its_kind_says_how_often_it_repeats():
    score = repeat_score(darks(np.random.default_rng(4), tile(np.random.default_rng(5), 6, 10, 0.3)))
    assert "every 6 rows and 10 columns" in staying(name="any", covers=(), before=()).kind(score)
