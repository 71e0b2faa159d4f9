"""Which frames hold noise that can be measured: the others are left out and said, in the user's words."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from cannoise_jax.recordings.lazy import chosen
from cannoise_jax.recordings.metadata import checked, chunks
from cannoise_jax.recordings.one_level import odd_levels, told_level
from cannoise_jax.recordings.one_light import odd_pictures, told
from cannoise_jax.recordings.one_noise import apart, numbered, short_names, words
from cannoise_jax.recordings.one_readout import disturbed, told_readout
from cannoise_jax.recordings.over_time import check_single_exposures
from cannoise_jax.recordings.own_average import AVERAGED, own_averages
from cannoise_jax.recordings.plausible import check_kinds
from cannoise_jax.recordings.recording import DARK, LIT, BadInput, CaptureSet, Recording

LEAST_SIDE = 8
"""Rows and columns below which no statistic of a frame means anything."""
_FULL = tuple((2**bits - 1) << shift for bits in (8, 10, 12, 14, 16) for shift in (0, 16 - bits))
"""Highest codes, also where they are shifted to 16 bits."""
_FEWEST, _OVERFULL = 3, 0.05
"""Frames from which one can be told to be odd; share of the pixels of a dark that neither hits nor hot pixels
reach, and that neither are in one frame alone."""

_OTHER_GAIN = 3.0
"""Times the noise of other frames that a frame may have by interference. Gain settings that are thrown
together lie further apart, as a rule."""

Seen = dict[tuple, tuple[object, int]]
"""Where the pixels of a frame were met first: recording and number, by size and checksum."""


class LeftOutWarning(UserWarning):
    """Frames that show no noise take no part."""


def usable(
    capture: CaptureSet, unsteady: bool = False, tell: Callable[[int, int], None] = lambda number, total: None
) -> tuple[CaptureSet, tuple[str, ...]]:
    """The capture set without frames that show no noise, and a line for each reason to leave some out.
    unsteady: frames that are noisier than others stay, as long as no gain setting is that far from the next:
    they are what is looked for. tell: called with how much is done, and of how much.

    Left out are frames of one value, copies of an earlier frame, frames wholly at the white level, the few of
    which a part is another than in the rest (see `one_light`; not where unsteady ones are looked for), the
    few at another level than the rest (see `one_level`), averages of frames beside which they lie (see
    `own_average`), the few whose temporal noise is another than that of
    the rest (see `one_noise`), and those read out with a disturbance (see `one_readout`); with its last frame
    a recording goes too. Raises BadInput for
    recordings that no file may hold (see `metadata.checked`), for none at all, for frames that are too small,
    for a recording of frames of several noises none of which is the rule, for frames averaged over time (see
    `over_time`), for flats all darker than all darks, and where so much is lost that no two frames of one
    recording are left.
    """
    if not capture.recordings:
        raise BadInput(f"{capture.path or capture.camera}: holds no recordings: add some")
    kept: list[Recording] = []
    lines: list[str] = []
    seen: Seen = {}
    judged: list[tuple[Recording, list[int], list[str]]] = []
    full: dict[tuple, float] = {}
    looks = 2 * len(capture.recordings)
    for number, recording in enumerate(map(checked, capture.recordings)):
        tell(number, looks)
        _check_size(recording)
        good, why = _judged(recording, seen)
        good, averaged = _without_averages(recording, good)
        judged.append((recording, good, why + averaged))
        if recording.kind in LIT and (codes := _full_codes(recording, good)):
            full[_setting(recording)] = max(*codes, full.get(_setting(recording), 0.0))
    # Before all that follows: of frames averaged over time the last ones look as if they had another noise.
    check_single_exposures([_some(recording, good) for recording, good, _ in judged if good])
    for number, (recording, good, why) in enumerate(judged, len(judged)):
        tell(number, looks)
        lines += why
        good, why = (good, []) if unsteady else _of_one_picture(recording, good)
        lines += why
        good, why = _of_one_level(recording, good, unsteady)
        lines += why
        good, why = _of_one_noise(recording, good, unsteady)
        lines += why
        good, why = _of_one_readout(recording, good)
        lines += why
        if good:
            left = _some(recording, good)
            code = full.get(_setting(recording), recording.full_code)
            kept.append(left if code == left.full_code else dataclasses.replace(left, full_code=code))
    tell(looks, looks)
    repeated = any(r.count > 1 for r in capture.recordings)
    if lines and not any(r.count > 1 for r in kept) and (repeated or not kept):
        more = f" (and {len(lines) - 1} more)" if len(lines) > 1 else ""
        raise BadInput(f"{lines[0]}{more}; too few frames are left")
    check_kinds(kept)
    return dataclasses.replace(capture, recordings=tuple(kept)), tuple(f"{line}: left out" for line in lines)


def without_noise(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """A line for each reason why frames hold no noise, be they of one value, saturated or copies."""
    seen: Seen = {}
    return tuple(line for recording in recordings for line in _judged(recording, seen)[1])


def copies(recordings: Sequence[Recording]) -> dict[int, int]:
    """Recordings that hold the same pixels as an earlier one: the number of each, and of the earlier one."""
    seen: dict[tuple, int] = {}
    out: dict[int, int] = {}
    for number, recording in enumerate(recordings):
        whole = hashlib.blake2b(digest_size=16)
        for part in chunks(recording.frames):
            whole.update(part.tobytes())
        first = seen.setdefault((tuple(recording.frames.shape), whole.digest()), number)
        if first != number:
            out[number] = first
    return out


def fault_of(frame: np.ndarray, white: float = 65536.0) -> str | None:
    """Why a frame holds no noise: one value everywhere, or all of it at or above the white level."""
    low, high = int(frame.min()), int(frame.max())
    if low >= white:
        return f"every pixel is at or above the white level {white:g} (saturated, or state --white-level)"
    if low == high:
        why = "the camera cuts off below black: raise its offset" if low == 0 else "no frame of a sensor"
        why = "saturated" if low in _FULL else why
        return f"every pixel is {low} ({why})"
    return None


def _setting(recording: Recording) -> tuple:
    """What the code depends on at which pixels are full."""
    return recording.iso, recording.gain_db, recording.size


def _full_codes(recording: Recording, good: Sequence[int]) -> list[float]:
    """The codes, up to the white level, of frames that are left out because they are full. good: numbers of
    those that are not."""
    white, others = recording.white_level, set(range(recording.count)) - set(good)
    frames = (np.asarray(recording.frames[n]) for n in sorted(others))
    return [min(float(frame.min()), white) for frame in frames if is_full(frame, white)]


def is_full(frame: np.ndarray, white: float = 65536.0) -> bool:
    """Whether a frame is wholly at the white level, or at the highest code of a converter."""
    low, high = int(frame.min()), int(frame.max())
    return low >= white or (low == high and low in _FULL)


def _judged(recording: Recording, seen: Seen) -> tuple[list[int], list[str]]:
    """The numbers of the frames to keep, and why the others are not."""
    path: object = recording.path or recording.camera
    good: list[int] = []
    faults: dict[str, list[int]] = {}
    copied: dict[object, list[tuple[int, int]]] = {}
    number = 0
    full: dict[int, float] = {}
    for part in chunks(recording.frames, 1 << 20):
        for frame in part:
            number += 1
            fault = fault_of(frame, recording.white_level)
            if fault is not None:
                faults.setdefault(fault, []).append(number)
                continue
            key = (frame.shape, hashlib.blake2b(frame.tobytes(), digest_size=16).digest())
            first, at = seen.setdefault(key, (path, number))
            if (first, at) == (path, number):
                good.append(number - 1)
                full[number] = float(np.mean(frame >= recording.white_level))
            else:
                copied.setdefault(first, []).append((number, at))
    if overfull := _overfull(recording, full):
        most = 100 * max(full[n] for n in overfull)
        faults[f"{most:.0f} % of its pixels are at the white level, those of the others are not"] = overfull
        good = [n for n in good if n + 1 not in overfull]
    for first, pairs in copied.items():
        of = "" if first == path else f" of {first}"
        which, sources = zip(*pairs, strict=True)
        one = len(set(sources)) == 1
        what = f"a copy of frame {sources[0]}{of}" if one else f"copies of earlier frames{of}"
        faults[f"{what} (noise shows between exposures of their own)"] = list(which)
    in_order = sorted(faults.items(), key=lambda item: item[1][0])
    return good, [f"{path}: {numbered(which)}: {fault}" for fault, which in in_order]


def _overfull(recording: Recording, full: dict[int, float]) -> list[int]:
    """The few dark frames of which far more is at the white level than of the others."""
    if recording.kind not in DARK or len(full) < _FEWEST:
        return []
    usual = float(np.median(list(full.values())))
    odd = [n for n, share in full.items() if share > usual + _OVERFULL]
    return odd if len(odd) <= len(full) / 4 else []


def of_several_noises(recording: Recording) -> str:
    """A line where the frames are not of one temporal noise, empty where they are."""
    _, why = _without_averages(recording, list(range(recording.count)))
    if why:
        return why[0]
    found = apart(recording)
    return words(recording, found, range(recording.count)) if found else ""


def _without_averages(recording: Recording, good: list[int]) -> tuple[list[int], list[str]]:
    """The good frames but averages of others of them, and a line for each time that some were found: one may
    hide another."""
    lines: list[str] = []
    while good and (averages := own_averages(left := _some(recording, good))):
        good, why = _without(recording, left, good, averages, AVERAGED)
        lines += why
    return good, lines


def _of_one_noise(recording: Recording, good: list[int], unsteady: bool) -> tuple[list[int], list[str]]:
    """The frames of one temporal noise among the good ones, and why others are not. Raises BadInput where
    none is the rule."""
    left = _some(recording, good) if good else recording
    found = apart(left) if good else None
    if found is None:
        return good, []
    average = found.few and found.ratio < 1
    if unsteady and not average and 1 / _OTHER_GAIN < found.ratio < _OTHER_GAIN:
        return good, []
    line = words(left, found, good)
    if not found.few:
        raise BadInput(f"{line}: leave them out (--leave-out), or put them in a folder of their own")
    # A loud frame makes the noise of those beside it uncertain: without it there may be more to see.
    kept, more = _of_one_noise(recording, [good[k] for k in found.others], unsteady)
    return kept, [line, *more]


def _of_one_level(recording: Recording, good: list[int], unsteady: bool) -> tuple[list[int], list[str]]:
    """The frames of one level among the good ones, and at which the others are."""
    left = _some(recording, good) if good else recording
    found = odd_levels(left, unsteady) if good else None
    if found is None:
        return good, []
    return _without(recording, left, good, found.numbers, told_level(left, found))


def _of_one_readout(recording: Recording, good: list[int]) -> tuple[list[int], list[str]]:
    """The frames that were read out alike among the good ones, and how the others were."""
    left = _some(recording, good) if good else recording
    found = disturbed(left) if good else None
    if found is None:
        return good, []
    return _without(recording, left, good, found.numbers, told_readout(found, left.count))


def _without(
    recording: Recording, left: Recording, good: list[int], odd: Sequence[int], why: str
) -> tuple[list[int], list[str]]:
    """The good frames but the odd ones among those that are `left`, and why these are not."""
    which = numbered([good[k] + 1 for k in odd])
    names = short_names(left.sources) if len(left.sources) == left.count else ()
    which += f" ({', '.join(names[k] for k in odd)})" if names else ""
    kept = [n for k, n in enumerate(good) if k not in odd]
    return kept, [f"{recording.path or recording.camera}: {which}: {why}"]


def _of_one_picture(recording: Recording, good: list[int]) -> tuple[list[int], list[str]]:
    """The frames of one picture among the good ones, and what parts of others are another."""
    left = _some(recording, good) if good else recording
    odd = odd_pictures(left) if good else []
    names = short_names(left.sources) if len(left.sources) == left.count else ()
    lines = []
    for found in odd:
        which = numbered([good[found.number] + 1]) + (f" ({names[found.number]})" if names else "")
        lines.append(f"{recording.path or recording.camera}: {which}: {told(left, found)}")
    dropped = {found.number for found in odd}
    return [n for k, n in enumerate(good) if k not in dropped], lines


def _check_size(recording: Recording) -> None:
    if min(recording.size) < LEAST_SIDE:
        raise BadInput(
            f"{recording.path or recording.camera}: frames of {recording.size[0]} x {recording.size[1]} "
            f"pixels: at least {LEAST_SIDE} x {LEAST_SIDE} are needed, hundreds are better"
        )


def _some(recording: Recording, numbers: list[int]) -> Recording:
    """The recording with these of its frames."""
    if len(numbers) == recording.count:
        return recording
    clean: Any = recording.clean
    if clean is not None and clean.ndim == 3:
        clean = chosen(clean, tuple(numbers))
    sources = recording.sources
    if len(sources) == recording.count:
        sources = tuple(sources[k] for k in numbers)
    frames = chosen(recording.frames, tuple(numbers))
    return dataclasses.replace(recording, frames=frames, clean=clean, sources=sources)
