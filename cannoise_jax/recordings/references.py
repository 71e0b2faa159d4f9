"""References from repeated frames: what a frame is compared with must not hold the frame's own noise.

The reference of frame t is the mean of the other T - 1 frames. Frame minus reference then has variance
sigma^2 * T / (T - 1): divide by `leave_one_out_excess(T)` where the noise's own level matters.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from jaxtyping import Float

from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.recording import BadInput, Recording, normalise


def leave_one_out_excess(count: int) -> float:
    """Std of (frame - mean of the others) over that of one frame, independent noise: sqrt(T / (T - 1))."""
    return float(np.sqrt(count / (count - 1)))


def mean_frame(recording: Recording) -> Float[np.ndarray, "h w"]:
    """Mean of all frames in normalised units; read in chunks, exact to float64."""
    total = np.zeros(recording.size, np.uint64)  # integers: the sum does not depend on the chunks
    for part in chunks(recording.frames):
        total += part.sum(axis=0, dtype=np.uint64)
    black = recording.black_map()
    return ((total / recording.count - black) / (recording.white_level - black)).astype(np.float32)


def leave_one_out(
    recording: Recording, most_bytes: int = 64 << 20
) -> Iterator[tuple[slice, Float[np.ndarray, "t h w"], Float[np.ndarray, "t h w"]]]:
    """Yields (which frames, those frames, their references), normalised, a chunk of frames at a time.

    The reference of frame t is the mean of all frames but t. Reads the frames twice and holds one chunk.
    Raises BadInput for fewer than two frames.
    """
    count = recording.count
    if count < 2:
        raise BadInput(f"{recording.path}: {count} frame: a reference from repeated frames needs two or more")
    total = np.zeros(recording.size, np.uint64)
    for part in chunks(recording.frames, most_bytes):
        total += part.sum(axis=0, dtype=np.uint64)
    black = recording.black_map()
    span = recording.white_level - black
    at = 0
    for part in chunks(recording.frames, most_bytes):
        others = (total - part) / np.float64(count - 1)
        yield (
            slice(at, at + len(part)),
            normalise(part, recording),
            ((others - black) / span).astype(np.float32),
        )
        at += len(part)


def referenced_frames(
    recording: Recording, wanted: Collection[int]
) -> Iterator[tuple[int, np.ndarray, Float[np.ndarray, "h w"]]]:
    """Yields (number, frame in DN as stored, its noise-free reference, normalised) for the frames wanted.

    The reference is the recording's `clean` where it has one, else the mean of the other frames.
    Raises BadInput for a single frame without `clean`.
    """
    chosen = set(map(int, wanted))
    if recording.clean is not None:
        for number in sorted(chosen):
            clean = recording.clean if recording.clean.ndim == 2 else recording.clean[number]
            yield number, np.asarray(recording.frames[number]), np.asarray(clean, np.float32)
        return
    for part, _, references in leave_one_out(recording):
        for number in sorted(chosen & set(range(part.start, part.stop))):
            yield number, np.asarray(recording.frames[number]), references[number - part.start]
