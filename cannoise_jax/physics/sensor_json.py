"""Sensor models on disk: `sensor.json` (schema cannoise/sensor/1) and, beside it, an `.npz` with maps.

A parameter is a number, or {"iso": [...], "value": [...]}. A mechanism with a place of its own in the grammar
carries it. Maps are named in the JSON file, which records the SHA-256 of the `.npz`; nothing is unpickled.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import reprlib
import zipfile
import zlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.grammar import Point
from cannoise_jax.physics.mechanism import Scaling
from cannoise_jax.physics.ranges import is_whole
from cannoise_jax.physics.sensor import IsoTable, SensorModel
from cannoise_jax.recordings.recording import BadInput, per_channel

SCHEMA = "cannoise/sensor/1"
_LARGEST = float(np.finfo(np.float32).max)
_MAY_BE_NULL = ("doubling_c", "reference_iso", "reference_temperature_c")


def write_sensor(path: str | Path, model: SensorModel) -> None:
    """Writes `path` and, where maps were measured, an `.npz` of the same stem, each atomically.

    Raises BadInput where `path` is a folder, or the `.npz` is there and not of the model at `path`.
    """
    path = Path(path)
    if path.is_dir():
        raise BadInput(f"{path}: is a folder: name a file for the sensor model")
    maps: dict[str, Any] = {
        f"{i}/{name}": np.asarray(values, np.float32)
        for i, fitted in enumerate(model.mechanisms)
        for name, values in fitted.maps.items()
    }
    document = sensor_document(model)
    files: dict[Path, bytes] = {}
    if maps:
        content = io.BytesIO()
        np.savez_compressed(content, **maps)
        npz = path.with_suffix(".npz")
        if npz.exists() and not _owns(path, npz):
            raise BadInput(f"{npz}: is there already and holds no maps of {path.name}: choose another name")
        document["maps"] = {"file": npz.name, "sha256": hashlib.sha256(content.getvalue()).hexdigest()}
        files[npz] = content.getvalue()
    files[path] = (json.dumps(document, indent=1) + "\n").encode()
    _replace(files)


def _owns(path: Path, npz: Path) -> bool:
    """Whether the sensor model at `path` names the file as that of its maps."""
    try:
        return json.loads(path.read_text())["maps"]["file"] == npz.name
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _replace(files: dict[Path, bytes]) -> None:
    """Writes all files beside their places first, so that a full disk leaves what was there as it was."""
    temporary = {path: path.with_name(f".{path.name}.{os.getpid()}.tmp") for path in files}
    try:
        for path, content in files.items():
            temporary[path].write_bytes(content)
        for path in files:
            os.replace(temporary[path], path)
    except OSError as error:
        for path in temporary.values():
            path.unlink(missing_ok=True)
        name = list(files)[-1]
        raise BadInput(f"{name}: cannot be written ({error.strerror}): choose another place") from error


def sensor_document(model: SensorModel) -> dict[str, Any]:
    """The model as plain JSON values; of the maps only the names."""
    rows = zip(*map(np.asarray, (model.iso, model.gain_dn_per_e, model.read_noise_e)), strict=True)
    return {
        "schema": SCHEMA,
        "camera": model.camera,
        "cfa": model.cfa,
        "black_level": _plain(model.black_level),
        "white_level": _plain(model.white_level),
        "code_step": _plain(model.code_step),
        "baseline": [
            {"iso": _plain(iso), "gain_dn_per_e": _plain(gain), "read_noise_e": _plain(read)}
            for iso, gain, read in rows
        ],
        "mechanisms": [_mechanism(i, fitted) for i, fitted in enumerate(model.mechanisms)],
        "unit_key": np.asarray(jax.random.key_data(model.unit_key)).tolist(),
    }


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
        entry["grammar"] = dataclasses.asdict(fitted.point)
    return entry


def read_sensor(path: str | Path) -> SensorModel:
    """The model of a `sensor.json`. Raises BadInput with one line for anything that is not one."""
    path = Path(path)
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror}): name a sensor.json") from error
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: is not JSON ({error}): write it anew with bin/calibrate") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise BadInput(f"{path}: has no schema {SCHEMA}: name a sensor.json written by bin/calibrate")
    try:
        return _model(document, _read_maps(path, document))
    except KeyError as error:
        raise BadInput(f"{path}: lacks the entry {error}: add it, or write the file anew") from error
    except (TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        if isinstance(error, BadInput):
            raise
        said = (str(error).splitlines() or [type(error).__name__])[0]
        raise BadInput(f"{path}: {said}: correct the entry") from error


def _read_maps(path: Path, document: dict[str, Any]) -> dict[str, np.ndarray]:
    entry = document.get("maps")
    if not entry:
        return {}
    npz = path.with_name(Path(entry["file"]).name)  # beside the JSON file, wherever both were moved
    try:
        content = npz.read_bytes()
    except OSError as error:
        raise BadInput(f"{npz}: cannot be read ({error.strerror}): keep it beside {path.name}") from error
    if hashlib.sha256(content).hexdigest() != entry["sha256"]:
        raise BadInput(
            f"{npz}: is not the file that {path.name} was written with: restore it, or calibrate anew"
        )
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (ValueError, EOFError, OSError, RuntimeError, zipfile.BadZipFile, zlib.error) as error:
        raise BadInput(f"{npz}: holds no plain arrays: write it anew with bin/calibrate") from error


def _number(value: Any, what: str) -> np.float32:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if not plain or not abs(value) <= _LARGEST:  # holds for nan, and for integers of any size
        raise ValueError(f"{what} is {reprlib.repr(value)}, not a finite number")
    return np.float32(value)


def _numbers(values: Any, what: str) -> np.ndarray:
    values = values if isinstance(values, list) else [values]
    return np.array([_number(v, what) for v in values], np.float32)


def _model(document: dict[str, Any], maps: dict[str, np.ndarray]) -> SensorModel:
    rows = document["baseline"]
    if not rows:
        raise ValueError("baseline is empty")
    table = {
        name: [per_channel(_numbers(row[name], name)) for row in rows]
        for name in ("gain_dn_per_e", "read_noise_e")
    }
    model = SensorModel.poisson_gaussian(
        table["gain_dn_per_e"],
        table["read_noise_e"],
        per_channel(_numbers(document["black_level"], "black_level")),
        float(_number(document["white_level"], "white_level")),
        document["cfa"],
        iso=tuple(float(_number(row["iso"], "iso")) for row in rows),
        code_step=float(_number(document.get("code_step", 1), "code_step")),
        camera=str(document["camera"]),
        unit_key=_key(document.get("unit_key")),
    )
    for entry in document["mechanisms"]:
        model = _with_entry(model, entry, maps)
    return model


def _key(data: Any) -> jax.Array | None:
    if data is None:
        return None
    if not isinstance(data, list) or len(data) != 2 or not all(is_whole(v, 2**32 - 1) for v in data):
        raise ValueError(f"unit_key is {reprlib.repr(data)}, not two whole numbers from 0 to 4294967295")
    return jax.random.wrap_key_data(jnp.asarray(np.array(data, np.uint32)))


def _scaling(id: str, law: Any) -> Scaling | None:
    """The scaling law of an entry; None where it states none, so that the mechanism's own holds."""
    if not isinstance(law, dict):
        raise ValueError(f"{id}: scaling is {reprlib.repr(law)}, not numbers by name")
    known = {f.name for f in dataclasses.fields(Scaling)}
    if set(law) - known:
        raise ValueError(f"{id}: scaling knows {', '.join(sorted(known))}, not {', '.join(set(law) - known)}")
    values = {
        name: None if v is None and name in _MAY_BE_NULL else float(_number(v, f"{id}: scaling {name}"))
        for name, v in law.items()
    }
    return Scaling(**values) if values else None  # type: ignore[arg-type]


def _point(id: str, entry: Any) -> Point | None:
    if entry is None:
        return None
    kernel = tuple(float(_number(v, f"{id}: grammar kernel")) for v in entry.get("kernel", ()))
    return Point(**{**entry, "blocks": tuple(entry["blocks"]), "kernel": kernel})


def _with_entry(model: SensorModel, entry: dict[str, Any], maps: dict[str, np.ndarray]) -> SensorModel:
    id = entry["mechanism"]
    parameters = {
        name: IsoTable(_numbers(v["iso"], name), _numbers(v["value"], name))
        if isinstance(v, dict)
        else float(_number(v, name))
        for name, v in entry.get("parameters", {}).items()
    }
    named = entry.get("maps", {}).values()
    missing = [key for key in named if key not in maps or maps[key].dtype.kind not in "fiub"]
    if missing:
        raise ValueError(f"{id}: map {missing[0]} is not in the .npz file, or holds no numbers")
    return model.with_mechanism(
        id,
        scaling=_scaling(id, entry.get("scaling", {})),
        maps={name: jnp.asarray(maps[key]) for name, key in entry.get("maps", {}).items()},
        point=_point(id, entry.get("grammar")),
        **parameters,
    )
