"""Every entry of a sensor.json, damaged in every way: a model, or one line that names file and entry."""

from __future__ import annotations

import copy
import json
import re

import numpy as np
import pytest

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.core.sensor import IsoTable, SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings import BadInput

REMOVED = object()
WRONG = [
    REMOVED, None, "x", "", True, [], [[1]], ["x"], {}, {"x": 1}, -1, 0, -1.5, 1e308, -1e308, 10**400,
    float("nan"), float("inf"), [1, 2, 3], [None] * 4,
]  # fmt: skip
PYTHON = re.compile(
    r"Error|NoneType|unhashable|subscriptable|iterable|__init__|argument|object|attribute|dtype|shapes?\b.*\("
)


def model():
    table = IsoTable(np.array([100.0, 400.0]), np.array([0.3, 0.9]))
    base = SensorModel.poisson_gaussian([[0.1], [0.4]], [[3.0], [2.0]], (64, 65, 66, 67), 4095, iso=(9, 400))
    camera = base.with_mechanism("row_noise", sigma_dn=table)
    camera = camera.with_mechanism(
        "dark_current", scaling=Scaling(exposure=1.0, doubling_c=6.0, reference_temperature_c=20)
    )
    camera = camera.with_mechanism("dsnu", maps={"field": np.ones((4, 6), np.float32)})
    return camera.with_mechanism("stripes", point=Point("readout", "signal", "column", "redrawn"), sigma_dn=1)


def places(value, path=()):
    """Every place in a document."""
    if path:
        yield path
    inside = dict(enumerate(value)) if isinstance(value, list) else value
    for key, inner in inside.items() if isinstance(inside, dict) else ():
        yield from places(inner, (*path, key))


def damaged(document, path, value):
    changed = copy.deepcopy(document)
    parent = changed
    for key in path[:-1]:
        parent = parent[key]
    if value is REMOVED:
        del parent[path[-1]]
    else:
        parent[path[-1]] = value
    return changed


def complaints(path, document, cases):
    """What is wrong with the answers to damaged documents."""
    wrong = []
    for place, value in cases:
        path.write_text(json.dumps(damaged(document, place, value)))
        try:
            SensorModel.load(path)
        except BadInput as error:
            said = str(error)
            words = [key.rstrip("s") for key in place if isinstance(key, str)]
            named = str(path) in said and any(word in said for word in words) or f"{path.name}" in said
            if "\n" in said or PYTHON.search(said) or not named:
                wrong.append((place, repr(value)[:20], said))
        except Exception as error:
            wrong.append((place, repr(value)[:20], repr(error)))
    return wrong


@pytest.mark.parametrize("every", [4, pytest.param(1, marks=pytest.mark.slow)])
def test_every_damage_is_one_line_or_a_model(every, tmp_path):
    path = tmp_path / "sensor.json"
    write_sensor(path, model())
    document = json.loads(path.read_text())
    cases = [(place, value) for place in places(document) for value in WRONG]
    assert len(cases) > 1000
    found = complaints(path, document, cases[::every])
    assert not found, found[:5]
