"""The entries of a `sensor.json`, checked one by one: from plain JSON values and maps to a sensor model.

Everything that is wrong raises ValueError with one line that names the entry.
"""

from __future__ import annotations

import dataclasses
import reprlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.camera import Camera
from cannoise_jax.physics.core.grammar import Point, bare
from cannoise_jax.physics.core.mechanism import HasRecord, Mechanism, Scaling
from cannoise_jax.physics.core.ranges import LARGEST, check_point, is_whole, not_held
from cannoise_jax.physics.core.settings import IsoTable
from cannoise_jax.recordings.recording import per_channel

Model = TypeVar("Model", bound=Camera)
IMPLEMENTATION = "threefry2x32"
_KEY_WORDS = {IMPLEMENTATION: 2, "rbg": 4, "unsafe_rbg": 4}
_MAY_BE_NULL = ("doubling_c", "reference_iso", "reference_temperature_c")
_KINDS: dict[Any, str] = {str: "text", list: "a list", dict: "entries by name"}


class Foreign(ValueError):
    """A mechanism that is not of the package, and whose entry was not given. id: its name."""

    def __init__(self, id: str, home: str) -> None:
        whose, where = (f" of {home}", home) if home else (", and does not say whose that is", "MODULE:NAME")
        super().__init__(f"needs the mechanism {id}{whose}: give its entry, as with --mechanisms {where}")
        self.id = id


def model_of(
    baseline: Callable[..., Model],
    document: Mapping[str, Any],
    maps: Mapping[str, np.ndarray],
    mechanisms: Sequence[HasRecord] = (),
) -> Model:
    """The model of a document as `sensor_json.sensor_document` makes it, begun by `baseline`, which is
    `SensorModel.poisson_gaussian`; maps: by the names it gives them; mechanisms: those from outside the
    package. Raises Foreign where one is not given."""
    known = {**{m.record.id: m.record for m in mechanisms}, **registry.packaged()}
    rows = [
        _of_kind(row, f"baseline {n}", dict) for n, row in enumerate(entry_of(document, "baseline", list))
    ]
    if not rows:
        raise ValueError("baseline is empty")

    def of_row(n: int, name: str) -> Any:
        return _entry(rows[n], name, f"baseline {n}: ")

    table = {
        name: [_channels(of_row(n, name), f"baseline {n}: {name}") for n in range(len(rows))]
        for name in ("gain_dn_per_e", "read_noise_e")
    }
    black = _channels(_entry(document, "black_level"), "black_level")
    blacks = [
        _channels(row["black_level"], f"baseline {n}: black_level") if "black_level" in row else black
        for n, row in enumerate(rows)
    ]
    model = baseline(
        table["gain_dn_per_e"],
        table["read_noise_e"],
        blacks if any("black_level" in row for row in rows) else black,
        float(_number(_entry(document, "white_level"), "white_level")),
        entry_of(document, "cfa", str),
        iso=tuple(float(_number(of_row(n, "iso"), f"baseline {n}: iso")) for n in range(len(rows))),
        code_step=float(_number(document.get("code_step", 1), "code_step")),
        camera=entry_of(document, "camera", str),
        unit_key=_key(document.get("unit_key"), document.get("unit_key_impl", IMPLEMENTATION)),
    )
    for n, entry in enumerate(entry_of(document, "mechanisms", list)):
        model = _with_entry(model, _of_kind(entry, f"mechanisms {n}", dict), n, maps, known)
    return model


def entry_of(parent: Mapping[str, Any], name: str, kind: type, where: str = "") -> Any:
    """An entry that must be there, of a kind (str, list or dict)."""
    return _of_kind(_entry(parent, name, where), f"{where}{name}", kind)


def _entry(parent: Mapping[str, Any], name: str, where: str = "") -> Any:
    if name not in parent:
        raise ValueError(f"{where}lacks the entry {name!r}")
    return parent[name]


def _of_kind(value: Any, what: str, kind: type) -> Any:
    if not isinstance(value, kind):
        raise ValueError(f"{what} is {reprlib.repr(value)}, not {_KINDS[kind]}")
    return value


def _number(value: Any, what: str) -> np.float32:
    plain = isinstance(value, int | float) and not isinstance(value, bool)
    if not plain or not abs(value) <= LARGEST:  # holds for nan, and for integers of any size
        raise ValueError(f"{what} is {reprlib.repr(value)}, {not_held(value)}")
    return np.float32(value)


