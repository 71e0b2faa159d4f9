"""A glow grows with the exposure and is no region that another amplifier reads."""

import dataclasses

import numpy as np
import pytest

from cannoise_jax.mechanisms.coverage import assumed_baseline
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.estimators.glow import amp_glow
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Recording


def darks(seed, size=(96, 128), gain=1.2, ratio=1.04, regions=(1, 2), rate=1.0, seconds=(1.0, 100.0),
          step=0.0, glow=0.0, hot=0.0, tilt=0.0):  # fmt: skip
    """Darks of regions whose gain grows by `ratio` and whose black level by `step` from one to the next, with
    a glow of so many e-/s in a corner. hot: share of the pixels that are 20 to 200 times as warm. tilt: by
    how much the dark current of the last row exceeds that of the first, e-/s."""
    rng = np.random.default_rng(seed)
    number = sum(
        np.arange(n).reshape(shape) * count // n
        for n, count, shape in zip(size, regions, ((-1, 1), (1, -1)), strict=True)
    )
    own, black = gain * ratio**number, 200 + step * number
    away = np.hypot.outer(np.arange(size[0]), np.arange(size[1])) / max(size)
    rate = rate + tilt * np.linspace(0, 1, size[0])[:, None] * np.ones(size)
    rate = np.where(rng.random(size) < hot, rate * rng.uniform(20, 200, size), rate)
    out = []
    for t in seconds:
        e = rng.poisson((rate + glow * np.exp(-away / 0.2)) * t, (6, *size))
        frames = np.rint(black + own * (e + 4 * rng.standard_normal(e.shape))).clip(0)
        out.append(
            Recording(frames.astype(np.uint16), "MONO", (200,) * 4, 65535.0, kind="dark", exposure_s=t)
        )
    mean = np.full(4, own.mean())
    base = dataclasses.replace(assumed_baseline(), gain=mean, read_noise=4 * mean)
    return amp_glow([frame_statistics(r) for r in out], base)


@pytest.mark.parametrize("regions", [(1, 2), (2, 1), (2, 2), (1, 4)])
@pytest.mark.parametrize(("size", "ratio", "rate"), [((96, 128), 1.04, 1.0), ((80, 200), 0.9, 5.0)])
def test_amplifiers_of_unlike_gain_are_no_glow(regions, size, ratio, rate):
    for seed in range(3):
        found = darks(seed, size, ratio=ratio, regions=regions, rate=rate, step=5.0)
        assert found["e_per_s"].chance > BY_CHANCE


@pytest.mark.parametrize("ratio", [1.0, 1.04, 1.1])
def test_a_glow_is_found_beside_them(ratio):
    found = darks(4, ratio=ratio, glow=3.0)
    assert found["e_per_s"].chance < BY_CHANCE
    assert found["e_per_s"].value == pytest.approx(3.0, rel=0.15)
    assert found["length"].value == pytest.approx(0.2, rel=0.15)


def test_a_few_hot_pixels_are_no_glow_and_hide_none():
    for seed in range(8):
        found = darks(seed, ratio=1.0, rate=3.0, seconds=(0.01, 10.0), hot=5e-4)
        assert found["e_per_s"].chance > BY_CHANCE
    found = darks(4, ratio=1.0, rate=3.0, seconds=(0.01, 10.0), glow=20.0, hot=5e-4)
    assert found["e_per_s"].value == pytest.approx(20.0, rel=0.15)
    assert found["length"].value == pytest.approx(0.2, rel=0.15)


def test_one_exposure_shows_none():
    assert isinstance(darks(5, seconds=(60.0,), step=5.0), NotMeasurable)
    assert isinstance(darks(5, seconds=(60.0, 100.0), step=5.0), NotMeasurable)
    assert not isinstance(darks(5, seconds=(30.0, 100.0)), NotMeasurable)


def test_dark_current_that_grows_from_side_to_side_is_no_glow():
    for seed in range(4):
        found = darks(seed, ratio=1.0, rate=1.0, seconds=(1.0, 60.0), tilt=2.0, hot=5e-4)
        assert isinstance(found, NotMeasurable) and found.answered
        change = float(found.record.partition(" by ")[2].split()[0])
        assert change == pytest.approx(2.0, rel=0.05) and "no place glows" in found.record
    found = darks(4, ratio=1.0, rate=1.0, glow=3.0, tilt=0.5)
    assert found["e_per_s"].value == pytest.approx(3.0, rel=0.2)
    found = darks(4, ratio=1.0)
    assert not isinstance(found, NotMeasurable) and found["e_per_s"].chance > BY_CHANCE
