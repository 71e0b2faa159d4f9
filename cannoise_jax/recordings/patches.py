"""A store of training patches: fixed-layout records in one ArrayRecord file, and a JSON index beside it.

A record is self-contained: the packed noisy patch in DN (16 bits, exact), its noise-free patch in normalised
units (float32), and what is needed to read them. Patches are somewhat larger than the training size, so that
every epoch can draw other windows and mirror them. Patches stay on disk; the index in memory says which
camera and scene each one is from.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import grain
import numpy as np
from array_record.python.array_record_module import ArrayRecordWriter
from jaxtyping import Float, Int

from cannoise_jax.recordings.atomic import remove_leftovers
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.packing import pack, to_packed_order
from cannoise_jax.recordings.pipeline import Subset
from cannoise_jax.recordings.recording import BadInput, Recording
from cannoise_jax.recordings.references import referenced_frames

SCHEMA = "cannoise/patches/2"
TILE = 66
"""Packed size of stored patches: 64, and two to spare for shifting and mirroring."""
_RECORDS, _INDEX = "patches.array_record", "index.json"


def write_patches(
    folder: str | Path,
    recordings: Sequence[tuple[Recording, str]],
    counts: int | Sequence[int],
    *,
    seed: int,
    tile: int = TILE,
) -> PatchStore:
    """Cuts patches at random frames and even offsets out of recordings with their scene names.

    counts: how many in all, every recording giving the same number, or how many of each recording: see
    `counts_by_split` for a given number of training and of test patches. The noise-free patch is the
    recording's `clean`, or the mean of its other frames. shot and read must be known. Equal arguments give
    equal bytes.
    Raises BadInput, and then leaves nothing behind; also when the folder holds a store already.
    """
    folder = Path(folder)
    if (folder / _INDEX).exists():
        raise BadInput(f"{folder}: holds a patch store already: remove it or name another folder")
    _check(recordings, tile)
    wanted = spread(counts, len(recordings)) if isinstance(counts, int) else list(counts)
    cameras = tuple(dict.fromkeys(recording.camera for recording, _ in recordings))
    scenes = tuple(sorted({scene for _, scene in recordings}))
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        remove_leftovers(folder)
        partial.mkdir(parents=True)
        writer = ArrayRecordWriter(str(partial / _RECORDS), "group_size:1,uncompressed")
        entries = []
        for number, (recording, scene) in enumerate(recordings):
            entry = {"camera": cameras.index(recording.camera), "scene": scenes.index(scene)}
            rng = np.random.default_rng([seed, number])
            for record in _records(recording, entry, wanted[number], rng, tile):
                writer.write(record)
            entries.append(entry | {"iso": recording.iso, "cfa": recording.cfa, "patches": wanted[number]})
        writer.close()
        index = {"schema": SCHEMA, "tile": tile, "cameras": cameras, "scenes": scenes, "recordings": entries}
        (partial / _INDEX).write_text(json.dumps(index, indent=1))
        if (partial / _RECORDS).stat().st_size < sum(wanted) * _layout(tile).itemsize:
            raise OSError("the disk took only a part of the patches")
        os.replace(partial, folder)
    except (OSError, RuntimeError) as error:
        raise BadInput(f"{folder}: cannot be written: {error}") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return open_patches(folder)


def spread(count: int, over: int) -> list[int]:
    """`count` in `over` parts that differ by one at most."""
    return [count * (n + 1) // over - count * n // over for n in range(over)]


def counts_by_split(scenes: Sequence[str], held_out: Collection[str], train: int, test: int) -> list[int]:
    """Patches of each recording, given its scene, so that training and held-out scenes get their totals.

    The paper: 500,000 and 150,000. Raises BadInput when one side has no recording.
    """
    is_test = [scene in held_out for scene in scenes]
    if all(is_test) or not any(is_test):
        known = ", ".join(sorted(set(scenes)))
        raise BadInput(f"holding out {', '.join(held_out)} of the scenes {known} empties a side")
    shares = iter(spread(train, is_test.count(False))), iter(spread(test, is_test.count(True)))
    return [next(shares[side]) for side in is_test]


@dataclass(frozen=True, eq=False)
class PatchStore:
    """A patch source on disk, see `pipeline.PatchSource`.

    One value a patch: camera, scene (indices into `cameras`, `scenes`), iso (0: unknown) and colour order.
    """

    path: str
    tile: int
    cameras: tuple[str, ...]
    scenes: tuple[str, ...]
    camera: Int[np.ndarray, "n"]
    scene: Int[np.ndarray, "n"]
    iso: Float[np.ndarray, "n"]
    orders: np.ndarray

    def __len__(self) -> int:
        return len(self.camera)

    def cfa(self, index: int) -> str:
        """Colour order of the mosaic a patch was packed from."""
        return str(self.orders[int(index)])

    def __getitem__(self, index: int) -> dict[str, np.ndarray]:
        record = np.frombuffer(self._data[int(index)], _layout(self.tile))[0]
        span = record["white"] - record["black"]
        return {
            "noisy": (record["noisy"].astype(np.float32) - record["black"]) / span,
            "clean": record["clean"],
            "shot": record["shot"],
            "read": record["read"],
            "iso": record["iso"],
        }

    @cached_property
    def _data(self) -> Any:
        return grain.sources.ArrayRecordDataSource(str(Path(self.path) / _RECORDS))


def open_patches(folder: str | Path) -> PatchStore:
    """Opens a patch store. Raises BadInput when it is missing, of another kind or cut short."""
    folder = Path(folder)
    try:
        index = json_of((folder / _INDEX).read_text())
        entries = index["recordings"]
        counts = [entry["patches"] for entry in entries]
        store = PatchStore(
            path=str(folder),
            tile=int(index["tile"]),
            cameras=tuple(index["cameras"]),
            scenes=tuple(index["scenes"]),
            camera=np.repeat(np.array([entry["camera"] for entry in entries], np.int32), counts),
            scene=np.repeat(np.array([entry["scene"] for entry in entries], np.int32), counts),
            iso=np.repeat(np.array([entry["iso"] or 0 for entry in entries], np.float32), counts),
            orders=np.repeat(np.array([entry["cfa"] for entry in entries], "U4"), counts),
        )
    except FileNotFoundError as error:
        raise BadInput(f"{folder}: holds no patch store (no {_INDEX})") from error
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(f"{folder / _INDEX}: not a readable index: {error}") from error
    if index.get("schema") != SCHEMA:
        raise BadInput(f"{folder / _INDEX}: schema {index.get('schema')!r}: expected {SCHEMA!r}")
    _check_size(folder / _RECORDS, len(store) * _layout(store.tile).itemsize)
    try:
        stored = len(store._data)
    except (ValueError, RuntimeError, OSError) as error:
        raise BadInput(f"{folder / _RECORDS}: not a readable ArrayRecord file") from error
    if stored != len(store):
        raise BadInput(f"{folder / _RECORDS}: holds {stored} patches, the index says {len(store)}")
    return store


def split_scenes(source: PatchStore, held_out: Collection[str]) -> tuple[Subset, Subset]:
    """(train, test) with disjoint scenes: test holds the scenes named, train all others.

    Raises BadInput for a scene that the store does not hold, or when one side would be empty.
    """
    unknown = sorted(set(held_out) - set(source.scenes))
    if unknown:
        held = ", ".join(source.scenes)
        raise BadInput(f"{source.path}: holds no scene {', '.join(unknown)}: it has {held}")
    numbers = [source.scenes.index(scene) for scene in held_out]
    test = np.isin(source.scene, numbers)
    if test.all() or not test.any():
        raise BadInput(f"{source.path}: holding out {', '.join(held_out)} leaves one side without scenes")
    return Subset(source, np.flatnonzero(~test)), Subset(source, np.flatnonzero(test))


@cache
def _layout(tile: int) -> np.dtype:
    """One record: numbers in packed order, DN, and normalised units."""
    image = (tile, tile, 4)
    return np.dtype(
        [
            ("shot", "<f4", 4),
            ("read", "<f4", 4),
            ("black", "<f4", 4),
            ("white", "<f4"),
            ("iso", "<f4"),
            ("camera", "<i4"),
            ("scene", "<i4"),
            ("noisy", "<u2", image),
            ("clean", "<f4", image),
        ]
    )


def _records(
    recording: Recording, entry: dict[str, int], count: int, rng: np.random.Generator, tile: int
) -> Iterable[bytes]:
    height, width = (n // 2 for n in recording.size)
    frames = rng.integers(recording.count, size=count)
    tops = rng.integers(height - tile + 1, size=count)
    lefts = rng.integers(width - tile + 1, size=count)
    record = np.zeros((), _layout(tile))
    record["shot"] = to_packed_order(np.array(recording.shot), recording.cfa)
    record["read"] = to_packed_order(np.array(recording.read), recording.cfa)
    record["black"] = to_packed_order(np.array(recording.black_level), recording.cfa)
    record["white"], record["iso"] = recording.white_level, recording.iso or 0
    record["camera"], record["scene"] = entry["camera"], entry["scene"]
    for number, noisy, clean in referenced_frames(recording, frames):
        noisy, clean = (pack(image[: 2 * height, : 2 * width], recording.cfa) for image in (noisy, clean))
        for patch in np.flatnonzero(frames == number):
            window = np.s_[tops[patch] : tops[patch] + tile, lefts[patch] : lefts[patch] + tile]
            record["noisy"], record["clean"] = noisy[window], clean[window]
            yield record.tobytes()


def _check(recordings: Sequence[tuple[Recording, str]], tile: int) -> None:
    if not recordings:
        raise BadInput("no recordings to cut patches from")
    for recording, _ in recordings:
        if min(recording.size) < 2 * tile:
            size = "{} x {}".format(*recording.size)
            raise BadInput(f"{recording.path}: {size} pixels: patches of {2 * tile} x {2 * tile} do not fit")
        if recording.shot is None or recording.read is None:
            raise BadInput(f"{recording.path}: shot and read are unknown: estimate them first")


def _check_size(records: Path, least: int) -> None:
    size = records.stat().st_size if records.is_file() else 0
    if size < least:
        raise BadInput(f"{records}: cut short: {size} bytes of at least {least}")
