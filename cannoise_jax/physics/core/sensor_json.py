"""Sensor models on disk: `sensor.json` (schema cannoise/sensor/1) and, beside it, an `.npz` with maps.

A parameter is a number, or {"iso": [...], "value": [...]}. A mechanism with a place of its own in the grammar
carries it; one from outside the package says where its entry is, which the reader is given: no code is loaded
because a file names it. Maps are named in the JSON file, which records the SHA-256 of the `.npz`; nothing is
unpickled.
"""

from __future__ import annotations

import contextlib
import dataclasses
import glob
import hashlib
import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.camera import Camera
from cannoise_jax.physics.core.mechanism import HasRecord, Scaling
from cannoise_jax.physics.core.sensor_entries import IMPLEMENTATION, Foreign, Model, entry_of, model_of
from cannoise_jax.physics.core.settings import IsoTable, black_levels
from cannoise_jax.recordings.atomic import remove_leftovers
from cannoise_jax.recordings.opened import BROKEN_ARRAYS, check_plain, json_of
from cannoise_jax.recordings.recording import BadInput

SCHEMA = "cannoise/sensor/1"
_LONGEST_NAME = 255
"""Bytes of a file's name: more, and systems refuse to look for it."""


class MissingEntry(BadInput):
    """A stored model has a mechanism from outside the package, and its entry was not given."""

    def __init__(self, path: Path, missing: Foreign) -> None:
        super().__init__(f"{path}: {missing}")
        self._said = f"{path}: has the mechanism {missing.id} from outside the package"

    def not_taken(self, by: str) -> BadInput:
        """The same, where nobody can give an entry. by: who takes none."""
        return BadInput(f"{self._said}, and {by} takes those of the package alone: name a model of these")


def write_sensor(path: str | Path, model: Camera) -> None:
    """Writes `path` and, where maps were measured, an `.npz` of the same stem, each atomically; that of the
    model before goes where there are none now.

    Raises BadInput where `path` is a folder, the `.npz` is there and not of the model at `path`, or the model
    (changed with `dataclasses.replace`, say) holds what would be refused when it is read.
    """
    path = Path(path)
    maps: dict[str, Any] = {
        f"{i}/{name}": np.asarray(values, np.float32)
        for i, fitted in enumerate(model.mechanisms)
        for name, values in fitted.maps.items()
    }
    check_place(path, bool(maps))
    try:
        document = sensor_document(model)
        model_of(model.poisson_gaussian, document, maps, model.mechanisms)
    except (ValueError, TypeError) as error:
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise BadInput(f"{path}: not written, {said}: correct the model") from error
    files: dict[Path, bytes] = {}
    npz = path.with_suffix(".npz")
    if maps:
        content = io.BytesIO()
        np.savez_compressed(content, **maps)
        document["maps"] = {"file": npz.name, "sha256": hashlib.sha256(content.getvalue()).hexdigest()}
        files[npz] = content.getvalue()
    files[path] = (json.dumps(document, indent=1) + "\n").encode()
    stale = not maps and npz.exists() and _owns(path, npz)
    _replace(files)
    if stale:
        npz.unlink()


def check_place(path: Path, maps: bool = True) -> None:
    """Raises BadInput where `write_sensor` would not write a model, with maps or without."""
    if path.is_dir():
        raise BadInput(f"{path}: is a folder: name a file for the sensor model")
    if path.suffix.lower() != ".json":  # its maps stand beside it as .npz
        raise BadInput(f"{path}: a sensor model is a .json file: name it so")
    if _is_of_others(path):
        raise BadInput(f"{path}: is there already and is no sensor model: choose another name")
    npz = path.with_suffix(".npz")
    if maps and npz.exists() and not _owns(path, npz):
        raise BadInput(f"{npz}: is there already and holds no maps of {path.name}: choose another name")


