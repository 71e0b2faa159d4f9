"""Whether recordings hold noise that can be measured: refused early, in the user's words."""

from __future__ import annotations

import zlib

import numpy as np

from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

LEAST_SIDE = 8
"""Rows and columns below which no statistic of a frame means anything."""


def check_usable(capture: CaptureSet) -> None:
    """Raises BadInput for frames that are too small, constant, copies of one another, or wholly above white.

    Reads every frame once.
    """
    for recording in capture.recordings:
        _check(recording)


def _check(recording: Recording) -> None:
    path = recording.path or recording.camera
    if min(recording.size) < LEAST_SIDE:
        raise BadInput(
            f"{path}: frames of {recording.size[0]} x {recording.size[1]} pixels: at least "
            f"{LEAST_SIDE} x {LEAST_SIDE} are needed, hundreds are better"
        )
    seen: dict[int, int] = {}
    number = 0
    for part in chunks(recording.frames, 16 << 20):
        for frame in part:
            check_frame(path, number, frame, recording.white_level)
            print_ = zlib.crc32(np.ascontiguousarray(frame).tobytes())
            if print_ in seen:
                raise BadInput(
                    f"{path}: frame {number + 1} is a copy of frame {seen[print_] + 1}: noise shows between "
                    "frames, so each must be an exposure of its own"
                )
            seen[print_] = number
            number += 1


def check_frame(path: object, number: int, frame: np.ndarray, white: float = 65536.0) -> None:
    """Raises BadInput for a frame without noise: one value everywhere, or all of it above the white level."""
    low, high = int(frame.min()), int(frame.max())
    if low == high:
        why = "the camera cuts off below black: raise its offset" if low == 0 else "no frame of a sensor"
        raise BadInput(f"{path}: every pixel of frame {number + 1} is {low}: {why}")
    if low >= white:
        raise BadInput(
            f"{path}: every pixel of frame {number + 1} is at or above the white level {white:g}: saturated, "
            "or state --white-level"
        )
