"""Whether the noise of a dark differs between parts of the frame: pixels of two kinds are no amplifiers."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.regions import uneven_noise
from cannoise_jax.recordings.recording import Recording

SIZE, BLACK = (96, 128), 97.0


def dark(seed, change, count=12, read=2.2):
    rng = np.random.default_rng(seed)
    codes = np.rint(change(rng, BLACK + read * rng.standard_normal((count, *SIZE))))
    frames = codes.clip(0, 4095).astype(np.uint16)
    return frame_statistics(Recording(frames, "MONO", (BLACK,) * 4, 4095.0, "made", "dark", exposure_s=1.0))


def jumping(chance):
    """Codes near a multiple of 32 jump by 16: the variance of a pixel is that of no jump, or of one, two."""

    def change(rng, dn):
        near = np.abs((np.rint(dn) + 16) % 32 - 16) <= 1
        return dn + np.where(near & (rng.random(dn.shape) < chance), rng.choice((-16, 16), dn.shape), 0)

    return change


def at_even_odds(rng, dn):
    """Of the pixels half jump in no frame of twelve, so that the median is of either kind."""
    return dn + 20 * (rng.random(dn.shape) < 0.056)


@pytest.mark.parametrize("change", [*(jumping(p) for p in (0.08, 0.12, 0.2)), at_even_odds])
def test_pixels_of_two_kinds_all_over_the_frame_are_no_amplifiers(change):
    assert not any(uneven_noise(dark(seed, change)) for seed in range(4))


def test_a_share_of_jumps_that_leans_a_little_is_no_amplifier():
    """The medians go from one mode to the other along the frame, where the noise itself hardly changes."""
    chance = 0.056 * np.linspace(0.8, 1.2, SIZE[1])
    change = lambda rng, dn: dn + 20 * (rng.random(dn.shape) < chance)  # noqa: E731
    assert not any(uneven_noise(dark(seed, change)) for seed in range(4))


@pytest.mark.parametrize(("by", "count"), [(1.35, 12), (2.0, 2), (2.0, 4), (2.0, 12)])
def test_amplifiers_are_told_beside_pixels_that_jump(by, count):
    """Twice the variance nearly, as of the two amplifiers of one frame, and four times."""
    louder = np.where(np.arange(SIZE[1]) < SIZE[1] // 2, by, 1.0)
    jumps = jumping(0.05)
    several = lambda rng, dn: BLACK + louder * (jumps(rng, dn) - BLACK)  # noqa: E731
    plain = lambda rng, dn: BLACK + louder * (dn - BLACK)  # noqa: E731
    for change in (plain, several):
        assert all(uneven_noise(dark(seed, change, count, 6.0)) for seed in (0, 1))
    assert not uneven_noise(dark(0, lambda rng, dn: dn, count, 6.0))
