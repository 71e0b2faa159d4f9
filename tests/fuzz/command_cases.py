"""Cases of models, reports and whole commands: their inputs damaged, beside sound ones."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from tests.fuzz.case import Case, Kit
from tests.fuzz.damage import ODD_NUMBERS, ODD_VALUES, damaged_bytes, damaged_json
from tests.fuzz.samples import FIELDS, frames, native

ODD_STACKS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "zero": lambda s: s * 0,
    "one value": lambda s: np.full_like(s, 300),
    "copies": lambda s: s[[0, 0, 0, 1]],
    "one frame": lambda s: s[:1],
    "white": lambda s: s | 0x3FF,
    "size": lambda s: s[:, :2, :2],
}


def _flat_and_dark(rng: random.Random, place: Path, size: tuple[int, int] = (24, 32)) -> str:
    """Of one camera, of which one states or holds something odd, or is damaged; which of it."""
    draw = np.random.default_rng(1)
    stacks = {"flat": 64 + draw.poisson(200, (4, *size)), "dark": np.rint(draw.normal(64, 3, (4, *size)))}
    fields: dict[str, dict[str, Any]] = {kind: dict(FIELDS, kind=kind) for kind in stacks}
    victim = rng.choice(("flat", "dark"))
    how = rng.choice(("field", "field", "field", "bytes", *ODD_STACKS))
    if how == "field":
        value = rng.choice((*ODD_VALUES, [victim], ["flat", "dark"]))
        fields[victim][rng.choice(list(FIELDS))] = value
    for kind, stack in stacks.items():
        change = ODD_STACKS.get(how, np.asarray) if kind == victim else np.asarray
        path, values = place / f"{kind}.h5", change(stack.astype(np.uint16))
        try:
            native(path, values, fields[kind])
        except (TypeError, ValueError, OverflowError, RuntimeError, UnicodeError):  # no attribute of HDF5
            native(path, values, {**FIELDS, "kind": kind})
    if how == "bytes":
        _spoil(rng, place / f"{victim}.h5")
    return how


def _spoil(rng: random.Random, path: Path) -> None:
    """A file's bytes, or a value of its JSON, damaged."""
    if path.suffix == ".json" and rng.random() < 0.8:
        path.write_text(damaged_json(rng, path.read_text()), errors="surrogatepass")
    else:
        path.write_bytes(damaged_bytes(rng, path.read_bytes())[0])


def _camera(kit: Kit, place: Path) -> list[Path]:
    """The camera model and its maps, copied."""
    return [Path(shutil.copy(path, place)) for path in (kit.sensor, kit.sensor.with_suffix(".npz"))]


