"""Cases: one number gives one folder of inputs, one call, and what must come of it."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from astropy.io import fits

from tests.fuzz.case import Case, Kit
from tests.fuzz.command_cases import (
    broken_model,
    broken_report,
    broken_result,
    broken_sensor,
    denoised,
    judged,
    odd_calibration,
    rewritten_model,
    sampled,
    simulated,
)
from tests.fuzz.damage import ODD_NUMBERS, ODD_VALUES, damaged_bytes, damaged_json
from tests.fuzz.samples import FIELDS, frames, native
from tests.fuzz.wrong_calls import WRONG

_OWN_SUFFIX = ("npy", "npz", "h5", "tif", "png", "pgm")
THINGS = (
    *("fifo", "link", "loop", "folder", "npy", "npz", "h5", "tif", "png", "fits", "pickle", "absent"),
    *("tag", "sidd", "pgm"),
)
LEVELS = ("--black-level", "64", "--white-level", "1023")


def make_case(kit: Kit, seed: int, folder: Path) -> Case:
    """Fills `folder`, which is empty, and says what to call there."""
    rng = random.Random(seed)
    maker = rng.choices([m for m, _ in MAKERS], [weight for _, weight in MAKERS])[0]
    return maker(kit, rng, folder)


def _convert(kind: str, name: str, must: str = "either") -> Case:
    levels = LEVELS if name.endswith((".fits", ".fit", ".fits.gz")) else ()
    return Case(kind, "convert", [f"in/{name}", "out/made.h5", *levels], must)


def _put(kit: Kit, folder: Path, name: str) -> Path:
    """A sound recording, with its side-car, in in/."""
    source, place = kit.recordings[name], folder / "in"
    for path in {source, source.with_suffix(".json")}:
        if path.is_dir():
            shutil.copytree(path, place / path.name)
        elif path.exists():
            shutil.copy(path, place)
    return place / source.name


def broken_file(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """Bytes of a recording's file damaged. One cut short by a tenth or more holds less than it says,
    but for the padding behind the pixels of FITS."""
    name = rng.choice(list(kit.recordings))
    path = _put(kit, folder, name)
    victim = rng.choice(sorted(p for p in path.rglob("*") if p.is_file())) if path.is_dir() else path
    content = victim.read_bytes()
    data, how = damaged_bytes(rng, content)
    victim.write_bytes(data)
    # SIDD states the same twice: the second description is not read.
    needed = "METADATA_RAW_011" not in victim.name
    most = 0.7 if victim.suffix == ".fits" else 0.9
    lost = needed and how in ("cut", "none") and len(data) < most * len(content)
    return _convert(f"file {name}", path.name, "refuse" if lost else "either")


def odd_attribute(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A field of a native recording holds something else, or is not there."""
    fields: dict[str, Any] = dict(FIELDS)
    for name in rng.sample(list(fields), rng.choice((1, 1, 2))):
        fields[name] = rng.choice(ODD_VALUES)
    path = folder / "in" / "odd.h5"
    try:
        native(path, frames(), fields)
    except (TypeError, ValueError, OverflowError, RuntimeError, UnicodeError):  # no attribute of HDF5
        native(path, frames(), {**FIELDS, "cfa": np.arange(12).reshape(3, 4)})
    return _convert("attribute", path.name)


