"""Frames of another temporal noise than the rest are told, and honest recordings are left alone."""

import numpy as np
import pytest

from cannoise_jax.recordings.one_noise import apart
from cannoise_jax.recordings.own_average import own_averages
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording
from cannoise_jax.recordings.usable import of_several_noises, usable

SIZE = (128, 160)


def frames(seed, count, gain=0.8, electrons=0.0, read_e=4.0, pattern=None, light=None):
    """DN of a camera with black 200: shot and read noise, a pattern of gains, a light for every frame."""
    rng = np.random.default_rng(seed)
    mean = electrons * (np.ones(SIZE) if pattern is None else pattern)
    light = np.ones(count) if light is None else np.asarray(light)
    e = rng.poisson(mean * light[:, None, None]) + read_e * rng.standard_normal((count, *SIZE))
    return np.rint(200 + gain * e)


def recording(frames_, kind="dark", **more):
    return Recording(frames_.astype(np.uint16), "MONO", (200,) * 4, 4095.0, kind=kind, path="x.h5", **more)


@pytest.mark.parametrize(("kind", "electrons"), [("dark", 0.0), ("flat", 2000.0)])
@pytest.mark.parametrize("averaged", [4, 20])
def test_an_average_among_single_frames_is_left_out(kind, electrons, averaged):
    own = frames(0, 6, electrons=electrons)
    own[3] = np.rint(frames(1, averaged, electrons=electrons).mean(0))
    kept, lines = usable(CaptureSet("c", (recording(own, kind),)))
    assert kept.recordings[0].count == 5
    assert lines[0].startswith("x.h5: frame 4 has 0.") and "an average, or another gain setting" in lines[0]


def test_a_file_is_named_where_every_frame_has_one():
    own = frames(0, 6)
    own[0], own[1] = 300, frames(1, 1, gain=3.0)[0]
    given = recording(own, sources=tuple(f"/data/d/{k}.fits" for k in range(6)))
    kept, lines = usable(CaptureSet("c", (given,)))
    assert kept.recordings[0].sources == given.sources[2:]
    assert "frame 2 (1.fits) has 3." in lines[1] and "of the other 4 (2.fits ...)" in lines[1]


def test_darks_that_light_reached_are_named_as_what_they_are():
    own = frames(0, 8)
    own[1::2] = frames(1, 4, electrons=400.0)
    with pytest.raises(BadInput, match=r"light reached them \(they are brighter too\), or another gain"):
        usable(CaptureSet("c", (recording(own),)))


@pytest.mark.parametrize(("low", "high"), [(4, 4), (2, 4), (1, 2)])
def test_two_gain_settings_of_which_none_is_the_rule_are_refused(low, high):
    both = np.concatenate([frames(0, low, gain=0.4), frames(1, high, gain=1.6)])
    with pytest.raises(BadInput, match=r"temporal noise.*another gain setting.*--leave-out") as refused:
        usable(CaptureSet("c", (recording(both),)))
    assert "\n" not in str(refused.value)
    assert "temporal noise" in of_several_noises(recording(both))


@pytest.mark.parametrize(("kind", "black"), [("dark", 60), ("dark", -120), ("bias", 300)])
def test_two_gain_settings_whose_black_levels_are_apart_are_refused(kind, black):
    both = np.concatenate([frames(0, 4, gain=0.4), frames(1, 4, gain=1.6) + black])
    with pytest.raises(BadInput, match="another gain setting"):
        usable(CaptureSet("c", (recording(both, kind),)))


def test_a_dark_that_warms_up_is_one_setting():
    warm = np.stack([frames(k, 1, electrons=25.0 * k)[0] for k in range(1, 9)])
    assert apart(recording(warm)) is None


@pytest.mark.parametrize("count", [6, 24])
def test_the_last_frame_of_a_sensor_that_warms_up_is_no_light(count):
    current = 60 * np.exp(0.5 * np.random.default_rng(5).standard_normal(SIZE))
    warmer = 2 ** (np.linspace(0, 9, count) / 6.3)
    assert apart(recording(frames(6, count, gain=2.0, electrons=1.0, pattern=current, light=warmer))) is None


def test_lamps_rows_hits_hot_pixels_and_noise_below_a_code_are_no_other_noise():
    rng = np.random.default_rng(3)
    pattern = 1 + 0.03 * rng.standard_normal(SIZE)
    drift = frames(4, 6, electrons=2000.0, pattern=pattern, light=[0.5, 0.6, 0.7, 0.9, 1.0, 1.2])
    rows = frames(5, 6) + np.rint(20 * rng.standard_normal((6, SIZE[0], 1)))
    hit = frames(6, 6)
    hit[2][rng.random(SIZE) < 0.02] += 900
    warm = frames(7, 6, electrons=900.0, light=[0.4, 0.6, 0.8, 1.0, 1.3, 1.6])
    level = np.array([0.0, 0.1, 0.3, 0.5, 0.2, 0.4])[:, None, None]
    quiet = np.rint(200 + level + 0.15 * rng.standard_normal((6, *SIZE)))
    for own, kind in ((drift, "flat"), (rows, "dark"), (hit, "dark"), (warm, "dark"), (quiet, "dark")):
        assert apart(recording(own, kind)) is None


