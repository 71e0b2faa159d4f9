"""Files written so that a full disk, or a kill, leaves what was there as it was."""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import signal
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import abandoned, disown, listed

REPORT_FILES = ("report.json", "report.html", "sensor.json")
"""What is written of a diagnosis; stands where JAX is not imported: a command first refuses to replace it."""


def remove_leftovers(path: Path) -> None:
    """Removes what writers of `path` that were killed left beside it, `.NAME.PID.partial`, before it is
    written anew."""
    disown(path)
    _remove_partials(path)


def _remove_partials(path: Path) -> None:
    for left in path.parent.glob(f".{glob.escape(path.name)}.*.partial"):
        number = left.name.removesuffix(".partial").rpartition(".")[2]
        if not number.isdigit() or int(number) == os.getpid() or is_running(int(number)):
            continue
        if left.is_dir():
            shutil.rmtree(left, ignore_errors=True)
        with contextlib.suppress(OSError):
            left.unlink()


def is_running(process: int) -> bool:
    """Whether there is a process of this number."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


@contextlib.contextmanager
def signals_held() -> Iterator[Callable[[], None]]:
    """Within it Ctrl-C and SIGTERM wait until the yielded function is called, or until the end.

    For libraries that call back and cannot bear an exception there: HDF5 drops it, and may then crash.
    Signals without a handler in Python act as ever, and so do all of them outside of the main thread.
    """
    waiting: list[int] = []
    before: dict[int, Any] = {}

    def let_through() -> None:
        while waiting:
            number = waiting.pop()
            before[number](number, None)

    if threading.current_thread() is threading.main_thread():
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        before.update({number: handler for number, handler in handlers.items() if callable(handler)})
    try:
        for number in before:
            signal.signal(number, lambda number, frame: waiting.append(number))
        yield let_through
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    let_through()


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[None]:
    """Makes a folder, and its parents, for the block; where the block fails, those that are empty go again.

    Raises BadInput where none can be made.
    """
    missing = [p for p in (folder, *folder.parents) if not p.exists()]
    try:
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise BadInput(f"{folder}: no folder can be made here ({error.strerror})") from error
        yield
    except BaseException:
        for made in missing:
            with contextlib.suppress(OSError):
                made.rmdir()
        raise


@contextlib.contextmanager
def one_work(paths: Collection[Path]) -> Iterator[None]:
    """The block writes these files into folders that exist: they are finished when it has ended.

    First goes what works that were killed left in the folders. Where the block fails, those of the files that
    were not there before go, and where it is killed the next work removes them. Raises BadInput where a
    folder cannot be written.
    """
    folders = sorted({path.parent for path in paths})
    for folder in folders:
        for work in abandoned(folder):
            for path in work.paths:
                _remove_partials(path)
            for path in (*work.made, work.place):
                with contextlib.suppress(OSError):
                    path.unlink()
    fresh = [path for path in paths if not path.exists()]
    with contextlib.ExitStack() as lists:
        for folder in folders:
            names = [path.name for path in fresh if path.parent == folder]
            try:
                if names:
                    lists.enter_context(listed(folder, names))
            except OSError as error:
                raise BadInput(f"{folder}: cannot be written ({error.strerror}): make room for it") from error
        try:
            yield
        except BaseException:
            for path in fresh:
                path.unlink(missing_ok=True)
            raise


@contextlib.contextmanager
def file_in_place(path: Path) -> Iterator[BinaryIO]:
    """A file beside its place to write to, moved there when the block has ended without an error.

    Raises BadInput where it cannot be written.
    """
    remove_leftovers(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with temporary.open("wb") as file:
            yield file
        os.replace(temporary, path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror}): make room for it") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def texts_in_place(texts: Mapping[Path, str], also: Collection[Path] = ()) -> Iterator[None]:
    """Writes texts beside their places, runs the block, then moves them there: all or none.

    also: files of the same work that the block writes. Raises BadInput where they cannot be written.
    """
    with one_work([*texts, *also]) if len(texts) + len(also) > 1 else contextlib.nullcontext():
        yield from _texts_in_place(texts)


def _texts_in_place(texts: Mapping[Path, str]) -> Iterator[None]:
    for path in texts:
        remove_leftovers(path)
    beside = {path: path.with_name(f".{path.name}.{os.getpid()}.partial") for path in texts}
    try:
        for path, temporary in beside.items():
            try:
                # Names of files need not be UTF-8: what cannot be written of them becomes a question mark.
                temporary.write_text(texts[path], encoding="utf-8", errors="replace")
            except OSError as error:
                raise BadInput(f"{path}: cannot be written ({error.strerror}): make room for it") from error
        yield
        for path, temporary in beside.items():
            os.replace(temporary, path)
    finally:
        for temporary in beside.values():
            temporary.unlink(missing_ok=True)