def odd_calibration(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A flat and a dark of one camera of which one states or holds something odd."""
    how = _flat_and_dark(rng, folder / "in")
    return Case(f"calibrate {how}", "calibrate", ["--recordings", "in", "--out", "out/sensor.json"])


def judged(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """Recordings, or the camera model that they are held against, damaged."""
    command, simulator = rng.choice(("diagnose", "compare")), "poisson-gaussian"
    (folder / "in" / "r").mkdir()
    _flat_and_dark(rng, folder / "in" / "r", (32, 48))
    if rng.random() < 0.4:
        _spoil(rng, rng.choice(_camera(kit, folder / "in")))
        simulator = f"in/{kit.sensor.name}"
    elif command == "diagnose" and rng.random() < 0.5:
        simulator = "nlf"
    flags = ["--recordings", "in/r", "--out", "out/r", "--simulator", simulator]
    return Case("judged", command, flags, seconds=300.0)


def simulated(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A camera model, or the clean image, damaged; settings out of the way."""
    camera, clean = _camera(kit, folder / "in"), folder / "in" / f"clean.{rng.choice(('npy', 'png', 'h5'))}"
    if clean.suffix == ".npy":
        np.save(clean, np.full((4, 6), 0.3, np.float32))
    elif clean.suffix == ".png":
        Image.fromarray(np.full((4, 6), 90, np.uint8)).save(clean)
    else:
        native(clean, frames()[:, :4, :6], FIELDS)
    _spoil(rng, rng.choice((*camera, clean)))
    odd = [f"{rng.choice(('--iso', '--exposure', '--temperature', '--unit'))}={rng.choice(ODD_NUMBERS)}"]
    flags = ["--sensor", f"in/{kit.sensor.name}", "--clean", f"in/{clean.name}", "--out", "out"]
    return Case("made", "simulate", [*flags, *(odd if rng.random() < 0.3 else [])])


def sampled(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A model, a clean image or the reference damaged."""
    place = folder / "in"
    shutil.copy(kit.model, place / "model.npz")
    np.save(place / "clean.npy", np.full((32, 34), 0.1, np.float32))
    native(place / "reference.h5", frames(), FIELDS)
    _spoil(rng, place / rng.choice(("model.npz", "clean.npy", "reference.h5", "reference.h5")))
    flags = ["--model", "in/model.npz", "--clean", "in/clean.npy", "--out", "out"]
    known = ["--reference", "A", "--iso", "100", "--black-level", "64", "--white-level", "1023"]
    reference = known if rng.random() < 0.3 else ["--reference", "in/reference.h5"]
    return Case("made", "sample", [*flags, *reference], seconds=60.0)


def denoised(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A denoiser or the recording damaged."""
    place = folder / "in"
    shutil.copy(kit.denoiser, place / "d.npz")
    native(place / "r.h5", frames(), FIELDS)
    _spoil(rng, place / rng.choice(("d.npz", "r.h5", "r.h5")))
    flags = ["--denoiser", "in/d.npz", "--recording", "in/r.h5", "--out", "out/d.npy"]
    return Case("made", "denoise", ["apply", *flags])


def broken_sensor(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A sensor.json, or the maps beside it, damaged."""
    (path, maps), must = _camera(kit, folder / "in"), "either"
    if rng.random() < 0.25:
        data, _ = damaged_bytes(rng, maps.read_bytes())
        must = "refuse" if data != maps.read_bytes() else "either"  # they have a checksum
        maps.write_bytes(data)
    else:
        path.write_text(damaged_json(rng, path.read_text()), errors="surrogatepass")
    target = "read:cannoise_jax.physics.core.sensor.SensorModel.load"
    return Case("sensor", target, [f"in/{path.name}"], must)


def broken_model(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A model.npz damaged."""
    content = kit.model.read_bytes()
    data, how = damaged_bytes(rng, content)
    (folder / "in" / "model.npz").write_bytes(data)
    lost = how in ("cut", "none") and len(data) < 0.9 * len(content)
    target = "read:cannoise_jax.model_file.load_model"
    return Case("model", target, ["in/model.npz"], "refuse" if lost else "either")


def rewritten_model(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A model or a denoiser written anew, as a sound ZIP file, with something else in it."""
    source, reader = rng.choice(((kit.model, "load_model"), (kit.denoiser, "load_denoiser")))
    with np.load(source) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice([n for n in arrays if n != "description"])
    value, how = arrays[name], rng.choice(("nan", "scale", "shape", "kind", "gone", "more", "text", "text"))
    if how == "text":
        text = str(arrays["description"])
        arrays["description"] = np.array(damaged_json(rng, text).encode(errors="replace").decode())
    changed: dict[str, Callable[[], Any]] = {
        "nan": lambda: value * np.nan,
        "scale": lambda: value * 2 + 1,
        "shape": lambda: np.ravel(value)[:1],
        "kind": lambda: value.astype(rng.choice((np.complex64, np.float64, np.int32, bool)))[None],
        "more": lambda: np.concatenate([value, value]),
    }
    if how in changed:
        arrays[name] = changed[how]()
    elif how == "gone":
        del arrays[name]
    np.savez(folder / "in" / "m.npz", **arrays)
    must = "either" if how == "text" else "refuse"
    return Case("rewritten", f"read:tests.fuzz.command_cases.{reader}", ["in/m.npz"], must)


def load_model(path: str) -> None:
    from cannoise_jax.model_file import load_model

    load_model(path)


def load_denoiser(path: str) -> None:
    from cannoise_jax.training.denoise import load_denoiser

    load_denoiser(Path(path))


_LINE = {"what": "columns", "time": "fixed", "simulator_has": "too little", "recorded": 1.0, "simulated": 0.5}
REPORT = {
    "schema": "cannoise/diagnosis/2",
    "verdict": "partly explained",
    "inputs": [{"sha256": "0" * 64, "file": "dark.h5", "kind": "dark", "frames": 4}],
    "after": {"two_sample_auc": 0.6, "two_sample_auc_ci90": [0.55, 0.65]},
    "remains": {"after": [{**_LINE, "unit": "DN", "nats": 12.5}]},
}
"""What `bin/compare` reads of a report."""


def broken_report(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """One of two reports of a diagnosis damaged."""
    for name, text in (("a", json.dumps(REPORT)), ("b", damaged_json(rng, json.dumps(REPORT)))):
        (folder / "in" / f"{name}.json").write_text(text, errors="surrogatepass")
    return Case("report", "compare", ["in/a.json", "in/b.json"])


def broken_result(kit: Kit, rng: random.Random, folder: Path) -> Case:
    """A published result damaged."""
    text = damaged_json(rng, kit.result.read_text())
    (folder / "in" / "r.json").write_text(text, errors="surrogatepass")
    home = "tests.fuzz.command_cases.read_published"
    return Case("result", f"read:{home}", ["in/r.json"])


def read_published(path: str) -> None:
    from cannoise_jax.commands.published import read_result

    read_result(Path(path))
