"""Pixels that jump are told from pixels that have a read noise of their own, whatever its law."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures.fields import helmert
from tests.discovery.looks import SIGNATURES, white

SIZE, FRAMES, SIGMA = (96, 128), 16, 3.0
LOOK = SIGNATURES["telegraph_beside"]
_RNG = np.random.default_rng


def unit_of(seed):
    """What stays of a camera unit `[H, W]`: a map of the noise, a number that chooses pixels, their share of
    the time in the higher level, and their jump."""
    rng = _RNG([12, seed])
    return (
        rng.standard_normal(SIZE),
        rng.random(SIZE),
        rng.uniform(0.15, 0.85, SIZE),
        rng.gamma(4, 0.25, SIZE),
    )


def darks(seed, alter):
    """Darks whose frames `[T, H, W]` of white noise are altered so, by what stays of a camera unit."""
    rng, out = _RNG([11, seed]), []
    for f in white(rng, kinds=("dark",) * 3, frames=FRAMES, size=SIZE, sigma=SIGMA):
        frames = alter(rng, *unit_of(seed))
        contrasts = np.einsum("nt,tij->nij", helmert(FRAMES), frames).astype(np.float32)
        out.append(f._replace(contrasts=contrasts))
    return tuple(out)


def normal(rng, map_of, *_):
    return np.exp(0.35 * map_of) * rng.standard_normal((FRAMES, *SIZE))


def long_tails(rng, map_of, *_):
    return np.exp(0.35 * map_of) * rng.standard_t(5, (FRAMES, *SIZE))


def hit(rng, map_of, *_):
    return normal(rng, map_of) + 30.0 * (rng.random((FRAMES, *SIZE)) < 3e-4)


@pytest.mark.parametrize("law", [normal, long_tails, hit])
def test_noise_of_each_pixels_own_makes_no_jumps(law):
    chances = np.exp([LOOK.score(darks(seed, law)).log_p for seed in range(4)])
    assert min(chances) > 1e-3 and np.exp(np.mean(np.log(chances))) > 0.1


def jumping(rng, map_of, chosen, high, jump, share=0.01):
    frames = normal(rng, map_of)
    return frames + 4.0 * jump * (chosen < share) * (rng.random(frames.shape) < high)


def test_jumps_are_found_with_their_size_and_places():
    fields = darks(1, jumping)
    found = LOOK.score(fields)
    _, chosen, high, jump = unit_of(1)
    true = chosen < 0.01
    variance = true * (4.0 * SIGMA * jump) ** 2 * high * (1 - high)
    assert found.log_p < -12
    assert found.amplitude == pytest.approx(np.sqrt(variance.mean()), rel=0.25)
    sites = LOOK.pattern(fields, found, _RNG(0)) > 0
    assert np.mean(true[sites]) > 0.85 and np.mean(sites[true]) > 0.35
    left = LOOK.score(LOOK.absorb(fields, found))
    assert left.log_p > np.log(1e-4)


@pytest.mark.parametrize("seeds", [1, pytest.param(3, marks=pytest.mark.slow)])
def test_other_frames_confirm_jumps_and_no_noise_of_each_pixels_own(seeds):
    """Pixels that were chosen for how their frames lie, or by chance, on frames that had no part in it."""
    found = LOOK.score(darks(1, jumping))

    def others(law, seed=1):
        """Of the same camera unit."""
        rng = _RNG([13, seed])
        return tuple(
            f._replace(
                contrasts=np.einsum("nt,tij->nij", helmert(FRAMES), law(rng, *unit_of(1))).astype(np.float32)
            )
            for f in white(rng, kinds=("dark",) * 3, frames=FRAMES, size=SIZE, sigma=SIGMA)
        )

    again = LOOK.score_again(others(jumping), found)
    assert again.gain > 20 and again.log_p < -20
    assert again.amplitude == pytest.approx(found.amplitude, rel=0.25)
    chances = []
    for law in (normal, long_tails, hit):
        for seed in range(seeds):
            none = LOOK.score_again(others(law, seed), found)
            assert none.gain < 3
            chances.append(np.exp(none.log_p))
    assert min(chances) > 1e-3
