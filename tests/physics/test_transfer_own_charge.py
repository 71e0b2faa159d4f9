"""Dark charge in the only darks of a camera, made in plain NumPy: its shot noise is no read noise of pixels,
and no heavy tails, and where nothing tells how much it is a line says what to record."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.mechanisms.coverage import assumed_baseline
from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import normal_estimate
from cannoise_jax.physics.transfer.estimators.maps import pixel_read_noise_map
from cannoise_jax.physics.transfer.estimators.noise import heavy_tails, no_heavier, own_kurtosis
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Recording

SIZE, GAIN, READ_E, BLACK, FRAMES = (128, 160), 1.6, 3.0, 200.0, 8


def baseline() -> Baseline:
    four = np.ones(4)
    read = four * GAIN * READ_E
    return Baseline(
        gain=four * GAIN, read_noise=read, black_level=four * BLACK, gain_stderr=four * 1e-3,
        read_stderr=read / 1e3, white_level=65535.0, code_step=1.0,
    )  # fmt: skip


def dark(charge: float, spread: float = 0.0, seconds: float = 10.0, seed: int = 0, kind: str = "dark"):
    """Statistics of darks that hold so many electrons on average, log-normal over the pixels, and whose read
    noise has a spread over them."""
    rng = np.random.default_rng(seed)
    own = charge * np.exp(0.4 * rng.standard_normal(SIZE) - 0.08)
    width = np.sqrt(np.log1p(spread**2))
    read = READ_E * np.exp(width * rng.standard_normal(SIZE) - width**2 / 2)
    offsets = BLACK + 1.5 * rng.standard_normal(SIZE)
    values = rng.poisson(own, (FRAMES, *SIZE)) + read * rng.standard_normal((FRAMES, *SIZE))
    codes = np.rint(offsets + GAIN * values).astype(np.uint16)
    taken = Recording(codes, "MONO", (BLACK,) * 4, 65535.0, "made", kind, exposure_s=seconds)
    return frame_statistics(taken)


def flat(seconds: float = 10.0):
    rng = np.random.default_rng(9)
    codes = np.rint(BLACK + GAIN * rng.poisson(9000.0, (2, *SIZE))).astype(np.uint16)
    taken = Recording(codes, "MONO", (BLACK,) * 4, 65535.0, "made", "flat", exposure_s=seconds)
    return frame_statistics(taken)


@pytest.mark.parametrize("charge", (3.0, 10.0, 30.0))
def test_shot_noise_of_dark_charge_is_no_spread_of_read_noise(charge):
    found = pixel_read_noise_map([dark(charge)], baseline())["spread"]
    assert found.by_chance > 3e-4
    without = pixel_read_noise_map([dark(charge)])["spread"]  # where no gain tells how much it may be
    assert charge < 10 or without.value > 0.09


@pytest.mark.parametrize("charge", (0.0, 10.0))
def test_a_spread_of_read_noise_is_told_beside_dark_charge(charge):
    found = pixel_read_noise_map([dark(charge, spread=0.3)], baseline())["spread"]
    # Of the noise of a pixel in these frames: its read noise is a part of it.
    read, shot = READ_E**2 * (1 + 0.3**2), charge
    expected = 0.3 * read / (read + shot)
    assert found.value == pytest.approx(expected, rel=0.2)
    assert found.by_chance < 1e-6


def test_pixels_of_unlike_charge_have_no_heavy_tails():
    """Values of all pixels make tails that those of none have."""
    stats = [dark(40.0, seed=3)]
    tails = heavy_tails(stats, baseline())
    assert tails["tukey_lambda"].value < tukey_lambda.GAUSSIAN - 0.02
    assert abs(own_kurtosis(stats[0])) < 0.03
    assert no_heavier(tails, stats)


def test_tails_of_every_pixel_are_told_by_single_pixels():
    rng = np.random.default_rng(2)
    values = BLACK + 6 * rng.standard_t(6, (FRAMES, *SIZE)) / np.sqrt(1.5)
    codes = np.rint(values).clip(0).astype(np.uint16)
    taken = Recording(codes, "MONO", (BLACK,) * 4, 65535.0, "made", "dark", exposure_s=10.0)
    stats = [frame_statistics(taken)]
    tails = heavy_tails(stats, assumed_baseline())
    assert tails["tukey_lambda"].value < tukey_lambda.GAUSSIAN - 0.05
    assert no_heavier(tails, stats) == ""
    assert no_heavier({"tukey_lambda": normal_estimate(0.2, 0.01)}, stats)


def test_charge_in_darks_as_long_as_the_flats_is_said():
    for darks in ([dark(8.0)], [dark(8.0), dark(16.0, seconds=20.0)]):
        said = faults([flat(), *darks]).longer
        assert "10 s hold dark charge" in said and "record biases" in said


def test_nothing_is_said_where_no_charge_shows_or_biases_or_more_exposures_tell():
    assert faults([flat(), dark(0.0)]).longer == ""
    assert faults([flat(), dark(0.0, spread=0.3)]).longer == ""
    assert faults([flat(), dark(8.0), dark(0.0, seconds=0.0, kind="bias")]).longer == ""
    three = [dark(8.0 * k, seconds=10.0 * k) for k in (1, 2, 3)]
    assert faults([flat(), *three]).longer == ""
