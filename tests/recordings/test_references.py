import numpy as np
import pytest

from cannoise_jax.recordings.recording import BadInput, Recording, normalise
from cannoise_jax.recordings.references import leave_one_out, leave_one_out_excess, mean_frame


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
    assert noise.std() == pytest.approx(leave_one_out_excess(4) * 30 / (4095 - 115), rel=0.01)
    # Against the mean of all frames the frame itself would correlate with its reference.
    for frame, reference in zip(frames, references, strict=True):
        assert abs(np.corrcoef(frame[::2, ::2].ravel(), reference[::2, ::2].ravel())[0, 1]) < 0.04


def test_one_frame_has_no_reference():
    with pytest.raises(BadInput, match="x.h5: 1 frame"):
        next(leave_one_out(recording(1)))