def odd_frames(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """Frames of another type, shape or content."""
    path, stack = folder / "in" / "odd.h5", frames()
    odd: dict[str, Callable[[], np.ndarray]] = {
        "float": lambda: stack.astype(np.float32),
        "signed": lambda: stack.astype(np.int16) - 500,
        "complex": lambda: stack.astype(np.complex64),
        "text": lambda: np.array([b"a", b"b"]),
        "empty": lambda: stack[:0],
        "thin": lambda: stack[:, :0],
        "flat": lambda: stack[0, 0],
        "four": lambda: stack[None],
        "scalar": lambda: np.array(7),
        "wide": lambda: stack.astype(np.uint64) << 40,
        "bool": lambda: stack > 200,
        "compound": lambda: np.zeros(3, [("a", "f4"), ("b", "i4")]),
    }
    name = rng.choice(list(odd))
    native(path, odd[name](), FIELDS)
    return _convert("frames", path.name, "refuse" if name not in ("float", "signed") else "either")


def odd_header(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A keyword of a FITS file holds something else."""
    path = _put(kit, folder, rng.choice(("stack.fits", "packed.fits", "frame.fits.gz")))
    _put_card(rng, path)
    return _convert("header", path.name)


def _put_card(rng: random.Random, path: Path) -> None:
    """Replaces or adds one card of a FITS file's last header, by its bytes."""
    keys = (
        *(
            "BAYERPAT",
            "EXPTIME",
            "GAIN",
            "ISO",
            "CCD-TEMP",
            "IMAGETYP",
            "XBAYROFF",
            "ROWORDER",
            "BSCALE",
            "BZERO",
        ),
        *(
            "SIMPLE",
            "BITPIX",
            "NAXIS",
            "NAXIS1",
            "NAXIS2",
            "PCOUNT",
            "GCOUNT",
            "EXTEND",
            "SATURATE",
            "INSTRUME",
        ),
        *("BUNIT", "DATASEC", "BIASSEC", "EGAIN", "OFFSET"),
    )
    numbers = [v for v in ODD_NUMBERS if v == v and abs(v) < 1e300]
    card = fits.Card(rng.choice(keys), rng.choice([*numbers, -24, -32, True, False, "", "x"]))
    is_packed = path.suffix == ".gz"
    data = bytearray(gzip.decompress(path.read_bytes()) if is_packed else path.read_bytes())
    with contextlib.suppress(Exception):  # not every value makes a card
        line, key = str(card)[:80].encode().ljust(80), card.keyword.encode().ljust(8)
        starts = range(0, len(data) - 80, 80)
        stated = [at for at in starts if data[at : at + 8] == key]
        if stated:
            data[stated[-1] : stated[-1] + 80] = line
        else:
            end = next(at for at in reversed(starts) if data[at : at + 80] == b"END".ljust(80))
            data[end : end + 160] = line + b"END".ljust(80)
    path.write_bytes(gzip.compress(data) if is_packed else bytes(data))


def broken_side_car(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """The JSON file beside a stack damaged, or holding something else."""
    path = _put(kit, folder, rng.choice(("stack.tif", "stack.npy")))
    path.with_suffix(".json").write_text(damaged_json(rng, json.dumps(FIELDS)), errors="surrogatepass")
    return _convert("side-car", path.name)


def odd_thing(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """What is no file, or claims to be far larger than it is. None of it can be used."""
    name = rng.choice(THINGS)
    suffix = {"pickle": "npy", "tag": "tif"}.get(
        name, name if name in _OWN_SUFFIX else rng.choice(("h5", "npy", "fits", "tif", "dng"))
    )
    path = folder / "in" / f"odd.{suffix}"
    side_car = path.with_suffix(".json")
    if suffix in ("npy", "npz", "tif", "png", "pgm"):
        side_car.write_text(json.dumps(FIELDS))
    if name == "fifo":
        os.mkfifo(path)
    elif name == "link":
        path.symlink_to(folder / "in" / "nowhere")
    elif name == "loop":
        path.symlink_to(path.name)
    elif name == "folder":
        path.mkdir()
    elif name == "npy":
        head = "{'descr': '<u2', 'fortran_order': False, 'shape': (1000000, 100000, 100000), }"
        path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head) + 1) + head.encode() + b"\n")
    elif name == "npz":
        import zipfile

        head = "{'descr': '<u2', 'fortran_order': False, 'shape': (1000000, 100000, 100000), }"
        with zipfile.ZipFile(path, "w") as file:
            file.writestr(
                "frames.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head) + 1) + head.encode() + b"\n"
            )
    elif name == "h5":
        with h5py.File(path, "w") as file:  # chunks that were never written read as zeros
            file.create_dataset("frames", shape=(100, 1_000_000, 1_000_000), dtype="u2", chunks=(1, 64, 64))
            for key, value in FIELDS.items():
                file.attrs[key] = value
    elif name == "tif":  # the directory is its own successor
        entry = struct.pack("<HHII", 256, 3, 1, 4) + struct.pack("<HHII", 257, 3, 1, 4)
        path.write_bytes(
            b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 2) + entry + struct.pack("<I", 8)
        )
    elif name == "png":
        head = struct.pack(">IIBBBBB", 2_000_000_000, 2_000_000_000, 16, 0, 0, 0, 0)
        chunk = b"IHDR" + head
        path.write_bytes(
            b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
        )
    elif name == "fits":
        header = {"SIMPLE": "T", "BITPIX": "16", "NAXIS": "2", "NAXIS1": "2000000000", "NAXIS2": "2000000000"}
        cards = [*(f"{key:<8}= {value:>20}" for key, value in header.items()), "END"]
        path = path.with_suffix(".fits")
        path.write_bytes("".join(card.ljust(80) for card in cards).encode().ljust(2880))
    elif name == "tag":  # a width that is text, several numbers, or none
        kind, count, value = rng.choice(((2, 2, b"x\0\0\0"), (3, 2, b"\1\0\2\0"), (5, 1, b"\x08\0\0\0")))
        entries = struct.pack("<HHI", 256, kind, count) + value + struct.pack("<HHII", 257, 3, 1, 4)
        path.write_bytes(b"II*\0" + struct.pack("<IH", 8, 2) + entries + bytes(4) + bytes(64))
    elif name == "pgm":  # gigabytes of which the disk holds none
        with path.open("wb") as file:
            file.truncate(3 << 29)
    elif name == "sidd":
        path = _put(kit, folder, "sidd")
        victim = rng.choice(sorted(p for p in path.iterdir() if "_010" in p.name or "NOISY" in p.name))
        victim.unlink()
        os.mkfifo(victim)
    elif name == "pickle":
        np.save(path, np.array([{"a": 1}, None], object), allow_pickle=True)
    return _convert(f"thing {name}", path.name, "refuse")


