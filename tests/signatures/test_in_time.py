"""Something of one frame in another is told from noise that is redrawn, whatever that looks like."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.signatures.fields import helmert, refit
from tests.discovery.looks import SIGNATURES, white

SIZE, FRAMES = (64, 96), 8
_RNG = np.random.default_rng
PATTERN, LOUD, JUMPS = _RNG(1).standard_normal(SIZE), _RNG(2).standard_normal(SIZE), _RNG(3).random(SIZE)
KEPT = SIGNATURES["kept_in_time"]


def darks(alter, seed, count=3):
    """Darks whose frames `[T, H, W]` of white noise are altered so."""
    rng, out = _RNG([7, seed]), []
    for f in white(rng, kinds=("dark",) * count, frames=FRAMES, size=SIZE):
        frames = alter(rng.standard_normal((FRAMES, *SIZE)), rng)
        contrasts = np.einsum("nt,tij->nij", helmert(FRAMES), frames).astype(np.float32)
        out.append(f._replace(contrasts=contrasts))
    return refit(tuple(out))


def clouds(x, rng):
    smooth = ndimage.gaussian_filter(rng.standard_normal(x.shape), (0, 4, 4), mode="wrap")
    return x + 0.3 * smooth / smooth.std()


REDRAWN = {
    "nothing": lambda x, rng: x,
    "clouds": clouds,
    "loud pixels": lambda x, rng: x * np.exp(0.3 * LOUD),
    "pixels that jump": lambda x, rng: x + (JUMPS < 0.01) * 6.0 * (rng.random(x.shape) < 0.3),
    "lines": lambda x, rng: x + rng.standard_normal((FRAMES, SIZE[0], 1)) + rng.standard_normal(SIZE[1]),
    "loud frames": lambda x, rng: x * np.linspace(0.5, 1.5, FRAMES)[:, None, None],
    "hits": lambda x, rng: x + 30.0 * (rng.random(x.shape) < 3e-4),
}


@pytest.mark.parametrize("kind", REDRAWN)
def test_noise_that_is_redrawn_keeps_nothing(kind):
    chances = np.exp([KEPT.score(darks(REDRAWN[kind], seed)).log_p for seed in range(12)])
    assert min(chances) > 1e-3 and np.mean(chances < 0.1) < 0.4


def dying(x, rng):
    return x + 0.8 * np.exp(-np.arange(FRAMES) / 2.0)[:, None, None] * PATTERN


def wandering(x, rng):
    walk = np.zeros(SIZE)
    for frame in x:
        walk = 0.6 * walk + 0.4 * rng.standard_normal(SIZE)
        frame += walk
    return x


@pytest.mark.parametrize("alter", [dying, wandering])
def test_what_is_kept_is_found_and_taken_out(alter):
    fields = darks(alter, 1)
    found = KEPT.score(fields)
    assert found.log_p < -15 and found.amplitude > 0.15
    left = refit(KEPT.absorb(fields, found), fields)
    assert KEPT.score(left).log_p > np.log(1e-2)
    assert np.mean([np.mean(f.contrasts**2) for f in left]) == pytest.approx(1.0, abs=0.02)


def test_a_memory_says_so():
    value, _, error = KEPT.score(darks(wandering, 2)).parameters["next_frame"]
    assert value > 3 * error
    assert "frame before" in KEPT.kind(KEPT.score(darks(wandering, 2)))
