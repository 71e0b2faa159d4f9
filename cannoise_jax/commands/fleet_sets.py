"""What bin/fleet diagnoses and what is done already: the capture sets by name, and the record of those whose
report is there."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from cannoise_jax.recordings.atomic import REPORT_FILES
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished

TABLE = "fleet.json"


class Source(NamedTuple):
    """What a report was made of: the folder of its recordings, links followed, and a stamp of its files."""

    recordings: str
    stamp: str


def source_of(place: Path) -> Source:
    """The recordings in a folder as they are now.

    The stamp is of names, sizes and times of all files below it. To read them would cost as much as a part of
    the diagnosis, of every set at every call; a file that is touched costs one diagnosis.
    """
    from cannoise_jax.recordings.folders.store import facts_of

    own = [(Path(name).relative_to(place), *about) for name, *about in facts_of(place)]
    # Hidden files hold no recordings.
    shown = [(*path.parts, *about) for path, *about in own if not any(p.startswith(".") for p in path.parts)]
    return Source(os.path.realpath(place), hashlib.sha256(repr(shown).encode()).hexdigest())


def sets_of(source: Path) -> dict[str, Path]:
    """The capture sets by name: the folders in a folder, or those that a text file lists, a line each.

    The name is the place below the folder that holds all of them.
    """
    if source.is_dir():
        folders = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
    elif source.is_file():
        try:  # some editors begin a file with a mark of its encoding, which is no part of a name
            listed = source.read_text(encoding="utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise BadInput(f"{source}: is no list of folders: a text file has one a line") from error
        folders = [Path(line.strip()) for line in listed if line.strip() and not line.startswith("#")]
    else:
        raise BadInput(f"{source}: no such folder or list")
    if not folders:
        raise BadInput(f"{source}: holds no folders: put each capture set into one, or list them in a file")
    places = list(dict.fromkeys(Path(os.path.abspath(f)) for f in folders))
    above = os.path.commonpath([p.parent for p in places])
    return {p.relative_to(above).as_posix(): p for p in places}


def check_out(source: Path, sets: Mapping[str, Path], out: Path) -> None:
    """Raises BadInput where reports would lie among the recordings: the next call would read them."""
    own = out.resolve()
    if source.is_dir() and own.is_relative_to(source.resolve()):
        raise BadInput(f"{out}: lies in the folder of the recordings, {source}: name another one for --out")
    for name, place in sets.items():
        there, report = place.resolve(), (out / name).resolve()
        if own.is_relative_to(there) or report.is_relative_to(there) or there.is_relative_to(report):
            raise BadInput(f"{out}: the reports would lie among the recordings of {place}: name another one")


def recorded(sets: Mapping[str, Path], out: Path, flags: list[str], force: bool) -> dict[str, Source]:
    """The recordings of which a folder has reports, by the name of the set, as its table says.

    force: those of `sets` are not among them, nor any of other flags. Raises BadInput for reports of other
    flags, which do not belong in one table, of other recordings, or of no fleet at all.
    """
    path = out / TABLE
    if not path.exists():
        there = [out / name / own for name in sets for own in REPORT_FILES if is_finished(out / name / own)]
        if there and not force:
            raise BadInput(
                f"{there[0]}: exists, and is of no fleet: name another folder, or replace it with --force"
            )
        return {}
    try:
        before, known = _table(path)
    except BadInput:
        if force:
            return {}
        raise
    if force:
        return {n: p for n, p in known.items() if n not in sets} if before == flags else {}
    if before != flags and known:
        words = " ".join(before) or "none"
        raise BadInput(f"{path}: was made with other flags ({words}): name another folder, or use --force")
    for name in sets.keys() & known.keys():
        own = known[name].recordings
        if own != os.path.realpath(sets[name]):
            raise BadInput(
                f"{out / name}: holds the report of {own}, not of {sets[name]}: name another folder, or use "
                "--force"
            )
    return known


def _table(path: Path) -> tuple[list[str], dict[str, Source]]:
    """The flags of a table, and the recordings of its reports. Raises BadInput for what is none."""
    from cannoise_jax.discovery.report.fleet import SCHEMA

    remedy = "name another folder, or replace it with --force"
    try:
        found: Any = json_of(path.read_text(encoding="utf-8"))
        schema, flags = found["schema"], found["flags"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(f"{path}: is no table of a fleet: {remedy}") from error
    if schema != SCHEMA:
        raise BadInput(f"{path}: is of another version of bin/fleet ({str(schema)[:40]!r}): {remedy}")
    try:
        sets = {name: Source(**own) for name, own in found["sets"].items()}
    except (KeyError, TypeError, AttributeError):
        sets, flags = {}, None
    texts = [text for own in sets.values() for text in own]
    if not isinstance(flags, list) or not all(isinstance(text, str) for text in (*flags, *texts)):
        raise BadInput(f"{path}: is no table of a fleet: {remedy}")
    return flags, sets
