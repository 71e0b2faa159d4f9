"""Plans carried out: the recordings of a folder written in the native format, for good or into a cache."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.recordings.atomic import is_running, one_work
from cannoise_jax.recordings.folders.aside import used_line
from cannoise_jax.recordings.folders.groups import Group
from cannoise_jax.recordings.folders.lease import GOING, Lease, remove_unused
from cannoise_jax.recordings.folders.plan import CaptureGroups, Plan, check, plan_folder
from cannoise_jax.recordings.folders.plan_text import text
from cannoise_jax.recordings.folders.shots import Tell
from cannoise_jax.recordings.join import join_recordings
from cannoise_jax.recordings.lazy import LazyArray, chosen
from cannoise_jax.recordings.load import (
    SeveralCameras,
    called,
    is_supported,
    load_capture_set,
    load_recording,
    open_file,
    suffix_of,
)
from cannoise_jax.recordings.metadata import count_above, make_recording, warn_saturation
from cannoise_jax.recordings.native import SUFFIXES as NATIVE
from cannoise_jax.recordings.native import open_native, write_recording
from cannoise_jax.recordings.opened import stated
from cannoise_jax.recordings.pictures import SUFFIXES as PICTURES
from cannoise_jax.recordings.recording import DARK, BadInput, CaptureSet, Recording
from cannoise_jax.recordings.sidd import is_instance
from cannoise_jax.recordings.stacks import NUMPY_SUFFIXES, TIFF_SUFFIXES, side_car
from cannoise_jax.recordings.unfinished import is_finished

_KEPT = 6
"""Conversions that a cache keeps beside those in use."""
_STACKS = (*TIFF_SUFFIXES, *NUMPY_SUFFIXES)
_MAKING = ".making-"
_SOURCES = "sources.json"
"""In a cached conversion: the files of every recording, below the folder."""
_LAYOUT = "10"
"""Of what is cached, and of how folders are sorted: entries of another layout are not used."""


_ONE_CAMERA = (
    "give one of its folders, pass over the files of the others with --leave-out NAME*, or name them "
    "--camera NAME if they are one"
)


class Options(NamedTuple):
    """How a user has a folder read: what holds for all recordings, kinds by name, and what to pass over."""

    overrides: dict[str, Any]
    assign: Sequence[tuple[str, str]] = ()
    leave_out: Sequence[str] = ()


def capture_of(
    folder: Path, options: Options, cache: Path, tell: Tell = lambda n, total: None
) -> tuple[CaptureSet, str]:
    """The capture set of any folder, and how it was made up (empty where its files are recordings already).

    A folder whose own files are all in the native format, scene folders of SIDD, or stacks with side-cars is
    taken as it is. Every other one is planned, and its main set converted into `cache`, unless it is there;
    where there are others, the last line says what is used (see `aside`).
    Raises BadInput.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder}: {'is a file: name its folder' if folder.is_file() else 'no such folder'}")
    if _is_prepared(folder) and not options.assign and not options.leave_out:
        try:
            capture = load_capture_set(folder, **options.overrides)
        except SeveralCameras as several:
            raise SeveralCameras(folder, several.cameras, _ONE_CAMERA) from several
        return capture, ""
    entry = cache / _key(folder, options)
    lease = _lease_of(entry)
    if lease is not None:
        try:
            os.utime(entry)
            return _from_cache(lease, folder, scan=True)
        except (BadInput, OSError, ValueError):  # damaged: of no use to anyone
            shutil.rmtree(entry, ignore_errors=True)
    plan = plan_folder(
        folder, options.overrides, assign=options.assign, leave_out=options.leave_out, tell=tell
    )
    cameras: dict[str, list[str]] = {}
    for group in (group for one in plan.sets for group in one.groups):
        cameras.setdefault(group.mode[0], []).extend(shot.name for shot in group.shots)
    if len(cameras) > 1:
        raise SeveralCameras(folder, cameras, _ONE_CAMERA)
    check(plan)
    return _from_cache(_into_cache(plan, entry), folder, scan=False)


