"""Every file of a folder opened once: what it is, what its values look like, and what is wrong with it."""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.recordings import sidd
from cannoise_jax.recordings.folders.names import counted_up, named_average, named_kind, named_settings
from cannoise_jax.recordings.folders.numerals import counted
from cannoise_jax.recordings.folders.sites import Sites, site_levels
from cannoise_jax.recordings.load import instead_of, is_supported, load_recording, open_file, suffix_of
from cannoise_jax.recordings.metadata import make_recording
from cannoise_jax.recordings.native import SUFFIXES as NATIVE
from cannoise_jax.recordings.opened import Developed, Opened, stated
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import BadInput, PerChannel, iso_of_gain, per_channel
from cannoise_jax.recordings.stated_values import check_sites
from cannoise_jax.recordings.usable import fault_of, is_full

_SAMPLE = 1 << 20
_OF_CODES = ("cfa", "black_level", "white_level")
"""Fields without which a recording cannot be opened."""

Tell = Callable[[int, int], None]


class Shot(NamedTuple):
    """One file, its pixels left where they are.

    name: below the folder. whole: a recording that is complete by itself (native or SIDD) and joins no other.
    said: the kind as the header has it, named: as names have it. medians: of the first frame, mosaic order.
    top: highest value. step: common spacing of the first frame's values (1: none). print: of all pixels.
    levels: median of every frame, DN; None: it holds no noise. about: see `Opened`, and of names
    named, their settings by field, and named_doubts, what is to be said of what they say. pages: the frames
    that are meant, from 0; None: all of them. sites: of the first frame, see `site_levels`.
    """

    path: Path
    name: str
    whole: bool
    shape: tuple[int, ...]
    known: dict[str, Any]
    about: dict[str, Any]
    said: str | None
    named: str | None
    medians: PerChannel
    top: int
    step: int
    print: int
    levels: tuple[float | None, ...] = ()
    pages: tuple[int, ...] | None = None
    sites: Sites = Sites((0.0, 0.0, 0.0, 0.0), 0.0)

    @property
    def frames(self) -> int:
        """How many are meant."""
        return self.shape[0] if self.pages is None else len(self.pages)

    @property
    def title(self) -> str:
        """The name, with the pages that are meant, counted from 1."""
        if self.pages is None:
            return self.name
        word = "page" if len(self.pages) == 1 else "pages"
        return f"{self.name} ({word} {', '.join(str(n + 1) for n in self.pages)})"


class Scan(NamedTuple):
    """The files of a folder. averages: masters and stacks, with the words that say so. failures: why a file
    cannot be used. duds: files whose frames hold no noise, and why. full: those of them that are saturated,
    as shots without levels. unread: of other formats, by suffix.
    links: to folders; they may lead anywhere, in circles too. lost: links to nothing, of no format. pictures:
    in colours, beside raw frames."""

    shots: tuple[Shot, ...]
    averages: tuple[tuple[str, str], ...]
    duds: tuple[tuple[str, str], ...]
    copies: tuple[tuple[str, str], ...]
    failures: tuple[tuple[str, str], ...]
    unread: dict[str, int]
    links: tuple[str, ...]
    lost: tuple[str, ...]
    full: tuple[Shot, ...] = ()
    pictures: tuple[str, ...] = ()


class _Dud(BadInput):
    """A file none of whose frames holds noise; as a shot, where all its pixels are full."""

    def __init__(self, fault: str, full: Shot | None) -> None:
        super().__init__(fault)
        self.full = full