def _is_of_others(path: Path) -> bool:
    """Whether a JSON file says something that is no sensor model, as what stands beside recordings does."""
    try:
        said = json_of(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return False
    schema = said.get("schema") if isinstance(said, dict) else None
    return not str(schema).startswith(SCHEMA.rpartition("/")[0])


def _owns(path: Path, npz: Path) -> bool:
    """Whether the sensor model at `path` names the file as that of its maps."""
    try:
        return json_of(path.read_text(encoding="utf-8-sig"))["maps"]["file"] == npz.name
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return False


def _replace(files: dict[Path, bytes]) -> None:
    """Writes all files beside their places first, so that a full disk leaves what was there as it was.

    The JSON file, which is last, goes in place first: should the maps not follow, `_read_maps` finds them.
    """
    temporary = {path: path.with_name(f".{path.name}.{os.getpid()}.partial") for path in files}
    try:
        for path, content in files.items():
            temporary[path].write_bytes(content)
        for path in reversed(files):
            os.replace(temporary[path], path)
        for path in files:
            remove_leftovers(path)
    except OSError as error:
        for path in temporary.values():
            path.unlink(missing_ok=True)
        name = list(files)[-1]
        raise BadInput(f"{name}: cannot be written ({error.strerror}): choose another place") from error


def _not_in_place(npz: Path, wanted: str) -> bytes:
    """The maps of a writer that was killed before they were in place; nothing where there are none."""
    for left in sorted(npz.parent.glob(f".{glob.escape(npz.name)}.*.partial")):
        with contextlib.suppress(OSError):
            content = left.read_bytes()
            if hashlib.sha256(content).hexdigest() == wanted:
                return content
    return b""


def sensor_document(model: Camera) -> dict[str, Any]:
    """The model as plain JSON values; of the maps only the names."""
    table = (model.iso, model.gain_dn_per_e, model.read_noise_e, model.black_beyond)
    rows = zip(*map(np.asarray, table), strict=True)
    return {
        "schema": SCHEMA,
        "camera": model.camera,
        "cfa": model.cfa,
        "black_level": _plain(model.black_level),
        "white_level": _plain(model.white_level),
        "code_step": _plain(model.code_step),
        "baseline": [
            {
                "iso": _plain(iso),
                "gain_dn_per_e": _plain(gain),
                "read_noise_e": _plain(read),
                **({"black_level": _plain(black_levels(model)[n])} if np.any(beyond) else {}),
            }
            for n, (iso, gain, read, beyond) in enumerate(rows)
        ],
        "mechanisms": [_mechanism(i, fitted) for i, fitted in enumerate(model.mechanisms)],
        **_unit(model.unit_key),
    }


def _unit(key: jax.Array) -> dict[str, Any]:
    """The key as whole numbers, and the name of its generator where that is not the usual one."""
    name = str(jax.random.key_impl(key))
    numbers = {"unit_key": np.asarray(jax.random.key_data(key)).tolist()}
    return numbers if name == IMPLEMENTATION else {**numbers, "unit_key_impl": name}


def _plain(value) -> Any:
    """Numbers as float64 with the fewest digits that give the same float32."""
    array = np.asarray(value, np.float32)
    flat = [float(np.format_float_positional(v, unique=True)) for v in array.ravel()]
    return flat[0] if array.ndim == 0 else flat


def _mechanism(index: int, fitted) -> dict[str, Any]:
    parameters = {
        name: {"iso": _plain(v.iso), "value": _plain(v.value)} if isinstance(v, IsoTable) else _plain(v)
        for name, v in fitted.parameters.items()
    }
    scaling = {
        f.name: None if (v := getattr(fitted.scaling, f.name)) is None else _plain(v)
        for f in dataclasses.fields(Scaling)
    }
    entry = {
        "mechanism": fitted.mechanism,
        "parameters": parameters,
        "scaling": scaling,
        "maps": {name: f"{index}/{name}" for name in fitted.maps},
    }
    if fitted.point is not None:
        axes = dataclasses.asdict(fitted.point)
        entry["grammar"] = {axis: list(v) if isinstance(v, tuple) else v for axis, v in axes.items()}
    elif fitted.mechanism not in registry.packaged():
        entry["home"] = fitted.record.home
    return entry


def read_model(baseline: Callable[..., Model], path: str | Path, mechanisms: Sequence[HasRecord]) -> Model:
    """What `SensorModel.load` returns. baseline: see `model_of`."""
    if not isinstance(path, str | Path):
        raise BadInput(f"path is of type {type(path).__name__}: give the name of a sensor.json")
    path = Path(path)
    if path.exists():
        check_plain(path, "name a sensor.json")
    try:
        document = json_of(path.read_text(encoding="utf-8-sig"))  # editors on Windows write a mark first
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}): name a sensor.json") from error
    except UnicodeDecodeError as error:
        raise BadInput(f"{path}: is no text in UTF-8: save it as that, or write it anew") from error
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: is not JSON ({error}): write it anew with bin/calibrate") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise BadInput(f"{path}: has no schema {SCHEMA}: name a sensor.json written by bin/calibrate")
    try:
        return model_of(baseline, document, _read_maps(path, document), mechanisms)
    except BadInput:
        raise
    except Foreign as error:
        raise MissingEntry(path, error) from error
    except (TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise BadInput(f"{path}: {said}: correct the entry, or write the file anew") from error


def _read_maps(path: Path, document: dict[str, Any]) -> dict[str, np.ndarray]:
    if document.get("maps") is None:
        return {}
    entry = entry_of(document, "maps", dict)
    # Beside the JSON file, wherever both were moved.
    name = entry_of(entry, "file", str, "maps: ")
    if not name.isprintable() or len(name.encode()) > _LONGEST_NAME:
        raise BadInput(f"{path}: maps: file is {name[:20]!r}...: no name of a file: restore the model")
    npz = path.with_name(Path(name).name or path.stem)
    wanted = entry_of(entry, "sha256", str, "maps: ")
    if npz.exists():
        check_plain(npz, f"keep the maps of {path.name} there")
    try:
        content = npz.read_bytes()
    except OSError as error:
        content = _not_in_place(npz, wanted)
        if not content:
            message = f"{npz}: cannot be read ({error.strerror}): keep it beside {path.name}"
            raise BadInput(message) from error
    if hashlib.sha256(content).hexdigest() != wanted:
        content = _not_in_place(npz, wanted)
    if not content:
        raise BadInput(
            f"{npz}: is not the file that {path.name} was written with: restore it, or calibrate anew"
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (*BROKEN_ARRAYS, RuntimeError) as error:
        raise BadInput(f"{npz}: holds no plain arrays: write it anew with bin/calibrate") from error