def write_plan(plan: Plan, out: Path, *, force: bool = False) -> Iterator[tuple[Path, Recording]]:
    """Writes every recording of a plan below `out` and yields them. Where it fails, nothing new is left.

    Raises BadInput, before anything is written where the plan has problems or files exist (without force).
    """
    check(plan)
    named = [(out / one.folder / f"{g.label}.h5", one, g) for one in plan.sets for g in one.groups]
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: is a file: name a folder")
    there = [path for path, _, _ in named if is_finished(path)]
    if there and not force:
        raise BadInput(f"{there[0]}: exists: name another folder, or replace it with --force")
    lacking = [one for one in plan.sets if one.levels.missing and not _complete(one)]
    if lacking:
        words = "; ".join(f"{one.folder}: {'; '.join(one.levels.missing)}" for one in lacking)
        raise BadInput(f"{plan.folder}: {words}")
    made = list(dict.fromkeys(p for one in plan.sets for p in _missing_parents(out / one.folder)))
    try:
        for path, _, _ in named:
            path.parent.mkdir(parents=True, exist_ok=True)
        with one_work([path for path, _, _ in named]):
            for path, one, group in named:
                recording = recording_of(group, one, plan.overrides)
                write_recording(path, recording)
                yield path, recording
    except OSError as error:
        _undo(made)
        raise BadInput(f"{out}: cannot be written ({error.strerror}): name another folder") from error
    except BaseException:
        _undo(made)
        raise


def recording_of(group: Group, one: CaptureGroups, overrides: dict[str, Any]) -> Recording:
    """The frames of a group as one recording, still to be read. Raises BadInput."""
    first = group.shots[0]
    if first.whole:
        assigned = {} if group.kind == first.said else {"kind": group.kind}
        return load_recording(first.path, **overrides | assigned)
    settings = stated(group.settings) | one.levels.values | overrides
    parts = []
    for shot in group.shots:
        opened = open_file(shot.path)
        known = {k: v for k, v in stated(opened.known).items() if k not in ("temperature_c", "exposure_s")}
        part = _lean(make_recording(shot.path, opened.frames, {**known, **settings}, {}, scan=False))
        if shot.pages is not None:
            part = dataclasses.replace(part, frames=chosen(part.frames, shot.pages))
        parts.append(part)
    recording = join_recordings(parts)
    white = recording.white_level
    if max(s.top for s in group.shots) > white:  # else they need not be read for it
        name = called([str(s.path) for s in group.shots])
        warn_saturation(name, count_above(recording.frames, white), recording.frames.shape, white)
    return recording


def _lease_of(entry: Path) -> Lease | None:
    try:
        return Lease(entry) if (entry / "plan.txt").is_file() else None
    except OSError:  # removed meanwhile
        return None


def _from_cache(lease: Lease, folder: Path, scan: bool) -> tuple[CaptureSet, str]:
    """The recordings of a cached conversion, under the names of the files that they were made from, and the
    plan of it. Their frames stay in the cache as long as anybody refers to them.

    scan: whether saturation is to be said, which converting does already.
    """
    entry = lease.place
    sources = json.loads((entry / _SOURCES).read_text(encoding="utf-8"))
    recordings = []
    for name in sorted(sources):
        files = tuple(str(folder / one) for one in sources[name])
        opened = open_native(entry / name)
        recording = make_recording(called(files), opened.frames, opened.known, {}, scan=scan)
        frames = LazyArray(
            partial(_read_held, lease, opened.frames), tuple(opened.frames.shape), opened.frames.dtype
        )
        recordings.append(dataclasses.replace(recording, sources=files, frames=frames))
    said = (entry / "plan.txt").read_text(encoding="utf-8")
    return CaptureSet(recordings[0].camera, tuple(recordings), str(folder)), said


def _read_held(lease: Lease, frames: Any, index: Any) -> np.ndarray:
    """lease: of the folder that holds the frames, kept by whoever can read them."""
    return np.asarray(frames[index])


def _lean(recording: Recording) -> Recording:
    """The recording without the pixels that opening decoded: they are decoded again when they are needed."""
    if isinstance(recording.frames, LazyArray):
        return recording
    path, shape = Path(str(recording.path)), tuple(recording.frames.shape)
    frames = LazyArray(partial(_read_again, path), shape, recording.frames.dtype)
    return dataclasses.replace(recording, frames=frames)


def _read_again(path: Path, index: Any) -> np.ndarray:
    return np.asarray(open_file(path).frames[index])


def _complete(one: CaptureGroups) -> bool:
    return all(name in one.levels.values for name in ("cfa", "black_level", "white_level"))


def _is_prepared(folder: Path) -> bool:
    """Whether every readable file right in the folder is a recording by itself: none is to be joined."""
    if is_instance(folder):
        return False
    files = [
        p for p in folder.iterdir() if not p.name.startswith(".") and (is_instance(p) or is_supported(p))
    ]
    beside = [p for p in files if not is_instance(p) and suffix_of(p) not in NATIVE]
    return bool(files) and all(p.with_suffix(".json").is_file() for p in beside) and not _single(beside)


def _single(files: Sequence[Path]) -> bool:
    """Whether they are two or more and each holds one image of what is the same in many, so that those of a
    setting are to be joined: scenes may be of anything."""
    return len(files) > 1 and all(_is_repeat(p) for p in files)


