"""Entries of a cache that are in use: while somebody holds one, nobody removes it.

Whoever reads an entry holds a shared lock on its folder; whoever removes one first takes the lock alone.
Locks end with their process, however it ends, and hold among containers and machines that share a folder.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import tempfile
import time
import weakref
from pathlib import Path
from typing import Any

GOING = ".going-"
"""Names of entries that are being removed."""
_HELD = (errno.EWOULDBLOCK, errno.EACCES)
_UNUSED_S = 24 * 3600.0
"""Where folders cannot be locked: seconds after its last use began from which nobody uses an entry."""


class Lease:
    """Use of a folder, from when it is made until nobody refers to it; a copy in another process takes a
    lease of its own. Raises OSError where there is no such folder."""

    def __init__(self, place: Path):
        self.place = place
        number = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        self._end = weakref.finalize(self, os.close, number)
        try:
            fcntl.flock(number, fcntl.LOCK_SH | fcntl.LOCK_NB)
            held = True
        except OSError as error:
            held = error.errno not in _HELD  # else somebody is removing it
        # The name may belong to another folder by now, or to none.
        if not held or os.fstat(number).st_nlink == 0 or not _is_at(number, place):
            self._end()
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(place))

    def __reduce__(self) -> tuple[Any, ...]:
        return Lease, (self.place,)

    def moved(self, place: Path) -> None:
        """The folder has another name now, the lock stays on it."""
        self.place = place


def remove_unused(place: Path) -> bool:
    """Removes an entry unless somebody holds it, or may; whether it is gone. Nobody sees half of one."""
    try:
        number = os.open(place, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    except FileNotFoundError:
        return True
    except OSError:
        return False
    try:
        try:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in _HELD or time.time() - os.fstat(number).st_mtime < _UNUSED_S:
                return False
        if not _is_at(number, place):
            return False
        # Out of sight first: whoever wants it from now on makes it anew.
        aside = Path(tempfile.mkdtemp(prefix=GOING, dir=place.parent))
        os.replace(place, aside)
        shutil.rmtree(aside, ignore_errors=True)
    except OSError:
        return False
    finally:
        os.close(number)
    return True


def _is_at(number: int, place: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(number), os.stat(place))
    except OSError:
        return False
