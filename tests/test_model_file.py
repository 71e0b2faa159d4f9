"""Model files: what they keep, the sensors that travel in them, and what is refused."""

from __future__ import annotations

import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.model_file import load_model, save_model
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.initial_noise import gaussian, initial_noise_by_camera
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.sampling import Model, make_model, of_camera, sample_noise
from tests.small_model import NLF, READ, SHOT, noisy, scene, small_model

sample = jax.jit(sample_noise)


@pytest.fixture(scope="module")
def model() -> Model:
    return small_model()


def test_a_model_survives_its_file(model, tmp_path):
    save_model(tmp_path / "model.npz", model)
    again = load_model(tmp_path)
    assert jax.tree.structure(again) == jax.tree.structure(model)
    for ours, theirs in zip(jax.tree.leaves(again), jax.tree.leaves(model), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert [p.name for p in tmp_path.iterdir()] == ["model.npz"]


def test_a_function_as_initial_noise_samples_but_is_not_saved(model, tmp_path):
    own = model.replace(initial_noise=gaussian)
    assert sample(own, jax.random.key(1), scene(16, 16), scene(32, 32), NLF).shape == (16, 16, 4)
    with pytest.raises(ValueError, match="function"):
        save_model(tmp_path / "model.npz", own)
    assert not list(tmp_path.iterdir())


def test_a_sensor_travels_inside_the_model(model, tmp_path):
    sensor = SensorModel.from_nlf(SHOT, READ, 64, 1023).with_mechanism("row_noise", sigma_dn=6.0)
    sensor = sensor.with_mechanism("dsnu", sigma_dn=4.0).with_maps((256, 256))
    write_sensor(tmp_path / "sensor.json", sensor)
    own = make_model(
        model.generator_module, model.generator, model.encoder_module, model.encoder,
        initial_noise=f"sensor:{tmp_path / 'sensor.json'}",
    )  # fmt: skip
    save_model(tmp_path / "model.npz", own)
    for path in tmp_path.glob("sensor*"):
        path.unlink()
    again = load_model(tmp_path)
    images = (scene(32, 32), noisy(jax.random.key(2)))
    made = [sample(m, jax.random.key(1), *images, NLF) for m in (own, again, model)]
    np.testing.assert_array_equal(made[0], made[1])
    rows = [float(jnp.std(jnp.mean(n, 1))) for n in made]
    assert rows[0] > 1.5 * rows[2]


@pytest.fixture(scope="module")
def two_sensors(tmp_path_factory):
    """Cameras of one level, the second with rows, and the choice of initial noise that names their files."""
    quiet, striped = (SensorModel.from_nlf(SHOT, READ, 64, 1023, camera=n) for n in ("quiet", "striped"))
    striped = striped.with_mechanism("row_noise", sigma_dn=6.0)
    folder = tmp_path_factory.mktemp("sensors")
    for sensor in (quiet, striped):
        write_sensor(folder / f"{sensor.camera}.json", sensor)
    return (quiet, striped), f"sensor:{folder / 'quiet.json'},{folder / 'striped.json'}"


def test_images_of_a_batch_start_from_the_sensor_of_their_camera(two_sensors):
    sensors, choice = two_sensors
    clean, levels = jnp.stack([scene(32, 32)] * 3), [jnp.full((3, 4), v) for v in NLF]
    key, camera = jax.random.key(1), np.array([1, 0, 1])
    noise, sigma = jax.jit(initial_noise_by_camera(choice))(key, clean, *levels, camera)
    alone = [jax.jit(sensor.n_init())(key, clean, *levels) for sensor in sensors]
    for i, c in enumerate(camera):
        np.testing.assert_allclose(noise[i], alone[c][0][i], atol=1e-6)
        np.testing.assert_allclose(sigma[i], alone[c][1][i], rtol=1e-5)


def test_every_camera_keeps_its_own_sensor(model, two_sensors, tmp_path):
    """The file holds the sensor of each camera; which one draws must be said where there are several."""
    own = make_model(
        model.generator_module, model.generator, model.encoder_module, model.encoder,
        initial_noise=two_sensors[1],
    )  # fmt: skip
    save_model(tmp_path / "model.npz", own)
    again = load_model(tmp_path)
    images = (jax.random.key(1), scene(32, 32), scene(32, 32), NLF)
    rows = [float(jnp.std(jnp.mean(sample(of_camera(again, n), *images), 1))) for n in ("quiet", "striped")]
    assert rows[1] > 1.5 * rows[0]
    with pytest.raises(ValueError, match="quiet, striped: choose one"):
        sample(again, *images)
    with pytest.raises(ValueError, match="third: this model holds the sensors of quiet, striped"):
        of_camera(again, "third")


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"no archive at all"])
def test_a_file_that_is_no_model_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "model.npz").write_bytes(content)
    with pytest.raises(BadInput, match=r"model\.npz: not a readable model") as error:
        load_model(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("header", [b"{'descr': '<f4', 'shape': (3,", b"{'descr': '<f4' \x00)", b"(((("])
def test_a_model_whose_arrays_have_no_readable_header_is_refused(tmp_path, header):
    head = header.ljust(118) + b"\n"
    member = b"\x93NUMPY\x01\x00" + len(head).to_bytes(2, "little") + head
    with zipfile.ZipFile(tmp_path / "model.npz", "w") as archive:
        archive.writestr("description.npy", member)
    with pytest.raises(BadInput, match=r"model\.npz: not a readable model"):
        load_model(tmp_path)


def test_a_pickle_is_not_unpickled(tmp_path):
    np.savez(tmp_path / "model.npz", description=np.array([{"a": 1}], dtype=object))
    with pytest.raises(BadInput):
        load_model(tmp_path)


def test_a_folder_without_a_model_is_refused(tmp_path):
    with pytest.raises(BadInput, match="no such file"):
        load_model(tmp_path)


def test_an_archive_of_another_making_is_refused_in_a_line(tmp_path):
    """Its entries claim a compression that nothing here reads."""
    with zipfile.ZipFile(tmp_path / "model.npz", "w") as archive:
        archive.writestr("a.npy", b"x" * 100)
    data = bytearray((tmp_path / "model.npz").read_bytes())
    for at in (data.index(b"PK\3\4") + 8, data.index(b"PK\1\2") + 10):
        data[at : at + 2] = (77).to_bytes(2, "little")
    (tmp_path / "model.npz").write_bytes(data)
    with pytest.raises(BadInput, match="not a readable model"):
        load_model(tmp_path)


def test_what_is_no_path_is_refused():
    with pytest.raises(BadInput, match=r"workdir is 3: name the folder of a trained model"):
        load_model(3)
