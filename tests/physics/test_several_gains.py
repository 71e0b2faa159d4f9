"""Flats and darks of two gain settings that no file states are told; bent responses are not."""

import re

import numpy as np
import pytest

from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.several_gains import OF_TWO_OFFSETS, several_gains, uneven_gain
from cannoise_jax.recordings.recording import Recording


def setting(
    seed, gain, electrons, seconds, black=200.0, count=4, read=4.0, rate=0.0, loss=0.0, size=(64, 96)
):
    """Statistics of a flat and of a dark; loss: share of the signal that is missing at 4095."""
    rng = np.random.default_rng(seed)
    out = []
    for kind, level in (("flat", electrons), ("dark", 0.0)):
        e = rng.poisson(level + rate * seconds, (count, *size)) + read * rng.standard_normal((count, *size))
        linear = gain * e
        frames = np.rint(black + linear * (1 - loss * linear / 4095)).clip(0, 4095).astype(np.uint16)
        path = f"{kind}_{seconds:g}s.h5"
        own = Recording(frames, "MONO", (200.0,) * 4, 4095.0, kind=kind, exposure_s=seconds, path=path)
        out.append(frame_statistics(own))
    return out


@pytest.mark.parametrize(
    ("low", "high", "count", "bright"), [(0.4, 1.6, 4, 900), (0.5, 0.9, 4, 2500), (0.3, 0.6, 2, 3500)]
)
def test_two_settings_are_told_and_named(low, high, count, bright):
    both = setting(1, low, bright, 1.0, 200.0, count) + setting(2, high, bright, 4.0, 260.0, count)
    said = several_gains(both)
    told = [float(v) for v in re.findall(r"5: (?:a gain of )?([\d.]+)", said.replace(".h5", "5"))]
    assert told == pytest.approx([low, high], rel=0.1)
    assert said.startswith("flat_1s.h5: a gain of") and "flat_4s.h5" in said
    assert "two gain settings" in said and "\n" not in said


def test_a_dim_flat_of_a_high_gain_is_told_too():
    said = several_gains(setting(1, 0.3, 7000, 1.0) + setting(2, 3.0, 300, 4.0, 260.0))
    assert said.startswith("flat_1s.h5: a gain of 0.29 DN/e-; flat_4s.h5: 3")


@pytest.mark.parametrize(
    "more", [{}, {"rate": 60.0}, {"loss": 0.15}, {"count": 2}, {"read": 30.0}, {"black": 240.0}]
)
def test_one_setting_is_one(more):
    series = [setting(k, 0.5, 1200 * t, t, **more) for k, t in enumerate((0.1, 0.5, 1.0, 2.0, 4.0))]
    assert several_gains([s for pair in series for s in pair]) == ""


def test_without_a_dark_or_a_second_flat_nothing_is_said():
    flat, dark = setting(1, 0.5, 2000, 1.0)
    assert several_gains([flat]) == several_gains([dark]) == several_gains([flat, dark]) == ""


def test_gains_that_fall_steadily_may_be_a_tone_curve():
    """Codes of a power of two thirds of the light: the gain of a level falls with its cube root."""
    series = []
    for k, level in enumerate((150, 1200, 8000)):
        rng = np.random.default_rng(k)
        for kind, electrons in (("flat", level), ("dark", 0)):
            e = rng.poisson(electrons, (8, 64, 96)) + 2 * rng.standard_normal((8, 64, 96))
            codes = np.rint(20 + 6 * np.maximum(e + 40, 0) ** (2 / 3)).astype(np.uint16)
            own = Recording(
                codes, "MONO", (90.0,) * 4, 4095.0, kind=kind, exposure_s=1.0 + k, path=f"{kind}_{k}.h5"
            )
            series.append(frame_statistics(own))
    said = several_gains(series)
    assert "tone curve" in said and "\n" not in said
    assert "tone curve" not in several_gains(setting(1, 0.4, 900, 1.0) + setting(2, 1.6, 900, 4.0, 260.0))


def test_two_settings_in_one_file_are_to_be_split():
    both = setting(1, 0.4, 900, 1.0) + setting(2, 1.6, 900, 1.0, 260.0)
    said = several_gains(both)
    assert "split the file" in said and "folder" not in said


def flats_of(offset, loss=0.0):
    """Flats of four levels at another black level than their dark, 4 DN of noise."""
    both = [setting(k, 0.5, e, t, 200.0 + offset, 8, loss=loss) for k, (e, t) in enumerate(LEVELS)]
    (_, dark) = setting(9, 0.5, 100, 1.0, 200.0, 8)
    return [flat for flat, _ in both] + [dark]


LEVELS = ((600, 1.0), (1500, 2.0), (3000, 4.0), (5000, 8.0))


@pytest.mark.parametrize("offset", [150.0, -100.0])
def test_flats_of_another_offset_than_the_darks_are_told(offset):
    said = uneven_gain(flats_of(offset), 0)
    assert said.endswith(OF_TWO_OFFSETS)
    gain, away, side = re.search(r"of ([\d.]+) DN/e- which .* (\d+) DN (above|below) their", said).groups()
    assert float(gain) == pytest.approx(0.5, rel=0.04)
    assert float(away) == pytest.approx(abs(offset), rel=0.15) and (side == "above") == (offset > 0)


@pytest.mark.parametrize("loss", [0.0, 0.2])
def test_flats_of_the_offset_of_the_darks_are_not(loss):
    assert not uneven_gain(flats_of(0.0, loss), 0).endswith(OF_TWO_OFFSETS)


@pytest.mark.parametrize("white", [4095.0, 700.0])
@pytest.mark.parametrize("power", [0.5, 1 / 2.2])
def test_codes_of_a_square_root_are_a_tone_curve_whatever_is_white(white, power):
    series = []
    for k, (kind, electrons) in enumerate((("flat", 8000), ("flat", 16000), ("flat", 24000), ("bias", 0))):
        rng = np.random.default_rng(k)
        signal = 500 + 0.5 * (rng.poisson(electrons, (6, 64, 96)) + 6 * rng.standard_normal((6, 64, 96)))
        codes = np.rint(700 * (signal / 13200) ** power).astype(np.uint16)
        black = (700 * (500 / 13200) ** power,) * 4
        series.append(
            frame_statistics(Recording(codes, "MONO", black, white, kind=kind, exposure_s=float(1 + k)))
        )
    said = several_gains(series)
    assert "tone curve" in said and "record raw data" in said


def test_pixels_that_fill_up_are_no_tone_curve():
    series = []
    for k, electrons in enumerate((4000, 9000, 16000, 22000, 24000)):
        rng = np.random.default_rng(k)
        well = 25000 * (1 + 0.02 * rng.standard_normal((64, 96)))
        charge = np.minimum(rng.poisson(electrons, (6, 64, 96)), well)
        codes = np.rint(500 + 0.5 * (charge + 6 * rng.standard_normal(charge.shape))).astype(np.uint16)
        series.append(frame_statistics(Recording(codes, "MONO", (500.0,) * 4, 16383.0, kind="flat")))
    dark = np.rint(500 + 3 * np.random.default_rng(9).standard_normal((6, 64, 96))).astype(np.uint16)
    series.append(frame_statistics(Recording(dark, "MONO", (500.0,) * 4, 16383.0, kind="bias")))
    assert "tone curve" not in several_gains(series)
