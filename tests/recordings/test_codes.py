import numpy as np
import pytest

from cannoise_jax.recordings.codes import (
    code_histogram,
    code_histograms,
    code_lattice,
    detect_code_step,
)
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import Recording


def lattice(codes):
    return code_lattice(code_histogram(codes))


def adc(rng, mean=300.0, sigma=6.0, size=(4, 64, 96)):
    return np.clip(np.rint(rng.normal(mean, sigma, size)), 0, 4095).astype(np.uint16)


@pytest.mark.parametrize("step", [1, 2, 3, 4, 16, 64])
@pytest.mark.parametrize("offset", [0, 5])
def test_step_of_shifted_codes(step, offset):
    rng = np.random.default_rng(step)
    assert detect_code_step(adc(rng) * step + offset) == step


@pytest.mark.parametrize("step", [1, 4, 16])
def test_every_eighth_code_missing_does_not_fool_it(step):
    codes = adc(np.random.default_rng(0), sigma=20)
    codes[codes % 8 == 3] += 1
    assert detect_code_step(codes * step) == step


@pytest.mark.parametrize("step", [1, 4, 16])
def test_sparse_tails_keep_the_step(step):
    rng = np.random.default_rng(1)
    codes = adc(rng, sigma=2)
    hot = rng.random(codes.shape) < 0.01
    codes[hot] += rng.integers(0, 3000, hot.sum()).astype(np.uint16)
    assert detect_code_step(codes * step) == step


@pytest.mark.parametrize("step", [1, 4, 16])
def test_narrow_noise_needs_only_a_few_codes(step):
    codes = adc(np.random.default_rng(2), mean=300.4, sigma=0.5)
    assert len(np.unique(codes)) < 8
    assert detect_code_step(codes * step) == step


def test_nearly_constant_frames_are_no_lattice_of_anything():
    codes = np.full((64, 64), 300, np.uint16)
    assert lattice(codes).outcome == "undetermined"
    codes[3, 4], codes[9, 1] = 332, 396  # two hot pixels happen to be multiples of 32 apart
    assert lattice(codes) == (0.0, "undetermined", 3)


def test_clip_level_and_repaired_pixels_off_the_lattice_are_tolerated():
    rng = np.random.default_rng(3)
    codes = adc(rng, sigma=15, size=(4, 128, 128)) * 16
    codes[:, ::7, ::11] = 65535  # saturated: more frequent than any other code
    codes[0, 5, 7:12] += np.array([3, 7, 9, 1, 5], np.uint16)
    assert detect_code_step(codes) == 16


@pytest.mark.parametrize("mean", [40, 1500])
def test_compressed_codes_are_not_one_lattice(mean):
    rng = np.random.default_rng(4)
    signal = rng.gamma(2.0, mean / 2, (4, 128, 128)) * 8
    table = np.rint(np.arange(1024) ** 2 / 64).astype(np.int64)  # square-root companding: steps of 1 to 32
    codes = table[np.clip(np.searchsorted(table, signal), 0, 1023)].astype(np.uint16)
    assert lattice(codes).outcome == "compressed"
    assert detect_code_step(codes) == 0


def test_piecewise_linear_table_is_compressed():
    rng = np.random.default_rng(5)
    signal = rng.integers(0, 8000, (4, 64, 64))
    codes = np.where(signal < 2000, signal, np.where(signal < 4000, signal // 2 * 2, signal // 8 * 8))
    assert lattice(codes.astype(np.uint16)).outcome == "compressed"


def test_digital_gain_that_is_no_whole_number_is_not_one_lattice():
    codes = np.rint(adc(np.random.default_rng(6), sigma=40) * 3.4).astype(np.uint16)
    assert lattice(codes).outcome == "scaled"


def test_channels_may_have_steps_of_their_own():
    codes = adc(np.random.default_rng(7), sigma=30)
    codes[:, ::2, ::2] *= 4
    codes[:, 1::2, 1::2] *= 2
    assert [code_lattice(h).step for h in code_histograms(codes)] == [4, 1, 1, 2]
    assert detect_code_step(codes) == 0  # taken together they are no lattice


def test_values_that_are_no_codes_are_refused():
    with pytest.raises(ValueError, match="whole numbers"):
        detect_code_step(np.linspace(0, 1, 16).reshape(4, 4))
    with pytest.raises(ValueError, match="16 bits"):
        detect_code_step(np.array([[1, 70000]]))


@pytest.mark.parametrize("camera, step", [("asi178", 4), ("asi120", 16), ("scmos_live", 1)])
def test_real_recordings(real_data, camera, step):
    for recording in load_capture_set(real_data / camera).recordings:
        assert detect_code_step(recording.frames) == step, recording.path
        steps = [code_lattice(h).step for h in code_histograms(recording.frames[:2])]
        assert steps == [step] * 4, recording.path


def test_the_widest_step_that_may_be_stated_is_compared_with_the_codes(tmp_path):
    frames = (64 + np.random.default_rng(0).poisson(200, (2, 24, 32))).astype(np.uint16)
    stated = Recording(frames, "RGGB", (64.0,) * 4, 1023.0, code_step=65536.0)
    write_recording(tmp_path / "a.h5", stated)
    assert read_recording(tmp_path / "a.h5").code_step == 65536.0


@pytest.mark.parametrize("level", [40.0, 300.0, 900.0])
def test_few_codes_that_a_gain_put_apart_are_no_lattice(level):
    rng = np.random.default_rng(3)
    counts = rng.poisson(level, 20000)
    assert detect_code_step(np.rint(counts * 64.06).astype(np.uint16).clip(0, 65535)) in (0.0, 64.0)
    assert detect_code_step(counts.astype(np.uint16)) == 1.0