def _numbers(values: Any, what: str) -> np.ndarray:
    values = values if isinstance(values, list) else [values]
    return np.array([_number(v, what) for v in values], np.float32)


def _channels(values: Any, what: str) -> tuple[float, float, float, float]:
    numbers = _numbers(values, what)
    if numbers.size not in (1, 4):
        raise ValueError(f"{what} has {numbers.size} numbers: expected 1 or 4 values (mosaic order)")
    return per_channel(numbers)


def _key(data: Any, implementation: Any) -> jax.Array | None:
    if not isinstance(implementation, str) or implementation not in _KEY_WORDS:
        raise ValueError(
            f"unit_key_impl is {reprlib.repr(implementation)}, not one of {', '.join(_KEY_WORDS)}"
        )
    if data is None:
        return None
    words = _KEY_WORDS[implementation]
    if not isinstance(data, list) or len(data) != words or not all(is_whole(v, 2**32 - 1) for v in data):
        raise ValueError(
            f"unit_key is {reprlib.repr(data)}, not {words} whole numbers from 0 to 4294967295 as "
            f"{implementation} has"
        )
    return jax.random.wrap_key_data(jnp.asarray(np.array(data, np.uint32)), impl=implementation)


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
    where, axes = f"{id}: grammar ", dataclasses.fields(Point)
    _of_kind(entry, where.rstrip(), dict)
    unknown = sorted(set(entry) - {a.name for a in axes})
    if unknown:
        raise ValueError(f"{where}knows no {', '.join(unknown)}")
    for axis in axes:
        if axis.default is dataclasses.MISSING:
            _entry(entry, axis.name, where)
        if isinstance(axis.default, str) or axis.default is dataclasses.MISSING:
            _of_kind(entry.get(axis.name, ""), f"{where}{axis.name}", str)
    values = dict(entry)
    for name in ("blocks", "kernel"):
        if name in entry:
            values[name] = tuple(_of_kind(entry[name], f"{where}{name}", list))
    if "kernel" in values:
        values["kernel"] = tuple(float(_number(v, f"{where}kernel")) for v in values["kernel"])
    if "signal" in values:
        values["signal"] = float(_number(values["signal"], f"{where}signal"))
    if values["over"] == "whole":  # as earlier versions wrote it
        values["over"] = "frame"
    return Point(**values)


def _parameter(value: Any, what: str) -> IsoTable | float:
    if not isinstance(value, dict):
        return float(_number(value, what))
    columns = [_numbers(_entry(value, name, f"{what}: "), f"{what}: {name}") for name in ("iso", "value")]
    return IsoTable(*columns)


def _record(id: str, point: Point | None, known: Mapping[str, Mechanism], home: Any) -> Mechanism:
    """The mechanism of an entry."""
    if point is not None:
        check_point(id, point)
        return bare(point, id)
    if id not in known and home is not None:
        raise Foreign(id, _of_kind(home, f"{id}: home", str))
    return known[id] if id in known else registry.mechanism(id)


def _with_entry(
    model: Model,
    entry: dict[str, Any],
    number: int,
    maps: Mapping[str, np.ndarray],
    known: Mapping[str, Mechanism],
) -> Model:
    id = entry_of(entry, "mechanism", str, f"mechanisms {number}: ")
    parameters = {
        name: _parameter(v, f"{id}: {name}")
        for name, v in entry_of(entry, "parameters", dict, f"{id}: ").items()
    }
    reserved = sorted(registry.RESERVED & set(parameters))
    if reserved:
        raise ValueError(f"{id} has no parameter {reserved[0]}")
    point = _point(id, entry.get("grammar"))
    # A typical value is for those who compose a model: a file that leaves one out is damaged.
    record = _record(id, point, known, entry.get("home"))
    parameters = {**{p.name: p.absent for p in record.parameters if p.absent is not None}, **parameters}
    for name in (n for n in record.defaults() if n not in parameters):
        raise ValueError(f"{id} lacks the parameter {name!r}")
    named = _of_kind(entry.get("maps", {}), f"{id}: maps", dict)
    for name, key in named.items():
        if not isinstance(key, str) or key not in maps or maps[key].dtype.kind not in "fiub":
            raise ValueError(
                f"{id}: map {name} is {reprlib.repr(key)}, which is not in the .npz file, or holds no numbers"
            )
    return model.with_mechanism(
        record if point is None else id,
        scaling=_scaling(id, entry.get("scaling", {})),
        maps={name: jnp.asarray(maps[key]) for name, key in named.items()},
        point=point,
        again=True,
        **parameters,
    )
