"""Maps whose neighbours are alike are drawn as alike as they are, and as strong."""

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.signatures.added import draw_pixels
from cannoise_jax.signatures.coloured import spectrum_of

SIZE, NOISE = (160, 192), 1.5


def lag(values, dy, dx):
    h, w = values.shape
    return float(np.mean(values[: h - dy, : w - dx] * values[dy:, dx:]) / np.mean(values**2))


def coloured(rng, kernel):
    drawn = ndimage.convolve(rng.standard_normal(SIZE), kernel, mode="wrap")
    return drawn / drawn.std()


@pytest.mark.parametrize(
    "kernel", [[[-0.3], [1.0], [0.0]], [[0.1, 0.2, 0.1], [0.2, 1.0, 0.2], [0.1, 0.2, 0.1]]]
)
def test_what_is_drawn_has_the_map_its_strength_and_its_neighbours(kernel):
    rng = np.random.default_rng(0)
    truth = coloured(rng, np.array(kernel))
    score = (truth + np.sqrt(NOISE) * rng.standard_normal(SIZE)) / NOISE
    drawn = draw_pixels(score, np.full(SIZE, 1 / NOISE), 1.0, rng)
    assert drawn.var() == pytest.approx(1.0, abs=0.05)
    for at in ((1, 0), (0, 1), (1, 1)):
        assert lag(drawn, *at) == pytest.approx(lag(truth, *at), abs=0.05), at
    known = 1 / (1 + NOISE)  # of a white map so much of the variance is known
    assert np.corrcoef(drawn.ravel(), truth.ravel())[0, 1] > known - 0.01


def test_far_pixels_stay_where_they_are_and_leave_no_ghosts():
    rng = np.random.default_rng(1)
    truth = coloured(rng, np.array([[-0.3], [1.0], [0.0]]))
    truth[40, 50] = 200.0
    score = truth + rng.standard_normal(SIZE)
    drawn = draw_pixels(score, np.ones(SIZE), 1.0, rng)
    assert drawn[40, 50] == pytest.approx(100, abs=5)  # half of what is seen, as of any pixel
    assert np.abs(drawn[39:42, 49:52]).ravel()[[0, 1, 2, 3, 5, 6, 7, 8]].max() < 5


def test_white_maps_and_cells_have_no_spectrum():
    rng = np.random.default_rng(2)
    white = rng.standard_normal(SIZE)
    assert spectrum_of(white + rng.standard_normal(SIZE), 1.0, 1.0) is None
    cells = np.kron(rng.standard_normal((SIZE[0] // 2, SIZE[1] // 2)), np.ones((2, 2)))
    assert spectrum_of(cells + rng.standard_normal(SIZE), 1.0, 1.0) is None
