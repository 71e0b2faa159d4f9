"""Sensor models on disk: `sensor.json` (schema cannoise/sensor/1) and, beside it, an `.npz` with measured
maps.

A parameter is a number, or {"iso": [...], "value": [...]}. A mechanism without a name carries its place
in the grammar. Maps are named in the JSON file, which records the SHA-256 of the `.npz`; nothing is
unpickled.
"""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.grammar import Point
from cannoise_jax.physics.mechanism import Scaling
from cannoise_jax.physics.sensor import IsoTable, SensorModel
from cannoise_jax.recordings.recording import CFA_PATTERNS, BadInput, per_channel

SCHEMA = "cannoise/sensor/1"


def write_sensor(path: str | Path, model: SensorModel) -> None:
    """Writes `path` and, where maps were measured, an `.npz` of the same stem; both atomically."""
    path = Path(path)
    maps: dict[str, Any] = {
        f"{i}/{name}": np.asarray(values, np.float32)
        for i, fitted in enumerate(model.mechanisms)
        for name, values in fitted.maps.items()
    }
    document = sensor_document(model)
    if maps:
        content = io.BytesIO()
        np.savez_compressed(content, **maps)
        npz = path.with_suffix(".npz")
        document["maps"] = {"file": npz.name, "sha256": hashlib.sha256(content.getvalue()).hexdigest()}
        _replace(npz, content.getvalue())
    _replace(path, (json.dumps(document, indent=1) + "\n").encode())


def _replace(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise BadInput(f"{path}: cannot be written ({error.strerror}): choose another place") from error


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
    except ValueError as error:
        raise BadInput(f"{path}: is not JSON ({error}): write it anew with bin/calibrate") from error
    if not isinstance(document, dict) or document.get("schema") != SCHEMA:
        raise BadInput(f"{path}: has no schema {SCHEMA}: name a sensor.json written by bin/calibrate")
    try:
        return _model(document, _read_maps(path, document))
    except KeyError as error:
        raise BadInput(f"{path}: lacks the entry {error}: add it, or write the file anew") from error
    except (TypeError, ValueError, AttributeError) as error:
        if isinstance(error, BadInput):
            raise
        raise BadInput(f"{path}: {str(error).splitlines()[0]}: correct the entry") from error


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
    except (ValueError, zipfile.BadZipFile) as error:
        raise BadInput(f"{npz}: holds no plain arrays: write it anew with bin/calibrate") from error


def _number(value: Any, what: str) -> np.float32:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f"{what} is {value!r}, not a finite number")
    return np.float32(value)


def _numbers(values: Any, what: str) -> np.ndarray:
    values = values if isinstance(values, list) else [values]
    return np.array([_number(v, what) for v in values], np.float32)


def _model(document: dict[str, Any], maps: dict[str, np.ndarray]) -> SensorModel:
    cfa = document["cfa"]
    if cfa not in CFA_PATTERNS:
        raise ValueError(f"cfa is {cfa!r}, not one of {', '.join(CFA_PATTERNS)}")
    rows = document["baseline"]
    if not rows:
        raise ValueError("baseline is empty")
    table = {}
    for name in ("gain_dn_per_e", "read_noise_e"):
        values = [per_channel(_numbers(row[name], name)) for row in rows]
        if np.min(values) < 0 or (name == "gain_dn_per_e" and np.min(values) == 0):
            raise ValueError(f"{name} must be positive, got {np.min(values):g}")
        table[name] = values
    model = SensorModel.poisson_gaussian(
        table["gain_dn_per_e"] if len(rows) > 1 else table["gain_dn_per_e"][0],
        table["read_noise_e"] if len(rows) > 1 else table["read_noise_e"][0],
        per_channel(_numbers(document["black_level"], "black_level")),
        float(_number(document["white_level"], "white_level")),
        cfa,
        iso=tuple(float(_number(row["iso"], "iso")) for row in rows),
        code_step=float(_number(document.get("code_step", 1), "code_step")),
        camera=str(document["camera"]),
        unit_key=_key(document.get("unit_key")),
    )
    if float(np.max(model.black_level)) >= float(np.asarray(model.white_level)):
        raise ValueError(f"white_level {document['white_level']} is not above black_level")
    for entry in document["mechanisms"]:
        model = _with_entry(model, entry, maps)
    return model


def _key(data: list[int] | None) -> jax.Array | None:
    return None if data is None else jax.random.wrap_key_data(jnp.asarray(data, jnp.uint32))


def _with_entry(model: SensorModel, entry: dict[str, Any], maps: dict[str, np.ndarray]) -> SensorModel:
    id = entry["mechanism"]
    parameters = {
        name: IsoTable(_numbers(v["iso"], name), _numbers(v["value"], name))
        if isinstance(v, dict)
        else float(_number(v, name))
        for name, v in entry.get("parameters", {}).items()
    }
    for name, v in parameters.items():
        if isinstance(v, IsoTable) and np.shape(v.iso) != np.shape(v.value):
            raise ValueError(f"{id}: {name} has {np.size(v.iso)} ISOs and {np.size(v.value)} values")
    known = {f.name for f in dataclasses.fields(Scaling)}
    law = entry.get("scaling") or {}
    if set(law) - known:
        raise ValueError(f"{id}: scaling knows {', '.join(sorted(known))}, not {', '.join(set(law) - known)}")
    missing = [key for key in entry.get("maps", {}).values() if key not in maps]
    if missing:
        raise ValueError(f"{id}: map {missing[0]} is not in the .npz file")
    point = entry.get("grammar")
    model = model.with_mechanism(
        id,
        scaling=Scaling(**law) if law else None,
        maps={name: jnp.asarray(maps[key]) for name, key in entry.get("maps", {}).items()},
        point=None if point is None else Point(**{**point, "blocks": tuple(point["blocks"])}),
        **parameters,
    )
    for parameter in next(f for f in model.mechanisms if f.mechanism == id).record.parameters:
        value = parameters.get(parameter.name, parameter.default)
        numbers = np.asarray(value.value if isinstance(value, IsoTable) else value)
        low, high = numbers.min(), numbers.max()
        if low < parameter.low or high > parameter.high:
            raise ValueError(
                f"{id}: {parameter.name} = {low:g} is outside {parameter.low:g} to {parameter.high:g}"
            )
    return model
