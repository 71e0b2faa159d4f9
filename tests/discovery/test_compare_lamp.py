"""Flicker far above the noise is taken out of what is compared, on both sides or on none."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.compare.lamp import steadied, without_wave
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.table import differences
from cannoise_jax.discovery.compare.view import reduce
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, BLACK, WHITE, FRAMES = (96, 128), 200.0, 16383.0, 6
LIGHT = 9000 * (
    1 - 0.2 * np.linspace(-1, 1, SIZE[1])[None] ** 2 - 0.1 * np.linspace(-1, 1, SIZE[0])[:, None] ** 2
)


def waves(rng, strength, frames=FRAMES, blotch=0.0):
    """Flats under a lamp; blotch: a fixed pattern of blocks, as a fraction of the signal."""
    rows = np.arange(SIZE[0])[:, None]
    out = []
    blocks = np.kron(np.random.default_rng(1).standard_normal((24, 32)), np.ones((4, 4)))
    for _ in range(frames):
        wave = 1 + strength * np.cos(2 * np.pi * (rows / 31.0 + rng.random()))
        light = LIGHT * wave * (1 + blotch * blocks)
        out.append(BLACK + 2.0 * rng.poisson(light / 2.0) + 5 * rng.standard_normal(SIZE))
    return np.rint(np.clip(out, 0, WHITE)).astype(np.uint16)


def reduced(frames):
    return reduce(frames, WHITE, False, 1.0)


def test_what_is_left_is_the_noise_of_pixels_and_the_light():
    rng = np.random.default_rng(0)
    real, other, still = (reduced(waves(rng, s)) for s in (0.2, 0.2, 0.0))
    a, (b,) = steadied(real, [other], LIGHT + BLACK, (BLACK,) * 4)
    for raw in (a, b):
        expected = 2.0 * LIGHT + 25
        level = np.einsum("nij,ij->n", raw.contrasts, LIGHT) / np.sum(LIGHT**2)  # of a frame, which stays
        rest = raw.contrasts - level[:, None, None] * LIGHT
        assert np.mean(rest**2 / expected) == pytest.approx(1.0, rel=0.03)
    smooth = without_wave(real.mean, real.contrasts, (BLACK,) * 4) - BLACK
    np.testing.assert_allclose(smooth[::2, ::2] / LIGHT[::2, ::2], 1.0, atol=0.08)
    assert np.std(smooth[::2, ::2] / LIGHT[::2, ::2]) < 0.03
    np.testing.assert_array_equal(without_wave(still.mean, still.contrasts, (BLACK,) * 4), still.mean)


def test_a_simulator_that_does_not_flicker_is_seen_to_lack_it():
    rng = np.random.default_rng(2)
    real, still = reduced(waves(rng, 0.2)), reduced(waves(rng, 0.0))
    a, (b,) = steadied(real, [still], LIGHT + BLACK, (BLACK,) * 4)
    assert a is real and b is still


def test_differences_behind_a_lamp_are_seen_and_nothing_else():
    def capture(seed, blotch):
        frames = waves(np.random.default_rng(seed), 0.2, 8, blotch)
        return CaptureSet(
            "c", (Recording(frames, "MONO", (BLACK,) * 4, WHITE, kind="flat", exposure_s=0.01),)
        )

    def simulator(rng_key, clean, settings):
        rng = np.random.default_rng(int(jax.random.randint(rng_key, (), 0, 2**31 - 1)))
        wave = 1 + 0.2 * np.cos(
            2 * np.pi * (np.arange(SIZE[0])[:, None] / 31.0 + rng.random((settings.frames, 1, 1)))
        )
        light = np.asarray(clean) * (WHITE - BLACK) * wave
        return np.rint(
            np.clip(BLACK + 2.0 * rng.poisson(light / 2.0) + 5 * rng.standard_normal(light.shape), 0, WHITE)
        ).astype(np.uint16)

    key = jax.random.key(0)
    plain, blotched = (differences(compare_bank(capture(5, b), simulator, key)) for b in (0.0, 0.002))
    assert not plain, [d.what for d in plain]
    assert any("block" in d.what for d in blotched)
