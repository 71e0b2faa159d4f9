"""Lists of what works of several files make: what a killed one had made is told from finished files.

While it works, a writer of several files holds a lock on a list, in their folder, of those that were not
there before. A list that nobody holds is of a writer that was killed. Locks end with their process, and
unlike process numbers they hold among containers and machines that share a folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

_NAME = ".unfinished."


class Abandoned(NamedTuple):
    """The list of a work that was killed: its place, when it was written (ns), the files that are on it."""

    place: Path
    began: int
    paths: tuple[Path, ...]

    @property
    def made(self) -> tuple[Path, ...]:
        """Those that are there; what is older than the list is not of its work."""
        return tuple(path for path in self.paths if _since(path, self.began))


def is_finished(path: Path) -> bool:
    """Whether something is at `path` that is no part of a work that was killed."""
    return path.exists() and all(path not in work.made for work in abandoned(path.parent))


def disown(path: Path) -> None:
    """Takes a file off the lists of works that were killed: another one writes it anew."""
    for work in abandoned(path.parent):
        if path in work.paths:
            with contextlib.suppress(OSError):
                work.place.write_text(json.dumps([p.name for p in work.paths if p != path]), encoding="utf-8")
                os.utime(work.place, ns=(work.began, work.began))


def abandoned(folder: Path) -> Iterator[Abandoned]:
    """The lists in a folder that nobody holds."""
    for place in sorted(p for p in folder.glob(f"{_NAME}*") if p.is_file()):
        try:
            with place.open(encoding="utf-8") as file:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                began = os.fstat(file.fileno()).st_mtime_ns
                names = json.load(file)
        except OSError:  # held by a writer at work, or where files cannot be locked
            continue
        except ValueError:  # killed while it wrote the list
            names = []
        plain = [n for n in names if isinstance(n, str) and n == Path(n).name] if type(names) is list else []
        yield Abandoned(place, began, tuple(folder / name for name in plain))


@contextlib.contextmanager
def listed(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """Within it a folder holds the list of these files. Raises OSError where it cannot be written."""
    place = next(p for n in range(10_000) if not (p := folder / f"{_NAME}{os.getpid()}.{n}").exists())
    try:
        with place.open("w", encoding="utf-8") as file:
            with contextlib.suppress(OSError):  # where files cannot be locked no list is believed
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            file.write(json.dumps(list(names)))
            file.flush()
            yield
    finally:
        with contextlib.suppress(OSError):
            place.unlink()


def _since(path: Path, began: int) -> bool:
    try:
        return path.is_file() and path.stat().st_mtime_ns >= began
    except OSError:
        return False
