"""Frames that a camera averaged over time are refused; image lag, drift, patterns and odd frames are not."""

import numpy as np
import pytest

from cannoise_jax.recordings.over_time import check_single_exposures, shared_noise
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.usable import usable

SIZE = (96, 128)


def recursive(share):
    """y_t = share x_t + (1 - share) y_(t-1)."""

    def applied(frames):
        out = [frames[0]]
        for frame in frames[1:]:
            out.append(share * frame + (1 - share) * out[-1])
        return np.array(out)

    return applied


def running(count):
    """Means of each frame and those before it."""
    return lambda frames: np.array(
        [frames[max(k - count + 1, 0) : k + 1].mean(0) for k in range(len(frames))]
    )


def frames(seed, count, electrons=0.0, gain=0.8, read=4.0, lag=0.0, over=None, light=1.0, charge=None):
    """Frames of black 200, four earlier ones dropped; light: of every frame; charge: e- of every frame and
    pixel besides; lag: of the charge of the frame before; over: what the camera does to frames over time."""
    rng = np.random.default_rng(seed)
    pattern = 1 + 0.01 * rng.standard_normal(SIZE)
    level = electrons * pattern * np.broadcast_to(light, count + 4)[:, None, None]
    e = rng.poisson(level + (0 if charge is None else charge)).astype(float)
    e[1:] += lag * (e[:-1] - e[1:])
    e += read * rng.standard_normal(e.shape)
    whole = e if over is None else over(e)
    return np.clip(np.rint(200 + gain * whole[4:]), 0, 65535).astype(np.uint16)


def recording(own, kind):
    return Recording(own, "MONO", (200,) * 4, 65535.0, kind=kind, path=f"{kind}.h5")


def pair(count, electrons=9000.0, **more):
    """A dark and a flat."""
    return [recording(frames(k, count, k * electrons, **more), ("dark", "flat")[k]) for k in (0, 1)]


@pytest.mark.parametrize(
    "over", [recursive(0.1), recursive(0.3), recursive(0.6), recursive(0.8), running(2), running(3)]
)
@pytest.mark.parametrize(("count", "gain", "read"), [(4, 0.8, 4.0), (8, 0.2, 12.0), (20, 3.0, 2.0)])
def test_frames_averaged_over_time_are_refused(over, count, gain, read):
    with pytest.raises(BadInput, match="averaged over time: switch temporal noise reduction") as refused:
        usable(CaptureSet("c", tuple(pair(count, gain=gain, read=read, over=over))))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("only", [0, 1])
def test_either_kind_tells_alone_where_they_share_much(only):
    with pytest.raises(BadInput, match="averaged over time"):
        check_single_exposures(pair(8, over=recursive(0.6))[only : only + 1])


def test_three_frames_that_share_half_of_their_noise_are_told():
    with pytest.raises(BadInput, match="averaged over time"):
        check_single_exposures(pair(3, over=running(2)))


@pytest.mark.parametrize("count", [3, 4, 8, 16])
def test_honest_frames_are_left_alone(count):
    for seed in range(5):
        check_single_exposures(
            [recording(frames(seed, count), "dark"), recording(frames(seed, count, 900), "flat")]
        )


def test_image_lag_is_in_the_light_alone():
    check_single_exposures(pair(16, lag=0.3))
    check_single_exposures(pair(16, lag=0.1)[1:])


def test_drifts_patterns_and_noisy_pixels_are_not_shared_noise():
    rng = np.random.default_rng(5)
    hot = rng.exponential(300, SIZE) * (rng.random(SIZE) < 0.05) + 20
    warmer = np.linspace(1, 1.6, 16)[:, None, None] * hot
    rows = frames(1, 12) + np.rint(20 * np.cumsum(rng.standard_normal((12, SIZE[0], 1)), 0)).astype(int) + 500
    blinking = (rng.random((12, *SIZE)) < 0.5).cumsum(0) // 2 % 2 * (rng.random(SIZE) < 0.04)
    ghost = 60 * (rng.random(SIZE) < 0.5) * (np.arange(12) < 1)[:, None, None]
    for own, kind in (
        (frames(0, 12, charge=warmer), "dark"),
        (frames(0, 12, 20000.0, light=np.linspace(0.8, 1.2, 16)), "flat"),
        (rows, "dark"),
        (frames(2, 12) + 40 * blinking, "dark"),
        (frames(3, 12) + ghost, "dark"),
    ):
        found = shared_noise(recording(own.astype(np.uint16), kind))
        assert abs(found.correlation) < 0.04


def test_what_cannot_be_judged_is_not():
    averaged = frames(0, 8, over=recursive(0.3))
    assert shared_noise(recording(averaged, "scene")) is None
    assert shared_noise(recording(averaged[:2], "dark")) is None
    assert shared_noise(recording(averaged[:, :16, :16], "dark")) is None
    assert shared_noise(recording(frames(0, 8, read=0.1), "dark")) is None


def test_pixels_that_repeat_their_last_value_are_no_average():
    own = pair(8, gain=2.0)
    for r in own:
        kept = np.random.default_rng(5).random(r.frames.shape) < 0.3
        for t in range(1, r.count):
            r.frames[t][kept[t]] = r.frames[t - 1][kept[t]]
    assert usable(CaptureSet("c", tuple(own)))[1] == ()
