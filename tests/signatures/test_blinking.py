"""Pixels that jump are counted, measured and told from others by their frames."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import special, stats

from cannoise_jax.signatures.blinking import blinking, blinking_map
from cannoise_jax.signatures.fields import helmert
from cannoise_jax.signatures.two_levels import EVEN, log_ratio_of_three, log_ratio_of_two
from tests.discovery.looks import SIGNATURES, white

SIZE, FRAMES, SIGMA = (128, 160), 10, 3.0
_RNG = np.random.default_rng


@pytest.mark.parametrize("levels", [2, 3])
@pytest.mark.parametrize("jump", [0.7, 3.0])
def test_likelihood_of_levels_is_the_sum_over_which_frames_are_high(levels, jump):
    """The lower level anywhere, by numbers."""
    frames, at = _RNG(0).standard_normal((5, 3)), np.linspace(-20, 20, 4001)

    def chance(states):
        high = sum(states)
        laws = [np.exp(special.betaln(a + high, a + 5 - high) - special.betaln(a, a)) for a in EVEN]
        return np.mean(laws) if levels == 2 else 3.0**-5

    for x, told in zip(
        frames.T, (log_ratio_of_two if levels == 2 else log_ratio_of_three)([frames], jump), strict=True
    ):

        def likelihood(states, x=x):
            off = x[:, None] - at - jump * np.array(states)[:, None]
            return np.exp(stats.norm.logpdf(off).sum(0)).sum()

        each = itertools.product(range(levels), repeat=5)
        ratio = sum(chance(s) * likelihood(s) for s in each) / likelihood((0,) * 5)
        assert told == pytest.approx(np.log(ratio), abs=1e-4)


def darks(seed, share, sizes, alter=lambda rng, frames: frames, of_three=0.0, between=0.3):
    """Three darks of pixels of which some jump, from frame to frame with a chance of their own, and each
    pixel's jump, DN; of_three: of these the share of three levels."""
    rng, out = _RNG([21, seed]), []
    jump = sizes(rng, SIZE) * (rng.random(SIZE) < share)
    change = np.clip(2 * between * rng.beta(2, 2, SIZE), 0.02, 0.9)
    three = rng.random(SIZE) < of_three
    for f in white(rng, kinds=("dark",) * 3, frames=FRAMES, size=SIZE, sigma=SIGMA):
        frames = alter(rng, rng.standard_normal((FRAMES, *SIZE)))
        state, third = rng.integers(0, 2, SIZE), rng.integers(0, 3, SIZE)
        for frame in frames:
            state = np.where(rng.random(SIZE) < change, 1 - state, state)
            third = np.where(rng.random(SIZE) < 1.5 * change, rng.integers(0, 3, SIZE), third)
            frame += jump / SIGMA * np.where(three, third, state)
        out.append(f._replace(contrasts=np.einsum("nt,tij->nij", helmert(FRAMES), frames).astype(np.float32)))
    return tuple(out), jump


def gamma(mean, shape):
    return lambda rng, size: mean * rng.gamma(shape, 1 / shape, size)


CASES = [
    pytest.param(0.006, gamma(7.0, 4), 0.0, marks=pytest.mark.slow),
    (0.006, gamma(15.0, 4), 0.4),
    (0.002, gamma(30.0, 1), 0.0),
    pytest.param(0.03, gamma(9.0, 7), 0.0, marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("share", "sizes", "of_three"), CASES)
def test_share_jump_and_strength_are_right_within_their_errors(share, sizes, of_three):
    off = []
    for seed in range(3):
        fields, jump = darks(seed, share, sizes, of_three=of_three)
        told = blinking(fields)
        truth = jump[jump > 0]
        off += [
            (told.share[0] - truth.size / jump.size) / told.share[1],
            (told.jump[0] - truth.mean()) / told.jump[1],
        ]
        if not of_three:
            rms = np.sqrt(np.sum(truth**2) / 4 / jump.size)
            assert 0.8 * rms < told.rms[0] < 1.05 * rms
    assert np.max(np.abs(off)) < 3.0 and np.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.parametrize(("share", "sizes", "of_three"), CASES)
def test_listed_pixels_jump_and_by_as_much(share, sizes, of_three):
    fields, jump = darks(7, share, sizes, of_three=of_three)
    half = blinking_map(fields)
    listed = half > 0
    assert np.mean(jump[listed] > 0) > 0.85
    assert np.mean(listed[jump > 4.5 * SIGMA]) > 0.75
    # One of three levels is as noisy as one of two that are farther apart.
    more = np.sqrt(1 - of_three + of_three * 8 / 3)
    assert np.mean(2 * half[listed]) == pytest.approx(more * np.mean(jump[listed]), rel=0.2)


def hit(rng, frames):
    return frames + (rng.random(frames.shape) < 1e-4) * rng.exponential(20.0, frames.shape)


def test_pixels_that_were_hit_and_noisier_ones_are_no_jumping_ones():
    fields, jump = darks(3, 0.006, gamma(15.0, 4), hit)
    told, listed = blinking(fields), blinking_map(fields) > 0
    assert abs(told.share[0] - np.mean(jump > 0)) < 2.5 * told.share[1]
    assert np.mean(jump[listed] > 0) > 0.85
    louder = np.where(_RNG(5).random(SIZE) < 0.01, 3.0, 1.0)
    fields, _ = darks(4, 0.0, gamma(15.0, 4), lambda rng, frames: louder * frames)
    assert blinking(fields).share[0] < 0.002
    assert np.count_nonzero(blinking_map(fields)) < 0.2 * np.count_nonzero(louder > 1)


def test_the_signature_says_what_the_frames_do():
    fields, jump = darks(2, 0.006, gamma(15.0, 4))
    look = SIGNATURES["telegraph"]
    score = look.score(fields)
    assert score.log_p < -50
    value, _, error = score.parameters["fraction"]
    assert abs(value - np.mean(jump > 0)) < 2 * error
    sites = look.pattern(fields, score, _RNG(0))
    assert np.array_equal(sites, blinking_map(fields))


def test_other_frames_show_the_jumps_again_and_none_where_there_are_none():
    look = SIGNATURES["telegraph"]
    found = look.score(darks(2, 0.006, gamma(15.0, 4))[0])
    again = look.score_again(
        darks(2, 0.006, gamma(15.0, 4), lambda rng, frames: frames[::-1] + 0.0)[0], found
    )
    assert again.gain > 100 and again.amplitude == pytest.approx(found.amplitude, rel=0.15)
    for law in (lambda rng, frames: frames, hit):
        none = look.score_again(darks(9, 0.0, gamma(15.0, 4), law)[0], found)
        assert none.gain < 0 and none.amplitude < 0.3 * found.amplitude
