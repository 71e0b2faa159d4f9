"""Reads HDF5 files, and others as those of MATLAB v5, on trial, in a process of its own: a path a line comes
in, an empty line goes out, the first of them before any path.

The file is run, not imported, and needs nothing of the package. What the library raises does not matter
here: the reader meets it again. Where a file takes it too long, or too much memory, this process ends.
"""

from __future__ import annotations

import contextlib
import resource
import sys
import time
from collections.abc import Iterator

import h5py

_CORE_S, _BYTES = 2, 4 << 30
_STRUCTURE = 1 << 30
"""Bytes beside what the process has that all but the frames of a file of HDF5 may take: text whose damaged
length claims gigabytes is given them."""


def touch(path: str) -> None:
    """Follows all structure that a reader follows: attributes, members, and their indexes of chunks."""
    if not h5py.is_hdf5(path):
        import scipy.io  # few files ask for it

        _limit(resource.RLIMIT_AS, _BYTES)
        with _passing():
            scipy.io.loadmat(path, simplify_cells=True)
        return
    _limit(resource.RLIMIT_AS, min(_in_use() + _STRUCTURE, _BYTES))
    with _passing(), h5py.File(path, "r") as file:
        for name in file.attrs:
            with _passing():
                file.attrs[name]
        for name in file:
            with _passing():
                file[name].id.get_num_chunks()


def _in_use() -> int:
    """Bytes of address space; where the system does not say, all that may be."""
    try:
        with open("/proc/self/statm") as file:
            return int(file.read().split()[0]) * resource.getpagesize()
    except OSError:
        return _BYTES


@contextlib.contextmanager
def _passing() -> Iterator[None]:
    try:
        yield
    except Exception as error:
        if isinstance(error, MemoryError) or "memory allocation failed" in str(error):
            sys.exit(1)


def main() -> None:
    print(flush=True)
    for line in sys.stdin:
        _limit(resource.RLIMIT_CPU, int(time.process_time()) + 1 + _CORE_S)
        touch(bytes.fromhex(line).decode(errors="surrogateescape"))
        print(flush=True)


def _limit(what: int, most: int) -> None:
    hard = resource.getrlimit(what)[1]
    resource.setrlimit(what, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


if __name__ == "__main__":
    main()
