"""Configs as shipped pass; a value that no run could use is named."""

from __future__ import annotations

import json
from pathlib import Path
from runpy import run_path

import pytest
from ml_collections import FrozenConfigDict

from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.check import check_config, check_sensors
from cannoise_jax.training.loop import check_workdir

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@pytest.mark.parametrize("name", [path.stem for path in sorted(CONFIGS.glob("*.py"))])
def test_shipped_configs_pass(name):
    check_config(run_path(str(CONFIGS / f"{name}.py"))["get_config"]())


def test_a_function_may_be_the_initial_noise():
    config = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    config = config.to_dict() | {"initial_noise": lambda key, clean, shot, read: (clean, clean)}
    check_config(FrozenConfigDict(config))


@pytest.mark.parametrize("choice", ["preset:sony_a7s2", "sensor:camera.json", "gaussian"])
def test_a_sensor_model_may_be_the_initial_noise(choice):
    config = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    config.initial_noise = choice
    check_config(config)


def test_several_sensors_must_be_those_of_the_cameras(tmp_path):
    config = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    for name in ("A", "B"):
        write_sensor(tmp_path / f"{name}.json", SensorModel.from_nlf(1e-3, 1e-6, 64, 1023, camera=name))
    config.initial_noise = f"sensor:{tmp_path / 'A.json'},{tmp_path / 'B.json'}"
    check_sensors(config, ("A", "B"))
    with pytest.raises(BadInput, match="sensors of A, B for the cameras B, A: name one file"):
        check_sensors(config, ("B", "A"))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("batch_size", 0),
        ("steps", -1),
        ("patch", 48),
        ("patch", 0),
        ("patch", 96),
        ("width", 0.0),
        ("ema", 1.0),
        ("log_every", 0),
        ("initial_noise", "none"),
        ("critic_condition", "name"),
        ("level", "published"),
        ("compute", "float16"),
        ("loss.quantiles", -1.0),
        ("data.cameras", 0),
        ("optimiser.schedule", "linear"),
        ("optimiser.critic_rate", float("nan")),
        ("loss.penalty", -1.0),
        ("loss.feature_target", "noise"),
        ("loss.triplets", "hard"),
        ("reference", 12),
        ("reference", 128),
        ("data.scenes", 0),
        ("data.per_scene", 8),
    ],
)
def test_nonsense_is_refused_by_name(name, value):
    config = run_path(str(CONFIGS / "default.py"))["get_config"]()
    config.update_from_flattened_dict({name: value})
    with pytest.raises(BadInput, match=f"^config.{name}: .*: use ") as refused:
        check_config(config)
    assert "\n" not in str(refused.value)


def test_a_run_of_before_there_was_a_choice_of_its_arithmetic_goes_on(tmp_path):
    config = run_path(str(CONFIGS / "ci.py"))["get_config"]()
    stored = config.to_dict()
    del stored["compute"]
    (tmp_path / "config.json").write_text(json.dumps(stored))
    check_workdir(config, tmp_path)
    del config.compute
    check_config(config)
