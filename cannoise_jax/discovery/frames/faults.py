"""Where recordings bear no measurement, or contradict what is stated of them, as calibrating says it."""

from __future__ import annotations

import dataclasses

from cannoise_jax.discovery.frames.calibrate import gain_groups
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.physics.transfer.faults import Faults, faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.lazy import chosen
from cannoise_jax.recordings.recording import CaptureSet, Recording


def faults_of(capture: CaptureSet) -> dict[float | None, Faults]:
    """The faults of the frames that a run looks at, by ISO. A scene whose reference follows each frame may
    move."""
    used = all_frames(split_recordings(capture))
    looked = [
        _only(r, numbers) for r, numbers in zip(capture.recordings, used, strict=True) if not _followed(r)
    ]
    out = {}
    for iso in gain_groups(capture):
        if own := [frame_statistics(r) for r in looked if r.iso == iso]:
            out[iso] = faults(own)
    return out


def _followed(recording: Recording) -> bool:
    return recording.clean is not None and recording.clean.ndim == 3


def _only(recording: Recording, numbers: list[int]) -> Recording:
    return dataclasses.replace(recording, frames=chosen(recording.frames, tuple(numbers)), clean=None)
