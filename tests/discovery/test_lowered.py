"""A simulator with too much of something is handed back with as much as the recordings have."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.simulate import Simulator
from cannoise_jax.discovery.proof.excess import Excess
from cannoise_jax.discovery.proof.judged import Judged
from cannoise_jax.discovery.proof.lowered import lowered, shares
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.physics.core.sensor import SensorModel
from tests.discovery.capture import capture_set
from tests.discovery.test_compare_bank import rows

KEY = jax.random.key(4)


def sensor(rows_dn, columns_dn=0.0):
    model = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 16383.0, "RGGB").with_mechanism(
        "row_noise", sigma_dn=rows_dn
    )
    return model.with_mechanism("column_noise", sigma_dn=columns_dn) if columns_dn else model


def function_of(model):
    """The same simulator as somebody's own function."""
    return lambda key, clean, settings: model.sample(key, clean, settings)


def row_noise(frames):
    """Temporal spread of the rows of darks, DN, beside what their pixels leave."""
    values = np.asarray(frames, float)
    rest = values - values.mean(0)
    rest -= rest.mean((1, 2), keepdims=True)
    pixel = float(rest.var()) / values.shape[2]
    return float(np.sqrt(max(rest.mean(2).var() * len(values) / (len(values) - 1) - pixel, 0.0)))


def own_sensor(model):
    return model


@pytest.mark.parametrize(
    ("given", "there"),
    [
        (own_sensor, 1.2),
        pytest.param(function_of, 0.0, marks=pytest.mark.slow),
        pytest.param(own_sensor, 0.0, marks=pytest.mark.slow),
        pytest.param(function_of, 1.2, marks=pytest.mark.slow),
    ],
)
def test_what_is_too_much_is_lowered_in_what_is_handed_back(given, there):
    capture = capture_set(71, rows(there) if there else None, kinds="d", frames=12, size=(64, 96))
    found = diagnose(capture, given(sensor(3.0)), KEY)
    assert [e.mechanism for e in found.excess] == ["row_noise"] and found.verdict == "explained"
    handed = [m for m in found.model.mechanisms if m.mechanism == "row_noise"]
    strength = float(handed[0].parameters["sigma_dn"]) if handed else 0.0
    assert strength == pytest.approx(there, abs=0.15)
    assert np.mean(found.model.read_noise_e) == pytest.approx(3.0, rel=0.03)
    assert found.remains is not None and not found.remains.after.differences
    assert found.quality is not None and found.remains.before.differences


def test_what_others_add_to_rows_stays():
    """Of 3.2 DN that the draws show 3 are its own: variances are taken from that."""
    found = [Excess("row_noise", 3.2, 1.5, 0.1, 0.1)]
    own = float(np.sqrt(3.0**2 - (3.2**2 - 1.5**2)))
    assert shares(found, sensor(3.0))["row_noise"] == pytest.approx(own / 3.0)
    assert shares(found)["row_noise"] == pytest.approx(1.5 / 3.2)
    # Less than they add: none of it is left.
    assert shares([Excess("row_noise", 3.2, 0.5, 0.1, 0.1)], sensor(3.0))["row_noise"] == 0.0
    # A strength that does not go with what is seen tells nothing.
    assert shares(found, sensor(0.3))["row_noise"] == pytest.approx(1.5 / 3.2)


def test_lines_of_a_camera_model_have_the_names_that_it_holds():
    names = frozenset({"row_noise", "row_pink_noise", "column_noise", "odd_even_row_noise", "dsnu"})
    judged = Judged(capture_set(71, kinds="d"), "sensor", False)
    assert judged.own_names(names, ENTRIES) == names
    handed = Simulator("sensor", sensor(1.0).sample, True, sensor(1.0))
    judged = dataclasses.replace(judged, handed=handed)
    assert judged.own_names(names, ENTRIES) == names - {"row_pink_noise"}


def test_only_what_is_too_much_is_changed():
    model = sensor(3.0, 2.0)
    share = shares([Excess("row_noise", 3.0, 0.6, 0.1, 0.1), Excess("dsnu", 1.0, 0.0, 0.1, 0.1)])
    less = lowered(model, share)
    assert less is not None
    assert [float(m.parameters["sigma_dn"]) for m in less.mechanisms] == pytest.approx([0.6, 2.0])
    gone = lowered(model, shares([Excess("row_noise", 3.0, 0.1, 0.1, 0.1)]))
    assert gone is not None and [m.mechanism for m in gone.mechanisms] == ["column_noise"]
    assert lowered(model, shares([Excess("dsnu", 1.0, 0.0, 0.1, 0.1)])) is None


def test_a_shape_is_no_strength():
    model = sensor(1.0).with_mechanism("heavy_tails", tukey_lambda=0.05)
    less = lowered(model, {"heavy_tails": 0.5})
    assert less is not None
    (tails,) = (m for m in less.mechanisms if m.mechanism == "heavy_tails")
    assert float(tails.parameters["tukey_lambda"]) == pytest.approx(0.05)
    spread = sensor(1.0).with_mechanism("pixel_read_noise_map", spread=0.4)
    (kept,) = (
        m for m in lowered(spread, {"pixel_read_noise_map": 0.5}).mechanisms if m.mechanism != "row_noise"
    )
    assert float(kept.parameters["spread"]) == pytest.approx(0.2) and not kept.maps
