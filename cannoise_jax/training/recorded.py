"""Folders of real recordings as training data: one folder a camera, any colour orders and noise levels.

What a folder gives:
- scenes with a noise-free image, or with two frames and more, are used as they are; repeated frames are
  compared with the mean of the others;
- flats likewise; either is left out, with a warning, where it is saturated;
- darks (or bias frames) of up to a second lend their floor to computed scenes: clean scene + Poisson shot
  noise + a real dark frame. This needs the system gain: photon transfer on flats and darks, or a
  recording's `shot`.
Three scenes and more of one ISO are parted whole into training (0.7), validation (0.1) and test (0.2), in the
order of their files; scenes of other ISOs likewise over their ISOs, or all for training where there are fewer
than three. Of a camera with one scene or two the frames are parted, in capture order, which is said in a
warning; so are those of flats and darks. No frame is in two of them; computed scenes are parted as well. shot
and read come from photon transfer where the files do not state them. Frames that show no noise (saturated,
copies, ...; see `recordings.usable`) are left out first, with a warning.
"""

from __future__ import annotations

import dataclasses
import logging
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.evaluation.baselines import SATURATED
from cannoise_jax.physics.synthetic.half_real import half_real_recording
from cannoise_jax.physics.synthetic.scenes import PATCH, SPLITS, draw_scenes, mosaic
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.packing import pack, to_packed_order
from cannoise_jax.recordings.recording import (
    DARK,
    LIT,
    BadInput,
    CaptureSet,
    PerChannel,
    Recording,
    normalise,
    per_channel,
)
from cannoise_jax.recordings.references import referenced_frames
from cannoise_jax.recordings.usable import usable

_SHARES = (0.7, 0.8)
"""Where validation and test frames begin."""
_LONGEST_S = 1.0
"""Darks of longer exposures hold dark signal and hot pixels, which are no part of a scene's `clean`: they are
taken only where initial noise is drawn at their exposure."""
_log = logging.getLogger(__name__)
Columns = dict[str, np.ndarray]
Parts = tuple[np.ndarray, np.ndarray, np.ndarray]


def recorded_patches(
    folders: Sequence[Path],
    overrides: Mapping[str, Any],
    key: Key[Array, ""],
    scenes: int,
    per_recording: int,
    *,
    triplet: bool = True,
    exposure_s: float | None = None,
) -> tuple[tuple[str, ...], tuple[str, ...], tuple[Columns, Columns, Columns]]:
    """Camera names, their colour orders, columns of training, validation, test patches (see `data.HeldOut`).

    scenes: computed scenes per camera for its darks. per_recording: patches at most of one
      recording and split. exposure_s: of the darks; None: all of up to a second. Raises BadInput, also for
      one camera with a triplet.
    """
    captures = [_usable(load_capture_set(folder, **overrides)) for folder in folders]
    names = tuple(captured.camera for captured in captures)
    if len(set(names)) < len(names):
        raise BadInput(f"{folders[0]}: {', '.join(names)}: each folder must hold another camera")
    if triplet and len(names) < 2:
        raise BadInput(
            f"{folders[0]}: one camera only, {names[0]}: the triplet loss needs two cameras or more: "
            "add a folder, or train without it: --config.loss.triplet=0"
        )
    parts: tuple[list[Columns], ...] = ([], [], [])
    for c, captured in enumerate(captures):
        own_key = jax.random.fold_in(key, c)
        cut = list(_camera_patches(captured, own_key, scenes, per_recording, exposure_s))
        for s, part in enumerate(parts):
            own = [columns for split, columns in cut if split == s]
            if not own:
                raise BadInput(
                    f"{folders[c]}: too few frames for {SPLITS[s]}: "
                    "record 3 frames or more of one scene, or 3 scenes"
                )
            part.extend({**columns, "camera": np.full(len(columns["iso"]), c, np.int32)} for columns in own)
    train, validation, test = ({n: np.concatenate([p[n] for p in part]) for n in part[0]} for part in parts)
    cfas = tuple(captured.recordings[0].cfa for captured in captures)
    return names, cfas, (train, validation, test)


def _usable(captured: CaptureSet) -> CaptureSet:
    """Without the frames that show no noise, which are said."""
    captured, left_out = usable(captured)
    for line in left_out:
        _log.warning("%s", line)
    return captured


def _camera_patches(
    captured: CaptureSet, key: Key[Array, ""], scenes: int, most: int, exposure_s: float | None
) -> Iterator[tuple[int, Columns]]:
    """(split, patches) of one camera."""
    repeated = [r for r in captured.of_kind(*LIT) if r.clean is not None or r.count > 1]
    repeated = [r for r in repeated if not _is_saturated(r)]
    darks = [r for r in captured.of_kind(*DARK) if r.count > 2 and _is_wanted(r.exposure_s or 0, exposure_s)]
    known = all(r.shot is not None and r.read is not None for r in repeated) and not darks
    transfer = None if known else _levels_of(captured)
    found = []
    parts = _parts(repeated)
    for number, recording in enumerate(repeated):
        for split, frames in enumerate(parts[number]):
            found.append((split, number, recording, frames))
    for split, name in enumerate(SPLITS) if darks else ():
        pictures = draw_scenes(jax.random.fold_in(key, split), name, scenes, darks[0].size)
        for s, scene in enumerate(pictures):
            dark = darks[s % len(darks)]
            part = _frames(dark, _parted(dark.count)[split])
            draw = jax.random.fold_in(jax.random.fold_in(key, len(SPLITS) + split), s)
            assert transfer is not None
            gain = float(np.mean(transfer[0])) * (dark.white_level - float(np.mean(dark.black_level)))
            made = half_real_recording(draw, mosaic(scene.image, dark.cfa), part, gain)
            number = len(repeated) + s * len(SPLITS) + split
            found.append((split, number, made, np.arange(made.count)))
    if not found:
        raise BadInput(
            f"{captured.path}: nothing to train on: record a scene or flat twice or more, or darks and flats"
        )
    for split, number, recording, frames in found:
        if len(frames):
            yield split, _cut(recording, frames, number, most, transfer)


