"""A difference of the two greens beside frozen patterns, which scatter their levels too."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.light import green_score, looking_at

SIZE, GAIN, READ, BLACK = (48, 64), 0.8, 3.0, 200.0


def flat(rng: np.random.Generator, electrons: np.ndarray, number: int, frames: int = 4) -> Fields:
    """Frames of Poisson electrons and read noise."""
    codes = rng.poisson(electrons, (frames, *SIZE)) * GAIN + rng.normal(0, READ, (frames, *SIZE)) + BLACK
    sigma = np.full(SIZE, np.sqrt(electrons.mean() * GAIN**2 + READ**2), np.float32)
    mean = codes.mean(0).astype(np.float32)
    contrasts = np.einsum("nt,tij->nij", helmert(frames), codes / sigma).astype(np.float32)
    return Fields(
        name="flat", kind="flat", frames=frames, number=number, group=0, exposure_s=1.0, step=1.0, mean=mean,
        signal=mean - BLACK, sigma=sigma, shot=1 / sigma, usable=np.ones(SIZE, bool), contrasts=contrasts,
        static=(mean - mean.mean()) / sigma * np.sqrt(frames), clean=None, gain=np.full(4, BLACK),
        black=np.full(4, BLACK),
    )  # fmt: skip


def p_values(seed: int, sets: int, prnu: float = 0.0, lines: str = "", apart: float = 0.0) -> np.ndarray:
    """Of flats at two levels under light that falls off, of one camera each."""
    rng, (h, w) = np.random.default_rng(seed), SIZE
    y, x = np.indices(SIZE)
    light = 1 - 0.7 * ((y / h - 0.5) ** 2 + (x / w - 0.4) ** 2)
    light[0::2, 1::2] *= 1 + apart
    light[1::2, 0::2] *= 1 - apart
    shape = {"rows": (h, 1), "columns": (1, w)}.get(lines)
    out = []
    for _ in range(sets):
        response = 1 + prnu * rng.standard_normal(SIZE)
        if shape:
            response = response * (1 + 0.005 * rng.standard_normal(shape))
        flats = tuple(flat(rng, level * light * response, n) for n, level in enumerate((2000.0, 6000.0)))
        score = green_score(flats, look=looking_at((1, 2)), patterns=True)
        assert score is not None
        out.append(np.exp(score.log_p))
    return np.array(out)


@pytest.mark.parametrize(
    "pattern", [{}, {"prnu": 0.01}, {"lines": "rows"}, {"lines": "columns", "prnu": 0.01}]
)
def test_patterns_of_pixels_and_lines_are_no_difference_of_the_greens(pattern):
    p = p_values(3, 60, **pattern)
    assert np.mean(p < 0.1) < 0.25 and p.min() > 1e-4


def test_a_difference_shows_beside_sensitivities_of_single_pixels():
    """Of 0.8 %, where means of 768 pixels whose sensitivities differ by 1 % are known to 0.05 % of both."""
    assert p_values(4, 10, prnu=0.01, apart=0.004).max() < 1e-3
