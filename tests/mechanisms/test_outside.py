"""A mechanism from outside the package, as docs/adding_a_mechanism.md shows it."""

import json
import re
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax import SensorModel, Settings
from cannoise_jax.commands import compare as compare_command
from cannoise_jax.commands import simulate
from cannoise_jax.commands.denoise_sources import check_sources
from cannoise_jax.discovery.compare import compare
from cannoise_jax.discovery.frames.simulate import open_simulator
from cannoise_jax.mechanisms import ENTRIES, MECHANISMS
from cannoise_jax.mechanisms.outside import entries_at
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Parameter
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.initial_noise import sensors_of
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.vocabulary import Term
from tests.discovery.capture import capture_set

PAGE = Path(__file__).resolve().parents[2] / "docs" / "adding_a_mechanism.md"
CODE = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)


@pytest.fixture
def droop(tmp_path, monkeypatch):
    """The page's first block as the module that it is said to be."""
    (tmp_path / "droop.py").write_text(CODE[0])
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    yield entries_at("droop:DROOP")[0]
    sys.modules.pop("droop", None)


def test_the_page_works_as_it_stands_in_forty_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert sum(len(block.splitlines()) for block in CODE) <= 45
    assert len([line for block in CODE for line in block.splitlines() if line.strip()]) <= 40
    (tmp_path / "droop.py").write_text(CODE[0])
    monkeypatch.syspath_prepend(tmp_path)
    names: dict = {}
    for block in CODE[1:]:
        exec(compile(block, str(PAGE), "exec"), names)
    frames, again = np.asarray(names["frames"], float), names["again"]
    assert frames.shape == (8, 64, 96)
    drawn = again.sample(jax.random.key(0), np.full((64, 96), 0.1), Settings(frames=8))
    np.testing.assert_array_equal(drawn, frames)
    sys.modules.pop("droop", None)


def test_it_adds_what_its_sampler_says_and_stands_in_the_chain(droop):
    base = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095)
    clean, many = np.full((32, 48), 0.1, np.float32), Settings(frames=400)
    camera = base.with_mechanism("quantization").with_mechanism(droop, sigma_dn=5.0)
    assert [f.mechanism for f in camera.mechanisms] == ["droop", "quantization"]
    with_it, without = (
        np.asarray(m.sample(jax.random.key(1), clean, many), float)
        for m in (base.with_mechanism(droop, sigma_dn=5.0), base)
    )
    rows = (with_it - without).mean(2)
    slopes = rows @ np.linspace(-1, 1, 32) / (np.linspace(-1, 1, 32) ** 2).sum()
    assert slopes.std() / np.sqrt(3) == pytest.approx(5.0, rel=0.15)
    line = slopes[:, None] * np.linspace(-1, 1, 32)
    assert np.abs(rows - line).mean() < 0.1 * np.abs(line).mean()


def test_a_stored_model_is_refused_without_the_entry_in_one_line(droop, tmp_path):
    path = tmp_path / "sensor.json"
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop, sigma_dn=5.0)
    write_sensor(path, camera)
    with pytest.raises(BadInput, match="needs the mechanism droop of droop:DROOP") as error:
        SensorModel.load(path)
    assert str(error.value).startswith(str(path)) and "\n" not in str(error.value)
    document = json.loads(path.read_text())
    for wrong, said in (
        ({"sigma_dn": -1.0}, "outside"),
        ({}, "lacks the parameter"),
        ({"sigma_dn": 1.0, "depth": 2.0}, "no parameter depth"),
    ):
        document["mechanisms"][0]["parameters"] = wrong
        path.write_text(json.dumps(document))
        with pytest.raises(BadInput, match=said):
            SensorModel.load(path, [droop])


def test_simulate_draws_it(droop, tmp_path, capsys):
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop, sigma_dn=30.0)
    write_sensor("sensor.json", camera)
    drawn = ["--sensor", "sensor.json", "--clean", "dark", "--size", "32x48", "--frames", "3", "--out", "out"]
    assert simulate.main(drawn) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert simulate.main([*drawn, "--mechanisms", "droop:DROOP"]) == 0
    (path,) = (tmp_path / "out").glob("*.h5")
    rows = np.asarray(read_recording(path).frames, float).mean(2)
    assert np.ptp(rows, axis=1).max() > 20


def test_its_stored_model_is_a_simulator_where_its_entry_is_given(droop, tmp_path):
    write_sensor("sensor.json", SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop))
    capture = capture_set(3, kinds="d", size=(48, 64))
    with pytest.raises(BadInput, match="needs the mechanism droop"):
        open_simulator("sensor.json", capture)
    opened = open_simulator("sensor.json", capture, (*ENTRIES, droop))
    assert [f.mechanism for f in opened.model.mechanisms] == ["droop"]
    assert compare(capture, "sensor.json", mechanisms=[droop]).bank.label == "sensor.json"


