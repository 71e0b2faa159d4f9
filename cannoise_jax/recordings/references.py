"""References from repeated frames: what a frame is compared with must not hold the frame's own noise.

The reference of frame t is the mean of the other T - 1 frames. Frame minus reference then has variance
sigma^2 * T / (T - 1): divide by sqrt(T / (T - 1)) where the noise's own level matters.

Lamps drift, and under a rolling shutter the flicker of the mains becomes bands of rows that differ from frame
to frame. That is light, not noise of the camera, so flats may have it followed: see `illumination`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

import numpy as np
from jaxtyping import Float
from scipy.signal import savgol_filter

from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.recording import BadInput, Recording, normalise

_SMOOTH_ROWS, _SMOOTH_ORDER = 21, 5  # rows of one mosaic site


def mean_frame(recording: Recording) -> Float[np.ndarray, "h w"]:
    """Mean of all frames in normalised units; read in chunks, exact to float64."""
    total = np.zeros(recording.size, np.uint64)  # integers: the sum does not depend on the chunks
    for part in chunks(recording.frames):
        total += part.sum(axis=0, dtype=np.uint64)
    black = recording.black_map()
    return ((total / recording.count - black) / (recording.white_level - black)).astype(np.float32)


def leave_one_out(
    recording: Recording, most_bytes: int = 64 << 20, *, follow_light: bool = False
) -> Iterator[tuple[slice, Float[np.ndarray, "t h w"], Float[np.ndarray, "t h w"]]]:
    """Yields (which frames, those frames, their references), normalised, a chunk of frames at a time.

    The reference of frame t is the mean of all frames but t; with follow_light, times the `illumination` of
    frame t against that mean. Reads the frames twice and holds one chunk.
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
        frames = normalise(part, recording)
        references = (((total - part) / np.float64(count - 1) - black) / span).astype(np.float32)
        if follow_light:
            references *= illumination(frames, references)
        yield slice(at, at + len(part)), frames, references
        at += len(part)


def illumination(
    frames: Float[np.ndarray, "t h w"], references: Float[np.ndarray, "t h w"]
) -> Float[np.ndarray, "t h w"]:
    """Light on each row of a frame relative to its reference, per mosaic site, smooth along the rows.

    Ratio of row means, smoothed by a quintic over 21 rows of the site (Savitzky and Golay 1964): of bands of
    70, 40 and 28 sensor rows 0.1, 3 and 16 % are left, and of what single rows have of their own, frame by
    frame, 17 % of the variance goes with the light.
    Only for bright frames: row means must be well above zero.
    """
    light = np.empty_like(references)
    for site in np.ndindex(2, 2):
        place = np.s_[:, site[0] :: 2, site[1] :: 2]
        rows = (images[place].mean(axis=2, dtype=np.float64) for images in (frames, references))
        ratio = np.divide(*rows)
        window = min(_SMOOTH_ROWS, ratio.shape[1] - 1 + ratio.shape[1] % 2)
        smooth = savgol_filter(ratio, window, min(_SMOOTH_ORDER, window - 1), axis=1)
        light[place] = smooth[:, :, None]
    return light


def referenced_frames(
    recording: Recording, wanted: Collection[int]
) -> Iterator[tuple[int, np.ndarray, Float[np.ndarray, "h w"]]]:
    """Yields (number, frame in DN as stored, its noise-free reference, normalised) for the frames wanted.

    The reference is the recording's `clean` where it has one, else the mean of the other frames, which for
    a flat follows its light.
    Raises BadInput for a single frame without `clean`.
    """
    chosen = set(map(int, wanted))
    if recording.clean is not None:
        for number in sorted(chosen):
            clean = recording.clean if recording.clean.ndim == 2 else recording.clean[number]
            yield number, np.asarray(recording.frames[number]), np.asarray(clean, np.float32)
        return
    for part, _, references in leave_one_out(recording, follow_light=recording.kind == "flat"):
        for number in sorted(chosen & set(range(part.start, part.stop))):
            yield number, np.asarray(recording.frames[number]), references[number - part.start]