def test_scenes_and_pairs_are_not_judged():
    both = np.concatenate([frames(0, 3, gain=0.4), frames(1, 3, gain=1.6)])
    assert apart(recording(both, "scene")) is None
    assert apart(recording(both[[0, 3]])) is None


def test_frames_noisier_by_interference_stay_where_that_is_looked_for():
    disturbed = frames(0, 8)
    disturbed[[1, 4, 6]] = np.rint(200 + 2 * (frames(1, 3) - 200))
    capture = CaptureSet("c", (recording(disturbed),))
    kept, lines = usable(capture, unsteady=True)
    assert kept.recordings[0].count == 8 and not lines
    with pytest.raises(BadInput, match="temporal noise"):
        usable(capture)
    averaged = frames(3, 8)
    averaged[3] = np.rint(frames(2, 20).mean(0))
    kept, lines = usable(CaptureSet("c", (recording(averaged),)), unsteady=True)
    assert kept.recordings[0].count == 7 and "frame 4" in lines[0]


def test_a_pattern_of_changing_strength_is_no_noise_of_frames():
    own = frames(0, 6) + 500.0  # of light
    blocks = np.kron(np.indices((16, 20)).sum(0) % 2 - 0.5, np.ones((8, 8)))
    own += np.arange(6.0)[:, None, None] * 20 * np.roll(blocks, 1, 1)
    assert apart(recording(own, "flat")) is None


def combined(own, how="mean"):
    return np.rint(getattr(np, how)(own, 0))[None]


@pytest.mark.parametrize(("kind", "electrons"), [("bias", 0.0), ("flat", 2000.0), ("scene", 2000.0)])
@pytest.mark.parametrize("averaged", [2, 4, 6, 8, 10, 20])
def test_an_average_of_the_very_frames_beside_it_is_left_out(kind, electrons, averaged):
    rng = np.random.default_rng(9)
    drift = np.linspace(1, 1.15, averaged) * (1 + 0.003 * rng.standard_normal(averaged))
    own = frames(0, averaged, electrons=electrons, pattern=1 + 0.01 * rng.standard_normal(SIZE), light=drift)
    kept, lines = usable(CaptureSet("c", (recording(np.concatenate([own, combined(own)]), kind),)))
    assert kept.recordings[0].count == averaged
    assert lines[0].startswith(f"x.h5: frame {averaged + 1}: an average or median of the frames beside it")


@pytest.mark.parametrize("at", [0, 2, 6])
@pytest.mark.parametrize("how", ["mean", "median"])
def test_averages_are_told_wherever_they_lie_and_two_of_them(how, at):
    own = frames(1, 6)
    given = np.insert(own, at, combined(own, how)[0], axis=0)
    assert usable(CaptureSet("c", (recording(given),)))[0].recordings[0].count == 6
    assert of_several_noises(recording(given)).startswith(f"x.h5: frame {at + 1}: an average or median")
    both = np.concatenate([own, combined(own[:4]), combined(own[1:], "median")])
    assert np.array_equal(usable(CaptureSet("c", (recording(both),)))[0].recordings[0].frames, own)


def test_what_an_average_beside_its_frames_hid_is_left_out_too():
    own = frames(2, 8)
    own[2] = frames(3, 1, gain=2.4)[0]
    for average in (combined(own), combined(own[3:])):
        given = recording(np.concatenate([own, average]), "bias")
        kept, lines = usable(CaptureSet("c", (given,)))
        assert kept.recordings[0].count == 7 and "frame" in lines[0]


def test_a_frame_in_the_middle_of_patterns_that_change_is_no_average():
    blocks = np.kron(np.indices((16, 20)).sum(0) % 2 - 0.5, np.ones((8, 8)))
    patterns = np.stack([np.roll(blocks, shift, 1) for shift in range(2)])
    rng = np.random.default_rng(4)
    for seed in range(6):
        count = 3 + seed
        strength = 40 * rng.standard_normal((count, 2))
        strength[count // 2] = np.delete(strength, count // 2, 0).mean(0)
        own = np.rint(frames(seed, count) + 300 + np.einsum("tk,khw->thw", strength, patterns))
        assert own_averages(recording(own, "flat")) == ()


def test_a_frame_amid_others_that_lie_about_it_is_no_average():
    patterns = 300 * np.random.default_rng(6).standard_normal((2, *SIZE))
    strength = np.array([[0.0, 0.0], [1.0, 0.1], [-0.6, 0.7], [-0.4, -0.8]]) / 10
    own = frames(7, 4) + 300 + np.rint(np.einsum("tk,khw->thw", strength, patterns))
    assert own_averages(recording(own, "flat")) == ()