def test_compare_takes_its_stored_model_with_the_flag(droop, tmp_path, capsys):
    write_sensor("sensor.json", SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop))
    (tmp_path / "in").mkdir()
    for recording in capture_set(3, kinds="d", size=(48, 64)).recordings:
        write_recording(tmp_path / "in" / recording.path, recording)
    asked = ["--recordings", "in", "--simulator", "sensor.json"]
    assert compare_command.main(asked) == 2
    assert "as with --mechanisms droop:DROOP" in capsys.readouterr().err.splitlines()[-1]
    assert compare_command.main([*asked, "--mechanisms", "droop:DROOP"]) == 0


def test_what_takes_no_entries_does_not_ask_for_one(droop, tmp_path):
    write_sensor("sensor.json", SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop))
    with pytest.raises(BadInput, match="droop from outside the package, and training takes") as error:
        sensors_of("sensor:sensor.json")
    assert "--mechanisms" not in str(error.value) and "\n" not in str(error.value)


def test_denoise_reads_it_before_it_trains(droop, tmp_path):
    write_sensor("sensor.json", SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop))
    with pytest.raises(BadInput, match="as with --mechanisms droop:DROOP"):
        check_sources({"own": "sensor.json"})
    check_sources({"own": "sensor.json"}, [droop])


def test_a_model_that_does_not_say_whose_its_mechanism_is(droop, tmp_path):
    write_sensor("sensor.json", SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095).with_mechanism(droop))
    document = json.loads(Path("sensor.json").read_text())
    document["mechanisms"][0]["home"] = ""
    Path("sensor.json").write_text(json.dumps(document))
    with pytest.raises(BadInput, match="droop, and does not say whose .* --mechanisms MODULE:NAME"):
        SensorModel.load("sensor.json")


@pytest.mark.parametrize(
    ("place", "said"),
    [
        ("droop", "write MODULE:NAME"),
        ("no_such_module:ENTRIES", "cannot be imported"),
        ("math:ENTRIES", "math has no ENTRIES"),
        ("math:pi", "no entry"),
        ("broken.py:ENTRIES", "NameError: name 'nothing' is not defined"),
        ("unreadable:ENTRIES", "SyntaxError"),
    ],
)
def test_a_place_without_entries_is_refused_in_one_line(place, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "broken.py").write_text("ENTRIES = nothing")
    (tmp_path / "unreadable.py").write_text("ENTRIES = (")
    with pytest.raises(BadInput, match=said) as error:
        entries_at(place)
    assert "\n" not in str(error.value)


def test_a_name_of_the_package_cannot_be_taken(droop):
    import dataclasses

    record = dataclasses.replace(droop.record, id="row_noise")
    base = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095)
    with pytest.raises(ValueError, match="choose another"):
        base.with_mechanism(record)
    with pytest.raises(ValueError, match="place in the grammar"):
        base.with_mechanism(droop, point=Point("readout", "signal", "row", "redrawn"))
    assert base.with_mechanism(MECHANISMS["row_noise"]).mechanisms[0].mechanism == "row_noise"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"sample": None}, "draws nothing"),
        ({"parameters": ()}, "has no strength"),
        ({"scales": "width"}, "has no strength"),
        (
            {"parameters": (Parameter("maps", "DN", 0, 1, 0.5, "spread"),), "scales": "maps"},
            "cannot be named maps",
        ),
        ({"point": Point("readout", "signal", "pixle", "redrawn")}, "over is 'pixle'"),
        ({"point": Point("readout", "signal", "row", "frozne")}, "time is 'frozne'"),
        ({"point": Point("light", "mean", "row", "frozen")}, "stage is 'light'"),
    ],
)
def test_a_record_that_cannot_work_is_refused_in_one_line(droop, change, said):
    import dataclasses

    from cannoise_jax.discovery.search.declare import registered

    record = dataclasses.replace(droop.record, **change)
    base = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095)
    with pytest.raises(ValueError, match=said):
        base.with_mechanism(record)
    with pytest.raises(ValueError, match=said):
        registered(mechanisms=[dataclasses.replace(droop, record=record)])


def test_what_a_sampler_returns_is_checked(droop):
    import dataclasses

    from cannoise_jax.signatures import sampled
    from tests.discovery.looks import RECORDED, white

    def rows_alone(key, x, values, maps, context):
        return x[:, :, 0]

    def broken(key, x, values, maps, context):
        return x * jnp.where(values["sigma_dn"] > 0, jnp.nan, 1.0)

    base, clean = SensorModel.poisson_gaussian(2.0, 3.0, 64, 4095), np.full((32, 48), 0.1, np.float32)
    with pytest.raises(BadInput, match="droop: its sampler returns"):
        base.with_mechanism(dataclasses.replace(droop.record, sample=rows_alone)).sample(
            jax.random.key(0), clean, Settings(frames=2)
        )
    record = dataclasses.replace(droop.record, sample=broken)
    with pytest.raises(BadInput, match="droop: its sampler draws values that are not finite"):
        sampled.learned(record, white(np.random.default_rng(0)), RECORDED)


def test_a_class_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="class 'sensr': one of"):
        Term("droop", "Something.", None, "sensr", "DN", "rms")