def scan(
    folder: Path,
    leave_out: Iterable[str] = (),
    tell: Tell = lambda n, total: None,
    given: Mapping[str, Any] | None = None,
) -> Scan:
    """Opens every file below a folder. leave_out: patterns of names, with * and ?, to pass over. given:
    fields that the caller states, whatever the files say of them.

    Raises BadInput for a folder that does not exist or holds nothing that can be read.
    """
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder")
    shots, averages, failures, copies, duds = [], [], [], [], []
    full: list[Shot] = []
    unread: dict[str, int] = {}
    links: list[str] = []
    lost: list[str] = []
    developed: list[tuple[str, str]] = []
    leave_out = tuple(leave_out)
    found = list(_files(folder, leave_out, unread, links, lost))
    if not found:
        if leave_out and next(_files(folder, (), {}, [], []), None) is not None:
            raise BadInput(f"{folder}: --leave-out passes over every recording: leave out fewer")
        kinds = f", only {_counted(unread)}" if unread else ""
        remedies = dict.fromkeys(instead_of(suffix) for suffix in sorted(unread))
        remedy = "; ".join(map(str, remedies)) or "see bin/convert --help for the formats"
        raise BadInput(f"{folder}: holds no recordings{kinds}: {remedy}")
    seen: dict[tuple, str] = {}
    counters = counted(str(path.relative_to(folder)) for path in found)
    for number, path in enumerate(found):
        name = str(path.relative_to(folder))
        tell(number, len(found))
        try:
            shot = _shot(path, name, given or {}, counters)
        except _Dud as error:
            duds.append((name, str(error)))
            full += [error.full] if error.full is not None else []
            continue
        except Developed as error:
            developed.append((name, str(error).removeprefix(f"{path}: ")))
            continue
        except BadInput as error:
            named = named_average(Path(name))
            if named:  # averages hold fractions, which no reader takes
                averages.append((name, f"named {named}"))
                continue
            failures.append((name, str(error).removeprefix(f"{path}: ")))
            continue
        named = named_average(Path(name)) if shot.shape[0] == 1 and not shot.whole else None
        if named or shot.about.get("combined"):
            averages.append((name, shot.about.get("combined") or f"named {named}"))
            continue
        key = (shot.shape, shot.print)
        if key in seen and not shot.whole:
            copies.append((name, seen[key]))
            continue
        seen[key] = name
        shots.append(shot)
    tell(len(found), len(found))
    if not shots:  # then they are what was meant
        failures += developed
    good, apart, ends = tuple(shots), tuple(averages), (tuple(links), tuple(lost))
    pictures = tuple(name for name, _ in developed) if shots else ()
    return Scan(
        good, apart, tuple(duds), tuple(copies), tuple(failures), unread, *ends, tuple(full), pictures
    )


def matches(name: str, pattern: str) -> bool:
    """Whether a pattern with * and ? fits a name below the folder, its last part, or one of its folders."""
    parts = Path(name).parts
    return fnmatch(name, pattern) or any(fnmatch(part, pattern) for part in parts)


def unmatched(folder: Path, patterns: Iterable[str]) -> list[str]:
    """The patterns that fit nothing below a folder."""
    left = list(patterns)
    for root, folders, names in os.walk(folder) if left else ():
        found = [(Path(root) / n).relative_to(folder).as_posix() for n in (*folders, *names)]
        left = [p for p in left if not any(matches(name, p) for name in found)]
    return left


def _files(
    folder: Path, leave_out: tuple[str, ...], unread: dict[str, int], links: list[str], lost: list[str]
) -> Iterator[Path]:
    if sidd.is_instance(folder):
        yield folder
        return
    for root, folders, names in os.walk(folder, onerror=partial(_closed, folder, leave_out)):
        base = Path(root)
        instances = [f for f in folders if sidd.is_instance(base / f)]
        folders[:] = sorted((f for f in folders if f[0] != "." and f not in instances), key=counted_up)
        named = ((base / f).relative_to(folder).as_posix() for f in folders if (base / f).is_symlink())
        links += [name for name in named if not any(matches(name, pattern) for pattern in leave_out)]
        for path in (base / n for n in sorted([*names, *instances], key=counted_up)):
            name = str(path.relative_to(folder))
            if path.name.startswith(".") or any(matches(name, pattern) for pattern in leave_out):
                continue
            if path.is_dir() or is_supported(path):
                yield path
            elif path.is_symlink() and not path.exists():
                lost.append(name)
            elif instead_of(suffix_of(path)) is not None:
                unread[suffix_of(path)] = unread.get(suffix_of(path), 0) + 1


