import numpy as np
import pytest

from cannoise_jax.recordings.recording import BadInput, Recording, normalise
from cannoise_jax.recordings.references import (
    leave_one_out,
    mean_frame,
    referenced_frames,
)


def recording(count, size=(6, 8), seed=0):
    frames = np.random.default_rng(seed).poisson(900, (count, *size)).astype(np.uint16)
    return Recording(frames, "RGGB", (100.0, 110.0, 120.0, 130.0), 4095.0, path="x.h5")


@pytest.mark.parametrize("most_bytes", [1, 200, 1 << 20])
def test_each_reference_is_the_mean_of_the_other_frames(most_bytes):
    r = recording(5)
    seen = []
    for part, frames, references in leave_one_out(r, most_bytes):
        np.testing.assert_array_equal(frames, normalise(r.frames[part], r))
        for t, reference in zip(range(part.start, part.stop), references, strict=True):
            others = np.delete(r.frames, t, axis=0).astype(np.float64).mean(axis=0)
            black = r.black_map().astype(np.float64)
            np.testing.assert_allclose(reference, (others - black) / (4095 - black), rtol=1e-6)
            seen.append(t)
    assert seen == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(mean_frame(r), normalise(r.frames, r).mean(axis=0), rtol=1e-5)


def test_a_reference_holds_none_of_its_frames_noise():
    r = recording(4, size=(200, 200))
    ((_, frames, references),) = leave_one_out(r)
    noise = frames - references
    assert noise.std() == pytest.approx(np.sqrt(4 / 3) * 30 / (4095 - 115), rel=0.01)
    # Against the mean of all frames the frame itself would correlate with its reference.
    for frame, reference in zip(frames, references, strict=True):
        assert abs(np.corrcoef(frame[::2, ::2].ravel(), reference[::2, ::2].ravel())[0, 1]) < 0.04


def test_one_frame_has_no_reference():
    with pytest.raises(BadInput, match="x.h5: 1 frame"):
        next(leave_one_out(recording(1)))


def flickering_flats(light, noise, rows=128, columns=400, count=8):
    """Flats under a lamp that drifts, and flickers with a period of 70 rows at another phase each frame."""
    rng = np.random.default_rng(0)
    t, y = np.arange(count)[:, None, None], np.arange(rows)[None, :, None]
    bands = 1 + 0.2 * np.sin(2 * np.pi * y / 70 + 2.1 * t) if light else np.ones((count, rows, 1))
    electrons = 8000 * (1 - 0.02 * t) * bands * np.linspace(0.9, 1.1, columns)
    electrons = electrons + noise * rng.normal(0, 100, (count, rows, 1))  # rows of their own, frame by frame
    frames = rng.poisson(electrons) + 100
    return Recording(frames.astype(np.uint16), "RGGB", (100.0,) * 4, 16383.0, kind="flat"), electrons / 16283


def residual(recording, follow_light):
    ((_, frames, references),) = leave_one_out(recording, follow_light=follow_light)
    return frames - references


def test_flats_have_their_light_followed_and_their_noise_left():
    flats, _ = flickering_flats(light=True, noise=0)
    shot = np.sqrt(8000 * 0.93) / 16283 * np.sqrt(8 / 7)
    assert residual(flats, False).std() > 5 * shot  # the lamp would pass for noise
    assert residual(flats, True).std() == pytest.approx(shot, rel=0.03)
    rows = residual(flats, True).mean(axis=2).std()
    assert rows < 1.5 * shot / np.sqrt(400)  # nothing of the bands is left in the row means
    (chosen,) = [r for n, _, r in referenced_frames(flats, [3]) if n == 3]
    ((_, _, references),) = leave_one_out(flats, follow_light=True)
    np.testing.assert_array_equal(chosen, references[3])


def test_single_rows_keep_most_of_what_is_their_own():
    flats, _ = flickering_flats(light=False, noise=1)
    kept = residual(flats, True).mean(axis=2).std() / (100 / 16283 * np.sqrt(8 / 7))
    assert 0.87 < kept < 0.95  # sqrt(1 - 0.17) = 0.91
