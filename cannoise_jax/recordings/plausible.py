"""Whether what a file says about its pixels agrees with them, judged on one frame or a few."""

from __future__ import annotations

import logging
from collections.abc import Sequence

import numpy as np

from cannoise_jax.recordings.one_level import odd_levels
from cannoise_jax.recordings.recording import DARK, BadInput, Recording, name_of, normalise

_log = logging.getLogger(__name__)

_FEW = 4
"""Frames that are looked at."""
_DARKER_DN = 10.0
"""Black levels move by some DN; flats below the darks by more are none."""
_SAME_LIGHT = 1.2
"""Ratio of levels up to which frames count as repeats of each other: lamps and skies drift by less."""


def check_units_of_clean(recording: Recording) -> None:
    """Compares the median of `clean` with that of the first frame, both normalised.

    Raises BadInput where it is above 1.5 and twice the frame's, or below -0.5: no sensor shows such a scene,
    so it is in DN or another unit. Otherwise logs one warning where they differ by half and by more than
    0.05, which levels, an exposure or a scene that do not belong to the frames would do.
    """
    if recording.clean is None:
        return
    clean = recording.clean if recording.clean.ndim == 2 else np.asarray(recording.clean[0])
    said = float(np.median(clean))
    seen = float(np.median(normalise(recording.frames[0], recording)))
    if said > max(1.5, 2 * seen) or said < -0.5:
        raise BadInput(
            f"{recording.path}: clean has median {said:g}, the frames {seen:.3g} (0 black, 1 white), "
            "so it is not normalised: write (DN - black) / (white - black)"
        )
    if abs(said - seen) > max(0.05, 0.5 * min(abs(said), abs(seen))):
        _log.warning(
            "%s: clean has median %.3g, the frames %.3g (0 black, 1 white): check black_level, white_level "
            "and that clean shows the same scene and exposure", recording.path, said, seen,
        )  # fmt: skip


def warn_of_code_step(recording: Recording) -> None:
    """Logs one warning where the codes do not lie on one lattice of the stated `code_step`.

    Clipped values do not count, and one in twenty may be off it: repaired pixels are. Steps of 1 and of
    fractions fit any codes.
    """
    step = recording.code_step or 1.0
    if step <= 1 or step != round(step):
        return
    frame = np.asarray(recording.frames[0])
    inside = frame[(frame > 0) & (frame < recording.white_level)]
    residues = np.bincount(inside.astype(np.int32) % int(step), minlength=1)  # a step may be 65536
    off = 1 - residues.max() / max(inside.size, 1)
    if inside.size and off > 0.05:
        _log.warning(
            "%s: code_step %g is stated, but %.3g %% of the values lie between codes of that spacing: leave "
            "it out to have it detected", recording.path, step, 100 * off,
        )  # fmt: skip


def warn_of_lights(recording: Recording) -> None:
    """Logs one warning where frames of a flat or scene differ in brightness as under several lights.

    Judged on the medians of a few frames spread over the recording: they are to be repeats of each other. Of
    the few at another level than all others nothing is said: who measures leaves them out and names them.
    """
    own_scenes = recording.clean is not None and recording.clean.ndim == 3
    if recording.kind in DARK or recording.count < 2 or own_scenes:
        return
    looked = np.unique(np.linspace(0, recording.count - 1, _FEW).round().astype(int))
    levels = [float(np.median(np.asarray(recording.frames[t : t + 1]))) for t in looked.tolist()]
    above = np.array(levels) - np.mean(recording.black_level)
    dim, bright = int(np.argmin(above)), int(np.argmax(above))
    # A code or two at the bottom of the scale is no light.
    room = max((_SAME_LIGHT - 1) * above[dim], 4 * (recording.code_step or 1.0))
    if above[bright] - above[dim] > room and odd_levels(recording, unsteady=True) is None:
        _log.warning(
            "%s: frame %d lies %.4g DN above black, frame %d %.4g DN: frames of one recording are to be "
            "repeats under one light: make a recording of each light",
            recording.path, looked[dim] + 1, above[dim], looked[bright] + 1, above[bright],
        )  # fmt: skip


def check_kinds(recordings: Sequence[Recording]) -> None:
    """Raises BadInput where at one gain setting all flats are darker than all darks: no black level is above
    the light, so that kinds are mistaken, or the darks too long or lit for these flats."""
    levels: dict[tuple, dict[bool, list[tuple[float, str]]]] = {}
    for number, r in enumerate(recordings):
        if r.kind == "flat" or r.kind in DARK:
            own = levels.setdefault((r.size, r.iso, r.gain_db), {True: [], False: []})
            own[r.kind in DARK].append((float(np.median(np.asarray(r.frames[:1]))), name_of(r, number)))
    for own in levels.values():
        if not (own[True] and own[False]):
            continue
        (bright, flat), (dim, dark) = max(own[False]), min(own[True])
        if bright < dim - _DARKER_DN:
            raise BadInput(
                f"{flat}: the brightest flat, {bright:g} DN, is darker than {dark}, {dim:g} DN: where the "
                "kinds are the wrong way round rename them, or state --assign 'NAME*=KIND'; else record "
                "darks no longer than the flats"
            )
