"""The native format: one HDF5 file per recording, read lazily and written atomically.

Required: dataset `frames`, `uint16[T, H, W]` or uint8, attributes `cfa`, `black_level`, `white_level`.
Optional: dataset `clean` `float32[H, W]` or `[T, H, W]`, and the other fields of `Recording` as attributes of
the same names.
"""

from __future__ import annotations

import dataclasses
import errno
import io
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cannoise_jax.recordings.atomic import remove_leftovers, signals_held
from cannoise_jax.recordings.hdf5 import sound_file
from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.metadata import FIELDS, check_overrides, checked, chunks, make_recording, reading
from cannoise_jax.recordings.opened import Opened, check_claim
from cannoise_jax.recordings.recording import BadInput, Recording

SUFFIXES = (".h5", ".hdf5", ".hdf")


def read_recording(path: str | Path, **overrides: Any) -> Recording:
    """A recording from a native file; its frames, and a clean movie, stay on disk until they are indexed.

    overrides: see `metadata.OVERRIDES`. Raises BadInput for a file that cannot be used.
    """
    check_overrides(overrides)
    opened = open_native(path)
    return make_recording(path, opened.frames, opened.known, overrides)


def open_native(path: str | Path) -> Opened:
    """The frames and attributes of a native file. Raises BadInput."""
    path = Path(path)
    if not path.is_file():
        raise BadInput(f"{path}: no such file")
    with reading(path, "not a readable HDF5 file"), sound_file(path) as file:
        if not isinstance(file.get("frames"), h5py.Dataset):
            raise BadInput(
                f"{path}: holds no dataset 'frames', as files of other programs: save its frames with "
                "numpy.save (uint16, frames x rows x columns) and give that"
            )
        for name in ("frames", "clean"):
            if isinstance(file.get(name), h5py.Dataset):
                check_claim(path, file[name].shape, file[name].dtype.itemsize)
        narrow = file["frames"].dtype == np.uint8
        known = {k: _plain(file.attrs[k]) for k in FIELDS if k in file.attrs}
        if isinstance(file.get("clean"), h5py.Dataset):
            clean = _view(path, file["clean"])
            known["clean"] = clean if clean.ndim == 3 else np.asarray(file["clean"])
        frames = _view(path, file["frames"], widened=True)
    return Opened(frames, known, {"bits": 8} if narrow else {})


def write_recording(
    path: str | Path, recording: Recording, tell: Callable[[int, int], None] = lambda done, all: None
) -> None:
    """Writes a native file: a temporary neighbour first, moved into place when complete. tell: hears how many
    frames are written, of how many.

    Reads the frames in chunks, and between them Ctrl-C is heard. Raises BadInput when it cannot be written,
    or states what no reader takes. Leaves nothing behind then.
    """
    path = Path(path)
    recording = checked(dataclasses.replace(recording, path=str(path)))
    remove_leftovers(path)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        try:
            with _Sink(partial, "w+b") as sink, signals_held() as let_through:
                _write(sink, recording, let_through, tell)
                sink.check()
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        raise BadInput(
            f"{path}: cannot be written: {'no space left on the disk' if full else error.strerror}"
        ) from error


class _Sink(io.FileIO):
    """A file whose failed writes are remembered, not raised: HDF5 may crash after a write that failed."""

    failure: OSError | None = None

    def write(self, data: Any) -> int:
        rest = memoryview(data).cast("B")
        size = len(rest)
        try:
            while self.failure is None and len(rest):
                rest = rest[super().write(rest) :]
        except OSError as error:
            self.failure = error
        return size

    def truncate(self, size: int | None = None) -> int:
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or error
            return size or 0

    def check(self) -> None:
        """Raises what went wrong so far."""
        if self.failure is not None:
            raise self.failure


def _write(
    sink: _Sink, recording: Recording, between: Callable[[], None], tell: Callable[[int, int], None]
) -> None:
    # The newest format has checksums: on damaged headers of the older ones the library may never return.
    with h5py.File(sink, "w", libver="latest") as file:
        for done in _write_dataset(sink, file, "frames", recording.frames, np.dtype(np.uint16)):
            between()
            tell(done, recording.count)
        if recording.clean is not None:
            for _ in _write_dataset(sink, file, "clean", recording.clean, np.dtype(np.float32)):
                between()
        for name in FIELDS:
            value = getattr(recording, name)
            if value is not None:
                file.attrs[name] = np.bytes_(value.encode()) if isinstance(value, str) and value else value


def _write_dataset(sink: _Sink, file: h5py.File, name: str, values: Any, dtype: np.dtype) -> Iterator[int]:
    """Writes the values in parts; after each, how many along the first axis are written."""
    shape = tuple(values.shape)
    chunk = (1, *shape[1:]) if len(shape) == 3 else shape
    target = file.create_dataset(
        name, shape, dtype, chunks=chunk, compression="gzip", compression_opts=1, shuffle=True
    )
    at = 0
    for part in chunks(values):
        target[at : at + len(part)] = part
        at += len(part)
        sink.check()
        yield at


def _view(path: Path, dataset: h5py.Dataset, widened: bool = False) -> LazyArray:
    """widened: codes of 8 bits as those of 16."""
    dtype = dataset.dtype.newbyteorder("=")
    dtype = np.dtype(np.uint16) if widened and dtype == np.uint8 else dtype
    read = partial(_read_dataset, str(path), dataset.name, dtype)
    return LazyArray(read, tuple(dataset.shape), dtype)


def _read_dataset(path: str, name: str, dtype: np.dtype, index: Any) -> np.ndarray:
    with reading(path, f"cannot read {name.lstrip('/')}"), h5py.File(path, "r") as file:
        return np.asarray(file[name][index]).astype(dtype, copy=False)


def _plain(value: Any) -> Any:
    value = value.item() if isinstance(value, np.generic) else value
    return value.decode() if isinstance(value, bytes) else value