def _is_wanted(exposure_s: float, wanted: float | None) -> bool:
    return exposure_s <= _LONGEST_S if wanted is None else math.isclose(exposure_s, wanted, rel_tol=1e-3)


def _is_saturated(recording: Recording) -> bool:
    """Whether half of a frame and more is too bright for its noise to be measured; said in a warning."""
    share = float(np.mean(normalise(recording.frames[0], recording) >= SATURATED))
    if share >= 0.5:
        _log.warning(
            "%s: %.0f %% of the values are above %g of the white level: not trained on", recording.path,
            100 * share, SATURATED,
        )  # fmt: skip
    return share >= 0.5


def _levels_of(captured: CaptureSet) -> tuple[PerChannel, PerChannel]:
    """shot and read of a camera, mosaic order: photon transfer, else what the files state."""
    for result in photon_transfer(captured):
        if isinstance(result.baseline, Baseline):
            base = result.baseline
            span = base.white_level - np.array(base.black_level)
            shot, read = np.array(base.gain) / span, np.square(np.array(base.read_noise) / span)
            return per_channel(shot), per_channel(read)
        reason = result.baseline.record
    for recording in captured.recordings:
        if recording.shot is not None and recording.read is not None:
            return recording.shot, recording.read
    raise BadInput(f"{captured.path}: shot and read are unknown and cannot be measured: {reason}")


def _parts(recordings: Sequence[Recording]) -> list[Parts]:
    """Frame numbers of training, validation and test for each recording, see the module's docstring."""
    groups: dict[Any, list[int]] = {}
    for n, recording in enumerate(recordings):
        if recording.kind == "scene":
            groups.setdefault(recording.iso, []).append(n)
    whole = [group for group in groups.values() if len(group) >= len(SPLITS)]
    rest = [n for group in groups.values() if group not in whole for n in group]
    if whole or len(rest) >= len(SPLITS):
        whole.append(rest)
    elif rest:
        _log.warning(
            "%s: %d scenes only: training and test share them, by frame", recordings[rest[0]].path, len(rest)
        )
    made = [_parted(recording.count) for recording in recordings]
    for group in whole:
        for split, members in enumerate(_parted(len(group))):
            for n in (group[m] for m in members):
                frames = [np.arange(0)] * len(SPLITS)
                frames[split] = np.arange(recordings[n].count)
                made[n] = (frames[0], frames[1], frames[2])
    return made


def _parted(count: int) -> Parts:
    """Numbers below `count` of training, validation and test, in order: one each at least, from three on;
    fewer are all for training."""
    if count < len(SPLITS):
        return np.arange(count), np.arange(0), np.arange(0)
    first = min(int(_SHARES[0] * count), count - 2)
    second = max(int(_SHARES[1] * count), first + 1)
    train, validation, test = np.split(np.arange(count), [first, second])
    return train, validation, test


def _frames(recording: Recording, numbers: np.ndarray) -> Recording:
    return dataclasses.replace(recording, frames=np.asarray(recording.frames[numbers[0] : numbers[-1] + 1]))


def _cut(
    recording: Recording,
    frames: np.ndarray,
    scene: int,
    most: int,
    transfer: tuple[PerChannel, PerChannel] | None,
) -> Columns:
    """Patches on a grid over the frames; `most` of them, spread evenly, where there are more."""
    cleans, noisies = [], []
    for _, frame, clean in referenced_frames(recording, frames):
        pair = (clean, normalise(frame, recording))
        packed = [
            pack(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2], recording.cfa) for image in pair
        ]
        cleans.append(tiles(packed[0]))
        noisies.append(tiles(packed[1]))
    clean, noisy = np.concatenate(cleans), np.concatenate(noisies)
    if not len(clean):
        raise BadInput(f"{recording.path}: smaller than {2 * PATCH} x {2 * PATCH} pixels: no patch fits")
    chosen = np.unique(np.linspace(0, len(clean) - 1, min(most, len(clean))).round().astype(int))
    stated = (recording.shot, recording.read)
    levels = stated if None not in stated else transfer
    assert levels is not None
    shot, read = (to_packed_order(np.array(v, np.float32), recording.cfa) for v in levels)
    if np.any(np.maximum(shot, read) <= 0):
        raise BadInput(
            f"{recording.path}: shot and read are both zero, which is no noise: leave them out to have them "
            "measured"
        )
    return {
        "clean": np.ascontiguousarray(clean[chosen], np.float32),
        "noisy": np.ascontiguousarray(noisy[chosen], np.float32),
        "shot": np.tile(shot, (len(chosen), 1)),
        "read": np.tile(read, (len(chosen), 1)),
        "iso": np.full(len(chosen), round(recording.iso or 0), np.int32),
        "scene": np.full(len(chosen), scene, np.int32),
    }


def tiles(packed: np.ndarray, height: int = PATCH, width: int = PATCH) -> np.ndarray:
    """A packed image cut on a grid, `[n, height, width, 4]`; what is left over at its ends goes."""
    rows, columns = packed.shape[0] // height, packed.shape[1] // width
    cut = packed[: rows * height, : columns * width].reshape(rows, height, columns, width, 4)
    return cut.swapaxes(1, 2).reshape(-1, height, width, 4)
