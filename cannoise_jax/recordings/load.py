"""Any supported file or folder into a `Recording`, and a folder of them into a `CaptureSet`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cannoise_jax.recordings import camera_raw, fits, native, pictures, sidd, stacks
from cannoise_jax.recordings.metadata import check_overrides
from cannoise_jax.recordings.opened import HEADERLESS, Opened, check_plain
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

_FORMATS: tuple[tuple[tuple[str, ...], Callable[..., Recording], Callable[..., Opened]], ...] = (
    (native.SUFFIXES, native.read_recording, native.open_native),
    (fits.SUFFIXES, fits.read_fits, fits.open_fits),
    (stacks.TIFF_SUFFIXES, stacks.read_tiff, stacks.open_tiff),
    (stacks.NUMPY_SUFFIXES, stacks.read_numpy, stacks.open_numpy),
    (pictures.SUFFIXES, pictures.read_picture, pictures.open_picture),
    (camera_raw.SUFFIXES, camera_raw.read_camera_raw, camera_raw.open_camera_raw),
)
UNREAD = (
    (
        (
            *(".jpg", ".jpeg", ".heic", ".heif", ".avif", ".gif", ".webp", ".psd", ".xisf"),
            *(".ser", ".avi", ".mp4", ".m4v", ".mov", ".mkv", ".webm", ".wmv", ".mpg", ".mpeg"),
        ),
        "developed pictures and films hold no raw values: give what the camera stored, as camera raw or FITS",
    ),
    ((".bz2", ".xz", ".zst", ".lz4", ".z", ".zip", ".7z", ".rar", ".tar", ".tgz", ".gz"), "unpack them"),
    ((".bin", ".raw8", ".raw10", ".raw12", ".raw14", ".raw16", ".mipiraw", ".bayer"), HEADERLESS),
)
"""Suffixes that people try and no reader takes, and what to do instead."""
_CAMERAS = 3
"""Cameras that a message names with their files."""
_READERS = {suffix: read for suffixes, read, _ in _FORMATS for suffix in suffixes}
_OPENERS = {suffix: open_ for suffixes, _, open_ in _FORMATS for suffix in suffixes}


def supported() -> str:
    """The suffixes of all formats that can be read."""
    return ", ".join(sorted(_READERS))


def load_recording(path: str | Path, **overrides: Any) -> Recording:
    """A recording from a file of any supported format (or a SIDD instance folder).

    overrides: see `metadata.OVERRIDES`. Raises BadInput for a file that cannot be used.
    """
    check_overrides(overrides)
    path = _named(path, "a file")
    _check_file(path)
    if path.is_dir():
        if not sidd.is_instance(path):
            raise BadInput(f"{path}: is a folder, and not a SIDD folder of one scene: name one file in it")
        return sidd.read_sidd(path, **overrides)
    return _READERS[_known_suffix(path)](path, **overrides)


def open_file(path: Path) -> Opened:
    """The frames of a file of any supported format and what it states, not yet judged. Raises BadInput."""
    _check_file(path)
    return _OPENERS[_known_suffix(path)](path)


def suffix_of(path: Path) -> str:
    """The suffix that names the format, lower case: .fits.gz counts as one."""
    last = path.suffix.lower()
    return path.with_suffix("").suffix.lower() + last if last == ".gz" else last


def is_supported(path: Path) -> bool:
    """Whether the suffix is that of a format that can be read, and the file not the maps of a camera model,
    which users keep with the recordings that it was measured on."""
    return suffix_of(path) in _READERS and not _is_of_a_model(path)


def _is_of_a_model(path: Path) -> bool:
    model = path.with_suffix(".json")
    if path.suffix.lower() != ".npz" or not model.is_file():
        return False
    try:
        with model.open("rb") as file:
            return b'"cannoise/sensor/' in file.read(256)
    except OSError:
        return False


def instead_of(suffix: str) -> str | None:
    """What to do instead of giving files of a suffix that is known and not read; None for every other."""
    return next((why for suffixes, why in UNREAD if suffix in suffixes), None)


def _named(path: Any, what: str) -> Path:
    if not isinstance(path, str | Path):
        raise BadInput(f"path is of type {type(path).__name__}: give the name of {what}")
    return Path(path)


def _check_file(path: Path) -> None:
    if not path.exists():
        broken = path.is_symlink()
        raise BadInput(f"{path}: {'a link to nothing' if broken else 'no such file'}")
    if not path.is_dir():
        check_plain(path, "give a file")


def _known_suffix(path: Path) -> str:
    suffix = suffix_of(path)
    if suffix not in _READERS:
        why = instead_of(suffix)
        raise BadInput(f"{path}: " + (why or f"unknown format {suffix!r}: supported are {supported()}"))
    return suffix


def recording_paths(folder: str | Path) -> list[Path]:
    """The recordings of a folder, by suffix, sorted by name. Raises BadInput when there is none."""
    folder = _named(folder, "a folder")
    if not folder.is_dir():
        raise BadInput(f"{folder}: {'is a file: name its folder' if folder.is_file() else 'no such folder'}")
    broken = sorted(p for p in folder.iterdir() if is_supported(p) and not p.exists())
    if broken:
        raise BadInput(f"{broken[0]}: a link to nothing: mend or remove it")
    paths = sorted(p for p in folder.iterdir() if _is_recording(p))
    if not paths:
        below = " itself, only folders: make one set of them with bin/convert"
        said = below if any(p.is_dir() for p in folder.iterdir()) else f": supported are {supported()}"
        raise BadInput(f"{folder}: holds no recordings{said}")
    return paths


def load_capture_set(folder: str | Path, **overrides: Any) -> CaptureSet:
    """All recordings of a folder, sorted by name; files of other formats (side-cars, notes) are passed over.

    overrides apply to every recording. Raises BadInput when one of them cannot be used, when there is none,
    or when they name more than one camera.
    """
    paths = recording_paths(folder)
    recordings = tuple(load_recording(p, **overrides) for p in paths)
    cameras: dict[str, list[str]] = {}
    for path, recording in zip(paths, recordings, strict=True):
        cameras.setdefault(recording.camera, []).append(path.name)
    if len(cameras) > 1:
        raise SeveralCameras(folder, cameras, "one folder a camera")
    return CaptureSet(recordings[0].camera, recordings, str(folder))


class SeveralCameras(BadInput):
    """A folder of recordings of more than one camera. cameras: by name, their files."""

    def __init__(self, folder: str | Path, cameras: Mapping[str, Sequence[str]], remedy: str) -> None:
        self.cameras = cameras
        known = list(cameras.items())
        each = [f"{name}: {called(files)}" for name, files in known[:_CAMERAS]]
        more = [f"{len(known) - _CAMERAS} more"] if len(known) > _CAMERAS else []
        super().__init__(f"{folder}: holds {len(known)} cameras ({'; '.join(each + more)}): {remedy}")


def called(files: Sequence[str]) -> str:
    """Several files in a message."""
    return files[0] + (f" and {len(files) - 1} more" if len(files) > 1 else "")


def _is_recording(path: Path) -> bool:
    named = is_supported(path) and not path.name.startswith(".")
    return (named and path.is_file()) or sidd.is_instance(path)
