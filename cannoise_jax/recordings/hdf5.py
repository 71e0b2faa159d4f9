"""HDF5 files that the library is safe to read.

On damage in headers without checksums the library may never return, nor be interrupted. Checksums came with
the newest format, which `native` writes; older files, and text of variable length in any of them, have none.
Such files are read on trial by another process first, `hdf5_trial`, which can be ended. So are files of
MATLAB v5, on whose damage SciPy's reader may crash.
"""

from __future__ import annotations

import atexit
import os
import select
import subprocess
import sys
import threading
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py

from cannoise_jax.recordings.recording import BadInput

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_CHECKSUMS = 3
"""The version of the superblock from which on all structure has checksums."""
_WAIT_S = 60.0
"""Until a trial counts as lost whatever it waits for; it ends by itself after some seconds of a core."""
_one_at_a_time = threading.Lock()


def sound_file(path: str | Path) -> h5py.File:
    """A file opened to be read. Raises BadInput for one that the library does not come to an end with."""
    check_returns(path)
    return h5py.File(path, "r")


def check_returns(path: str | Path) -> None:
    """Raises BadInput for a file that the HDF5 library does not come to an end with."""
    version = _version(Path(path))
    if version is None or (version >= _CHECKSUMS and not _has_loose_text(path)):
        return
    _check_trial(path, "the HDF5 library does not come to an end, or takes all memory")


def check_matlab(path: str | Path) -> None:
    """Raises BadInput for a file of MATLAB v5 that SciPy's reader does not survive."""
    _check_trial(path, "the reader of MATLAB v5 files does not survive it")


def _check_trial(path: str | Path, why: str) -> None:
    with _one_at_a_time:
        if not _came_back(path):
            raise BadInput(f"{path}: damaged: {why}")


def _came_back(path: str | Path) -> bool:
    """Whether the process that reads on trial survives this file."""
    try:
        trial = _trial(os.getpid())
        if trial.poll() is not None:  # ended by another hand since the last file
            _trial.cache_clear()
            trial = _trial(os.getpid())
    except OSError:  # it cannot be had here: the file is read without a trial
        return True
    answer = b""
    try:
        trial.stdin.write(os.fsencode(os.path.abspath(path)).hex().encode() + b"\n")
        if select.select([trial.stdout], [], [], _WAIT_S)[0]:
            answer = trial.stdout.readline()
    except BrokenPipeError:
        pass
    finally:  # nor may an answer that comes after Ctrl-C pass for that of the next file
        if not answer:
            _trial.cache_clear()
            _end(trial, os.getpid())
    return bool(answer)


def _version(path: Path) -> int | None:
    """Of the superblock, which stands at 0, 512, 1024 and so on; None where there is none."""
    with path.open("rb") as file:
        at, size = 0, path.stat().st_size
        while at < size:
            file.seek(at)
            head = file.read(len(_SIGNATURE) + 1)
            if head.startswith(_SIGNATURE):
                return head[-1] if len(head) > len(_SIGNATURE) else None
            at = max(2 * at, 512)
    return None


def _has_loose_text(path: str | Path) -> bool:
    """Whether a value among the attributes lies in a heap, which has no checksum in any format."""
    try:
        with h5py.File(path, "r") as file:
            return any(file.attrs.get_id(name).dtype.hasobject for name in file.attrs)
    except Exception:  # the reader says what is wrong with it
        return False


@lru_cache(maxsize=1)
def _trial(owner: int) -> Any:
    """The process that reads on trial, started when the first file asks for it, one for each process."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    trial: Any = subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__).with_name("hdf5_trial.py"))],
        env=environment,
        bufsize=0,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for this process; the other one ends with its input
    )
    atexit.register(_end, trial, owner)
    if not trial.stdout.readline():
        raise OSError("it did not start")
    return trial


def _end(trial: Any, owner: int) -> None:
    if os.getpid() == owner:  # not a fork of it
        trial.kill()
        with trial:
            pass