def odd_folder(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A night of FITS files of which one is damaged, headed otherwise, or something else."""
    place = folder / "in"
    for path in kit.night.iterdir():
        shutil.copy(path, place)
    victim = rng.choice(sorted(place.iterdir()))
    how = rng.choice(("bytes", "bytes", "header", "header", "kind", "twice", "blank", "foreign", "link"))
    if how == "bytes":
        victim.write_bytes(damaged_bytes(rng, victim.read_bytes())[0])
    elif how == "header":
        _put_card(rng, victim)
    elif how == "kind":
        victim.rename(
            victim.with_name(rng.choice(("x.fits", "master_dark.fits", "a b\n.fits", "flat.FIT.gz")))
        )
    elif how == "twice":
        shutil.copy(victim, victim.with_name("again.fits"))
    elif how == "blank":
        fits.writeto(victim, np.full((24, 32), rng.choice((0, 700, 65535)), np.uint16), overwrite=True)
    elif how == "foreign":
        shutil.copy(kit.recordings[rng.choice(("raw.dng", "stack.npy", "native.h5"))], place)
    else:
        (place / "link.fits").symlink_to("nowhere.fits")
    return Case(
        f"folder {how}", "convert", ["in", "out/night", *(["--dry-run"] if rng.random() < 0.2 else [])]
    )


def wrong_call(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A command line that has to be refused."""
    native(folder / "in" / "a.h5", frames(), FIELDS)
    command = rng.choice(list(WRONG))
    return Case(f"call {command}", command, list(rng.choice(WRONG[command])), "refuse")


MAKERS: tuple[tuple[Callable[[Kit, random.Random, Path], Case], float], ...] = (
    (broken_file, 6), (odd_attribute, 2), (odd_frames, 1), (odd_header, 1.5), (broken_side_car, 2),
    (odd_thing, 1.5), (broken_sensor, 3), (broken_model, 1), (broken_result, 1), (wrong_call, 3),
    (odd_folder, 2), (odd_calibration, 0.5), (rewritten_model, 1), (broken_report, 1),
    (judged, 0.2), (simulated, 1), (sampled, 0.3), (denoised, 0.5),
)  # fmt: skip