def _closed(folder: Path, leave_out: tuple[str, ...], error: OSError) -> None:
    """Raises BadInput for a folder that cannot be read, unless it is to be left out."""
    name = Path(error.filename).relative_to(folder).as_posix()
    if not any(matches(name, pattern) for pattern in leave_out):
        remedy = "make it readable" + (f", or leave it out with --leave-out '{name}'" if name != "." else "")
        raise BadInput(f"{error.filename}: cannot be read ({error.strerror}): {remedy}") from error


def _shot(path: Path, name: str, given: Mapping[str, Any], counters: frozenset[str]) -> Shot:
    whole = path.is_dir() or suffix_of(path) in NATIVE
    if whole:
        recording = load_recording(path, **{n: v for n, v in given.items() if n in _OF_CODES})
        fields = ("camera", "kind", "iso", "exposure_s", "temperature_c", "gain_db", "cfa")
        known = stated({f: getattr(recording, f) for f in fields})
        levels = {"black_level": recording.black_level, "white_level": recording.white_level}
        return Shot(
            *(path, name, True, tuple(recording.frames.shape), known | levels, {}, recording.kind, None),
            *(recording.black_level, 0, 1, hash(name)),
        )
    opened = open_file(path)
    known, about = stated(opened.known), stated(opened.about)
    shape = tuple(opened.frames.shape)
    if len(shape) != 3 or 0 in shape:
        raise BadInput(f"{path}: has shape {shape}: expected one mosaic or a stack of them")
    check_sites(path, known.get("cfa"))
    known = _sound(path, opened, {n: v for n, v in known.items() if n not in given})
    named = named_settings(Path(name), counters)
    doubts = [words for field, words in named.doubts.items() if field not in known and field not in about]
    about |= {"named": named.values, "named_doubts": doubts}
    stated_gain = {"iso", "gain_setting", "gain_db"} & (known.keys() | about)
    for field, value in named.values.items():
        if field in ("gain_setting", "gain_db") and stated_gain:
            continue
        (about if field in ("gain_setting", "binning") else known).setdefault(field, value)
        if field == "gain_db":
            known["iso"] = iso_of_gain(value)
    check, top, first, fault = 0, 0, None, None
    middle: list[float | None] = []
    for number in range(shape[0]):
        frame = np.asarray(opened.frames[number])
        wrong = fault_of(frame)
        middle.append(None if wrong is not None else float(np.median(frame)))
        if wrong is not None:
            fault = fault or wrong
            continue
        first = frame if first is None else first
        check, top = zlib.crc32(np.ascontiguousarray(frame).tobytes(), check), max(top, int(frame.max()))
    dud = first is None
    if first is None:
        first = np.asarray(opened.frames[0])
        top = int(first.max())
    sites = [np.median(first[SITES[s]]) if min(shape[1:]) > 1 else first[0, 0] for s in range(4)]
    shot = Shot(
        *(path, name, False, shape, known, about, known.pop("kind", None)),
        named_kind(Path(name), about.get("object")),
        *(per_channel(np.array(sites)), top, _step(first), check, tuple(middle)),
        sites=site_levels(first),
    )
    if dud:
        raise _Dud(fault or "", shot if is_full(first) else None)
    return shot


def _sound(path: Path, opened: Opened, known: dict[str, Any]) -> dict[str, Any]:
    """What a file states, held to the rules of single files. Raises BadInput."""
    at_least = {"cfa": "MONO", "black_level": 0.0, "white_level": 65536.0}
    recording = make_recording(path, opened.frames, at_least | known, {}, scan=False)
    return {name: getattr(recording, name) for name in known}


def _step(frame: np.ndarray) -> int:
    values = np.flatnonzero(np.bincount(frame.ravel()[:_SAMPLE]))
    return max(int(np.gcd.reduce(values)), 1)


def _counted(counts: dict[str, int]) -> str:
    return ", ".join(f"{count} {suffix}" for suffix, count in sorted(counts.items()))
