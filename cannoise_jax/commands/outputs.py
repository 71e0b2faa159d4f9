"""Where results go: refused before the work where they could not be written, or would replace others. Folders
that do not exist are made, with those above them, once there is something to write."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished

if TYPE_CHECKING:
    from cannoise_jax.recordings.recording import Recording


def check_folder(out: Path, names: tuple[str, ...], force: bool, what: str = "the results") -> None:
    """Raises BadInput where files of these names could not be written into a folder, or exist (without
    force). Makes nothing."""
    nearest = _nearest(out)
    if not nearest.is_dir():
        raise BadInput(f"{nearest}: is a file: name a folder for {what}")
    for name in names:
        if (out / name).is_dir():
            raise BadInput(f"{out / name}: is a folder: name another one for {what}")
        if is_finished(out / name) and not force:
            raise BadInput(f"{out / name}: exists: name another folder, or replace it with --force")
    check_takes_files(out, out)


def _nearest(path: Path) -> Path:
    """The path, or what lies nearest above it, that exists."""
    return next(p for p in (path, *path.parents) if p.exists())


def check_file(path: Path, suffix: str, force: bool) -> None:
    """Raises BadInput where a file cannot be written or exists (without force), or has another suffix. Makes
    nothing."""
    if path.suffix.lower() != suffix:
        raise BadInput(f"{path}: --out names a {suffix} file")
    if not (nearest := _nearest(path.parent)).is_dir():
        raise BadInput(f"{nearest}: is a file: name a folder for {path.name}")
    if path.is_dir():
        raise BadInput(f"{path}: is a folder: name a file")
    if is_finished(path) and not force:
        raise BadInput(f"{path}: exists: name another file, or replace it with --force")
    check_takes_files(path.parent, path)


def make_folder(folder: Path) -> None:
    """Makes a folder for results, and those above it. Raises BadInput where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{folder}: cannot be made: {error.strerror}") from error


def check_takes_files(folder: Path, named: Path) -> None:
    """Raises BadInput where a folder, or the nearest one above it that exists, takes no files: of /proc
    permissions do not tell, nor of a full disk."""
    try:
        with tempfile.TemporaryFile(dir=_nearest(folder)):
            pass
    except PermissionError:
        raise BadInput(f"{named}: cannot be written (no permission): name another folder") from None
    except OSError as error:
        raise BadInput(f"{named}: cannot be written ({error.strerror}): name another folder") from None


def line_of(path: Path, recording: Recording) -> str:
    """What is said of a recording that was written."""
    size = "{} x {}".format(*recording.size)
    frames = f"{recording.count} frame{'s' * (recording.count > 1)}"
    return f"{path}: {frames} of {size}, {recording.cfa}, {recording.camera}"
