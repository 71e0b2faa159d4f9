"""Which frames look for effects and which prove them, and each split prepared once."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from cannoise_jax.discovery.frames.battery import Prepared, in_units_of, prepare
from cannoise_jax.discovery.frames.contrasts import MOST_FRAMES
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.recordings.lazy import LazyArray, kept
from cannoise_jax.recordings.recording import DARK, CaptureSet


def read_once(capture: CaptureSet) -> CaptureSet:
    """The capture set with the frames that a run sees in memory once they were read: every look at them
    would open and inflate their files again."""
    held = (
        dataclasses.replace(r, frames=kept(r.frames, MOST_FRAMES)) if isinstance(r.frames, LazyArray) else r
        for r in capture.recordings
    )
    return dataclasses.replace(capture, recordings=tuple(held))


def split_frames(count: int) -> tuple[list[int], list[int]]:
    """Frames that look for effects, and frames that estimate and prove: three and one of every four, a place
    earlier from four to four (3, 6, 9, 12, 19, ...). Always the fourth would keep from those that look what
    comes with every fourth frame, and of frames that alternate show them twice as many of one kind. Fewer
    than three cannot be split."""
    show = [count - 1] if count == 3 else [t for t in range(count) if t % 4 == 3 - t // 4 % 4]
    return [t for t in range(count) if t not in show], show


def split_recordings(capture: CaptureSet) -> list[tuple[list[int], list[int]]]:
    """Frames of every recording that look for effects, and those that prove. Recordings that cannot be split
    look and prove in turn, those of each kind by themselves, and by themselves those of one frame, which show
    no noise; the first dark of every gain setting looks, for without it neither black level nor read noise of
    that setting are known. Of long ones `MOST_FRAMES` in all are used, spread evenly."""
    out, short = [], Counter[tuple[str, bool]]()
    known: set[float | None] = set()
    for r in capture.recordings:
        used = np.unique(np.linspace(0, r.count - 1, min(r.count, MOST_FRAMES)).round().astype(int))
        look, show = ([int(used[n]) for n in part] for part in split_frames(used.size))
        if not show:
            needed = r.kind in DARK and len(look) > 1 and r.iso not in known
            alike = r.kind, len(look) > 1
            look, show = (look, show) if needed or short[alike] % 2 == 0 else (show, look)
            short[alike] += 1
        known |= {r.iso} if len(look) > 1 and r.kind in DARK else set()
        out.append((look, show))
    return out


def all_frames(splits: list[tuple[list[int], list[int]]]) -> list[list[int]]:
    """Frames of every recording that look or prove, in order."""
    return [sorted(look + show) for look, show in splits]


def prepare_split(
    capture: CaptureSet,
    splits: list[tuple[list[int], list[int]]],
    judge_stated: bool = False,
    drawn: CaptureSet | None = None,
    *,
    held_back: bool = False,
    entries: tuple[Entry, ...] = ENTRIES,
) -> Prepared:
    """The frames that look for effects or, `held_back`, those that prove, seen against the others' mean."""
    looking = [a for a, _ in splits]
    if not held_back:
        return prepare(capture, looking, judge_stated, drawn, entries=entries)
    return prepare(capture, [b for _, b in splits], judge_stated, drawn, looking, entries)


@dataclass(frozen=True, eq=False)
class Splits:
    """The frames of a capture set as a run sees them, each split prepared once, when it is first asked for.

    frames: of every recording, those that look and those that are held back.
    """

    frames: list[tuple[list[int], list[int]]]
    of: Callable[[str], Prepared]

    @cached_property
    def looking(self) -> Prepared:
        """The frames that look for effects."""
        return self.of("looking")

    @cached_property
    def held_back(self) -> Prepared:
        """Those that prove, seen against the others' mean."""
        return in_units_of(self.of("held_back"), self.looking)

    @cached_property
    def together(self) -> Prepared:
        """All frames."""
        return in_units_of(self.of("together"), self.looking)

    @property
    def chosen(self) -> list[list[int]]:
        """Frames held back, per recording."""
        return [held for _, held in self.frames]

    @property
    def can_prove(self) -> bool:
        """Whether any frames are held back."""
        return any(self.chosen)

    def less(self, change: Callable[[Prepared], Prepared]) -> Splits:
        """The same splits, each changed."""
        return Splits(self.frames, lambda which: change(getattr(self, which)))


def splits_of(
    capture: CaptureSet,
    judge_stated: bool = False,
    drawn: CaptureSet | None = None,
    entries: tuple[Entry, ...] = ENTRIES,
) -> Splits:
    """The splits of a capture set, see `prepare` for what is judged and looked for."""
    frames = split_recordings(capture)

    def of(which: str) -> Prepared:
        if which == "together":
            return prepare(capture, all_frames(frames), judge_stated, drawn, entries=entries)
        held = which == "held_back"
        return prepare_split(capture, frames, judge_stated, drawn, held_back=held, entries=entries)

    return Splits(frames, of)
