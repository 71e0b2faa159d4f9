import numpy as np

from cannoise_jax.recordings.crop import central
from cannoise_jax.recordings.recording import CaptureSet, Recording

FRAMES = np.arange(3 * 20 * 40, dtype=np.uint16).reshape(3, 20, 40)


def made(frames, clean=None):
    return Recording(frames, "RGGB", (0.0,) * 4, 65535.0, clean=clean)


def test_the_middle_of_all_recordings_with_its_colours():
    clean = FRAMES.astype(np.float32) / 65535
    capture = CaptureSet("x", (made(FRAMES), made(FRAMES[:2], clean[0]), made(FRAMES, clean)))
    cut, size = central(capture, 200)
    assert size == (10, 20) and size[0] * size[1] <= 200
    for r, whole in zip(cut.recordings, (FRAMES, FRAMES[:2], FRAMES), strict=True):
        assert r.size == size and r.count == len(whole)
        np.testing.assert_array_equal(r.frames[:], whole[:, 4:14, 10:30])
        np.testing.assert_array_equal(r.frames[1, 2:4, 3], whole[1, 4:14, 10:30][2:4, 3])
        np.testing.assert_array_equal(np.asarray(r.frames), whole[:, 4:14, 10:30])
    np.testing.assert_array_equal(cut.recordings[1].clean, clean[0, 4:14, 10:30])
    np.testing.assert_array_equal(cut.recordings[2].clean[2], clean[2, 4:14, 10:30])


def test_small_and_mixed_frames_are_left_as_they_are():
    capture = CaptureSet("x", (made(FRAMES),))
    assert central(capture, 800) == (capture, None)
    mixed = CaptureSet("x", (made(FRAMES), made(FRAMES[:, :10])))
    assert central(mixed, 10) == (mixed, None)