def _is_repeat(path: Path) -> bool:
    try:
        kind = side_car(path).get("kind")
    except BadInput:
        return False
    if kind != "flat" and kind not in DARK:
        return False
    return suffix_of(path) in PICTURES or (suffix_of(path) in _STACKS and _frames_of(path) == 1)


def _frames_of(path: Path) -> int:
    """How many frames a file holds; 0 of one that cannot be read, or that has their `clean` with them."""
    try:
        opened = open_file(path)
    except BadInput:
        return 0
    return 0 if "clean" in opened.known else len(opened.frames)


def _key(folder: Path, options: Options) -> str:
    facts = [_LAYOUT, str(folder.resolve()), options, *facts_of(folder)]
    text_ = json.dumps(facts, sort_keys=True, default=str)
    return hashlib.sha256(text_.encode("utf-8", "surrogateescape")).hexdigest()[:24]


def facts_of(folder: Path) -> list[tuple[Any, ...]]:
    """Name, size and times of every file below a folder, in order; of what cannot be looked at the name and
    None. To read the files would cost more, at every call. The time of the last change of the entry itself
    tells of files that were replaced by others of the same size, whose times were kept."""
    facts: list[tuple[Any, ...]] = []
    for root, folders, names in os.walk(folder, onerror=lambda error: facts.append((error.filename, None))):
        folders.sort()
        for name in sorted(names):
            path = Path(root) / name
            try:
                about = path.stat()
            except OSError:
                facts.append((str(path), None))
                continue
            facts.append((str(path), about.st_size, about.st_mtime_ns, about.st_ctime_ns))
    return facts


def _into_cache(plan: Plan, entry: Path) -> Lease:
    """The main set of a plan as an entry of the cache, in use from the start. Raises BadInput."""
    try:
        entry.parent.mkdir(parents=True, exist_ok=True)
        _prune(entry.parent)
        temporary = Path(tempfile.mkdtemp(prefix=f"{_MAKING}{os.getpid()}-", dir=entry.parent))
        lease = Lease(temporary)
    except OSError as error:
        raise BadInput(f"{entry.parent}: cannot be written ({error.strerror}): set XDG_CACHE_HOME") from error
    try:
        main = dataclasses.replace(plan, sets=plan.sets[:1])
        for _ in write_plan(main, temporary, force=True):
            pass
        sources = {f"{g.label}.h5": [s.name for s in g.shots] for one in main.sets for g in one.groups}
        (temporary / _SOURCES).write_text(json.dumps(sources), encoding="utf-8")
        said = "".join(f"{part}\n" for part in (text(plan), " ".join(used_line(plan).splitlines())) if part)
        (temporary / "plan.txt").write_text(said, encoding="utf-8", errors="replace")
        try:
            os.replace(temporary, entry)
            lease.moved(entry)
        except OSError:  # another process was faster
            lease = Lease(entry)
            shutil.rmtree(temporary, ignore_errors=True)
        return lease
    except (BadInput, OSError) as error:
        shutil.rmtree(temporary, ignore_errors=True)
        if not str(error).startswith(str(temporary)) and not isinstance(error, OSError):
            raise
        why = error.strerror if isinstance(error, OSError) else str(error).rpartition(": ")[2]
        raise BadInput(
            f"{entry.parent}: the cache of converted folders cannot be written: {why}: make room, or set "
            "XDG_CACHE_HOME"
        ) from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _prune(cache: Path) -> None:
    for left in cache.glob(f"{_MAKING}*"):  # of a run that was killed
        process = left.name.removeprefix(_MAKING).partition("-")[0]
        if not (process.isdigit() and is_running(int(process))):
            remove_unused(left)
    for left in cache.glob(f"{GOING}*"):
        remove_unused(left)
    made = (p for p in cache.iterdir() if p.is_dir() and not p.name.startswith("."))
    entries = sorted(made, key=lambda p: p.stat().st_mtime)
    for old in entries[: max(len(entries) - _KEPT + 1, 0)]:
        remove_unused(old)


def _missing_parents(out: Path) -> list[Path]:
    """`out` and its parents that do not exist yet, the deepest first."""
    missing = []
    at = out
    while not at.exists() and at != at.parent:
        missing.append(at)
        at = at.parent
    return missing


def _undo(made: Iterable[Path]) -> None:
    """Removes the folders of a conversion that failed; empty folders of the user's own stay."""
    for folder in sorted(made, key=lambda p: len(p.parts), reverse=True):
        try:
            folder.rmdir()
        except OSError:
            continue
