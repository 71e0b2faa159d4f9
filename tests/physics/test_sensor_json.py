"""A stored sensor model is the same model, and a damaged file says in one line what is wrong."""

import dataclasses
import json
import os
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import ENTRIES, MECHANISMS
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Scaling
from cannoise_jax.physics.core.sensor import IsoTable, SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import SCHEMA, check_place, sensor_document, write_sensor
from cannoise_jax.recordings import BadInput

SIZE = (8, 10)


def camera() -> SensorModel:
    base = SensorModel.poisson_gaussian(
        [[0.1, 0.11, 0.12, 0.13], [0.4, 0.41, 0.42, 0.43]],
        [[3.0] * 4, [2.0] * 4],
        (64, 64.25, 64.5, 63.1),
        4095,
        "GBRG",
        iso=(100, 400),
        camera="test",
        unit_key=jax.random.key(7),
    )
    return (
        base.with_mechanism("row_noise", sigma_dn=IsoTable(np.array([100.0, 400.0]), np.array([0.3, 0.9])))
        .with_mechanism("prnu", sigma=0.02)
        .with_mechanism(
            "dark_current", scaling=Scaling(exposure=1.0, doubling_c=6.3, reference_temperature_c=20)
        )
        .with_mechanism(
            "stripes",
            point=Point("readout", "signal", "column", "drifting", spectrum="power_law"),
            sigma_dn=0.7,
        )
    )


def assert_same(first: SensorModel, second: SensorModel):
    assert jax.tree.structure(first) == jax.tree.structure(second)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        if jnp.issubdtype(getattr(a, "dtype", np.float32), jax.dtypes.prng_key):
            a, b = jax.random.key_data(a), jax.random.key_data(b)
        np.testing.assert_array_equal(np.asarray(a, np.float32), np.asarray(b, np.float32))


def test_round_trip_with_tables_scaling_grammar_and_maps(tmp_path):
    model = camera().with_maps(SIZE)
    path = tmp_path / "sensor.json"
    write_sensor(path, model)
    again = SensorModel.load(path)
    assert_same(model, again)
    settings = Settings(iso=250, exposure_s=0.1, frames=2)
    clean = np.full(SIZE, 0.2, np.float32)
    key = jax.random.key(3)
    np.testing.assert_array_equal(model.sample(key, clean, settings), again.sample(key, clean, settings))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sensor.json", "sensor.npz"]
    write_sensor(path, camera())
    assert [p.name for p in tmp_path.iterdir()] == ["sensor.json"]  # no maps of a model that is gone


def test_the_earlier_word_for_one_number_a_frame_is_read(tmp_path):
    model = camera().with_mechanism(
        "jumps", point=Point("readout", "signal", "frame", "redrawn"), sigma_dn=2.0
    )
    path = tmp_path / "sensor.json"
    write_sensor(path, model)
    text = path.read_text()
    assert text.count('"over": "frame"') == 1
    path.write_text(text.replace('"over": "frame"', '"over": "whole"'))
    assert_same(model, SensorModel.load(path))


@pytest.mark.parametrize("id", MECHANISMS)
def test_every_mechanism_round_trips(id, tmp_path):
    model = SensorModel.poisson_gaussian(0.5, 2.0, 64, 1023, "RGGB").with_mechanism(id)
    path = tmp_path / "sensor.json"
    write_sensor(path, model)
    assert_same(model, SensorModel.load(path))
    document = json.loads(path.read_text())
    assert document["schema"] == SCHEMA and document == sensor_document(model)
    assert set(document["mechanisms"][0]) >= {"mechanism", "parameters", "scaling", "maps"}


@pytest.mark.parametrize("end", ["low", "high"])
def test_the_ends_of_all_ranges_can_be_stored(end, tmp_path):
    path, base = tmp_path / "sensor.json", SensorModel.poisson_gaussian(0.5, 2.0, 64, 1023, "RGGB")
    for id, record in ((e.id, e.record) for e in ENTRIES):
        values = {p.name: getattr(p, end) for p in record.parameters}
        write_sensor(path, base.with_mechanism(id, **values))
        (fitted,) = SensorModel.load(path).mechanisms
        assert fitted.parameters == pytest.approx(values, rel=1e-6)


def damage(**changes):
    def change(document):
        document.update(changes)

    return change


def mechanism(document, id):
    return next(m for m in document["mechanisms"] if m["mechanism"] == id)


def rename_map(entry, name):
    entry["maps"] = {name: next(iter(entry["maps"].values()))}


@pytest.mark.parametrize("nothing", [3, None])
def test_what_is_no_name_of_a_file_is_refused_in_one_line(nothing):
    with pytest.raises(BadInput, match="give the name of a sensor.json"):
        SensorModel.load(nothing)


def test_a_file_of_something_else_is_not_replaced(tmp_path):
    path = tmp_path / "dark.json"
    path.write_text('{"cfa": "RGGB", "exposure_s": 1.0}')
    with pytest.raises(BadInput, match="dark.json: is there already and is no sensor model"):
        check_place(path)
    for own in ('{"schema": "cannoise/sensor/1"}', "", "{", '{"schema": "cannoise/sensor/9"}'):
        path.write_text(own)
        check_place(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (damage(schema="other/1"), "schema"),
        (damage(cfa="RGBW"), "cfa"),
        (damage(baseline=[]), "baseline is empty"),
        (
            damage(baseline=[{"iso": 100, "gain_dn_per_e": 0, "read_noise_e": 1}]),
            "gain_dn_per_e must be positive",
        ),
        (damage(baseline=[{"iso": 100, "gain_dn_per_e": [1, 2], "read_noise_e": 1}]), "1 or 4 values"),
        (damage(white_level=10), "not above black_level"),
        (damage(white_level="bright"), "not a finite number"),
        (lambda d: d.pop("camera"), "lacks the entry 'camera'"),
        (lambda d: d["mechanisms"][0].update(mechanism="gremlins"), "gremlins"),
        (lambda d: d["mechanisms"][0]["parameters"].update(volume=11), "no parameter volume"),
        (lambda d: d["mechanisms"][0]["parameters"].update(sigma=-0.1), "outside"),
        (lambda d: mechanism(d, "prnu").update(parameters={}), "prnu lacks the parameter 'sigma'"),
        (lambda d: mechanism(d, "prnu").pop("parameters"), "prnu: lacks the entry 'parameters'"),
        (
            lambda d: mechanism(d, "stripes")["parameters"].pop("memory_frames"),
            "stripes lacks the parameter 'memory_frames'",
        ),
        (lambda d: d["mechanisms"][0]["scaling"].update(moon=1.0), "moon"),
        (lambda d: d["mechanisms"][0]["maps"].update(field="9/field"), "not in the .npz"),
        (lambda d: mechanism(d, "prnu")["scaling"].update(gain="x"), "scaling gain is 'x'"),
        (lambda d: mechanism(d, "prnu")["scaling"].update(gain=None), "scaling gain is None"),
        (lambda d: mechanism(d, "prnu")["scaling"].update(exposure=float("nan")), "scaling exposure is nan"),
        (lambda d: mechanism(d, "prnu")["scaling"].update(doubling_c=0), "doubling_c is 0, not above 0"),
        (lambda d: mechanism(d, "prnu")["scaling"].update(reference_exposure_s=0), "not above 0"),
        (lambda d: mechanism(d, "prnu").update(scaling="fast"), "not numbers by name"),
        (lambda d: mechanism(d, "prnu").update(scaling=None), "not numbers by name"),
        (lambda d: mechanism(d, "prnu")["parameters"].update(sigma=10**400), "is a number of 401 digits"),
        (
            lambda d: mechanism(d, "prnu")["parameters"].update(sigma=10**39),
            r"more than 3.4e\+38, the largest",
        ),
        (lambda d: mechanism(d, "prnu")["parameters"].update(sigma=float("inf")), "not a finite number"),
        (lambda d: mechanism(d, "row_noise")["parameters"]["sigma_dn"].update(iso=[400, 100]), "ascend"),
        (lambda d: rename_map(mechanism(d, "prnu"), "wrong"), "maps are wrong, it has field"),
        (lambda d: mechanism(d, "row_noise").update(maps=mechanism(d, "prnu")["maps"]), "it has none"),
        (lambda d: mechanism(d, "stripes")["grammar"].update(over="moon"), "grammar over is 'moon'"),
        (lambda d: mechanism(d, "stripes")["grammar"].update(signal="x"), "grammar signal"),
        (lambda d: mechanism(d, "stripes")["grammar"].update(blocks=[0, 2]), "grammar blocks"),
        (lambda d: mechanism(d, "stripes")["grammar"].update(group=2, phase=2), "grammar group"),
        (damage(unit_key=[-1, 2]), "unit_key"),
        (damage(unit_key=[1, 2, 3]), "unit_key"),
        (damage(unit_key=[10**30, 2]), "unit_key"),
        (damage(unit_key=7), "unit_key"),
        (damage(unit_key_impl="dice"), "unit_key_impl is 'dice'"),
        (damage(unit_key_impl="rbg"), "not 4 whole numbers"),
        (damage(camera=None), "camera is None, not text"),
        (damage(white_level=10**400), "is a number of 401 digits"),
        (damage(white_level=10**39), r"more than 3.4e\+38, the largest"),
        (damage(white_level=65536), "above 65535"),
        (damage(code_step=-1), "code_step -1"),
        (damage(code_step=4095), "code_step 4095"),
        (lambda d: d["baseline"][0].update(iso=0), "iso must be above 0"),
        (lambda d: d["baseline"][0].update(iso=400), "ISOs must ascend"),
        (lambda d: d["maps"].update(sha256="0" * 64), "is not the file"),
        (lambda d: d["maps"].update(file="gone.npz"), "cannot be read"),
        (lambda d: d["maps"].update(file="a" * 5000), "no name of a file: restore the model"),
        (lambda d: d["maps"].update(file="a\0b"), "no name of a file: restore the model"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_damaged_files_are_one_line(change, message, tmp_path):
    path = tmp_path / "sensor.json"
    write_sensor(path, camera().with_maps(SIZE))
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(BadInput, match=message) as caught:
        SensorModel.load(path)
    assert "\n" not in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("implementation", ["threefry2x32", "rbg", "unsafe_rbg"])
def test_the_unit_is_the_same_whatever_the_generator(implementation, tmp_path):
    key = jax.random.key(3, impl=implementation)
    base = SensorModel.poisson_gaussian(0.5, 2.0, 64, 1023, unit_key=key).with_mechanism("dsnu")
    write_sensor(tmp_path / "sensor.json", base)
    again = SensorModel.load(tmp_path / "sensor.json")
    assert_same(base, again)
    assert jax.random.key_impl(again.unit_key) == jax.random.key_impl(key)
    first, second = (m.with_maps(SIZE).mechanisms[0].maps["field"] for m in (base, again))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain_dn_per_e": np.full((2, 4), -1.0)}, "gain_dn_per_e must be positive"),
        ({"gain_dn_per_e": np.full((2, 4), np.nan)}, "gain_dn_per_e is nan"),
        ({"gain_dn_per_e": np.ones((3, 4))}, "not written"),
        ({"read_noise_e": np.ones((2, 3))}, "read_noise_e has 3"),
        ({"iso": np.array([400.0, 100.0])}, "ISOs must ascend"),
        ({"white_level": np.float32(10)}, "not above black_level"),
        ({"black_level": np.ones(3)}, "black_level has 3"),
        ({"code_step": np.float32(-1)}, "code_step -1"),
        ({"cfa": "RGBW"}, "cfa is 'RGBW'"),
        ({"camera": None}, "camera is None"),
        ({"unit_key": jax.random.split(jax.random.key(1), 3)}, "unit_key"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_model_that_could_not_be_read_is_not_written(change, message, tmp_path):
    path = tmp_path / "sensor.json"
    write_sensor(path, camera())
    before = path.read_bytes()
    with pytest.raises(BadInput, match=message) as caught:
        write_sensor(path, dataclasses.replace(camera(), **change))
    assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_files_that_are_no_sensor_model(tmp_path):
    with pytest.raises(BadInput, match="cannot be read"):
        SensorModel.load(tmp_path / "absent.json")
    (tmp_path / "text.json").write_text("hello")
    with pytest.raises(BadInput, match="not JSON"):
        SensorModel.load(tmp_path / "text.json")
    (tmp_path / "wide.json").write_text("{}", encoding="utf-16")
    with pytest.raises(BadInput, match="no text in UTF-8"):
        SensorModel.load(tmp_path / "wide.json")
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(BadInput, match="is no plain file"):
        SensorModel.load(tmp_path / "pipe.json")


def test_a_mark_of_windows_before_the_text_is_passed_over(tmp_path):
    path = tmp_path / "sensor.json"
    write_sensor(path, camera())
    path.write_text(path.read_text(), encoding="utf-8-sig", newline="\r\n")
    assert SensorModel.load(path).cfa == camera().cfa


def test_pickled_maps_are_refused(tmp_path):
    import hashlib

    path = tmp_path / "sensor.json"
    write_sensor(path, camera().with_maps(SIZE))
    np.savez(tmp_path / "sensor.npz", **{"0/field": np.array([{"a": 1}], dtype=object)})
    document = json.loads(path.read_text())
    document["maps"]["sha256"] = hashlib.sha256((tmp_path / "sensor.npz").read_bytes()).hexdigest()
    path.write_text(json.dumps(document))
    with pytest.raises(BadInput, match="no plain arrays"):
        SensorModel.load(path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(SIZE[1], np.float32), "shape"),
        (np.zeros((2, 2, *SIZE), np.float32), "shape"),
        (np.zeros((3, *SIZE), np.float32), "shape"),
        (np.zeros((0, 5), np.float32), "shape"),
        (np.full(SIZE, np.nan, np.float32), "not finite"),
        (np.full(SIZE, "x"), "no numbers"),
    ],
    ids=["1-D", "4-D", "many", "empty", "nan", "text"],
)
def test_maps_that_are_no_finite_images(values, message, tmp_path):
    import hashlib

    path = tmp_path / "sensor.json"
    write_sensor(path, SensorModel.poisson_gaussian(0.5, 2.0).with_mechanism("prnu").with_maps(SIZE))
    np.savez(tmp_path / "sensor.npz", **{"0/field": values})
    document = json.loads(path.read_text())
    document["maps"]["sha256"] = hashlib.sha256((tmp_path / "sensor.npz").read_bytes()).hexdigest()
    path.write_text(json.dumps(document))
    with pytest.raises(BadInput, match=message) as caught:
        SensorModel.load(path)
    assert "\n" not in str(caught.value)


def test_deep_nesting_is_one_line(tmp_path):
    path = tmp_path / "sensor.json"
    path.write_text("[" * 100_000 + "]" * 100_000)
    with pytest.raises(BadInput, match="is not JSON"):
        SensorModel.load(path)


def test_unwritable_place_is_one_line(tmp_path):
    with pytest.raises(BadInput, match="cannot be written"):
        write_sensor(tmp_path / "absent" / "sensor.json", camera())


def test_a_disk_that_fills_up_leaves_both_files_as_they_were(tmp_path, monkeypatch):
    path = tmp_path / "sensor.json"
    maps = {"field": np.ones((4, 6), np.float32)}
    model = SensorModel.poisson_gaussian(2, 3, 64, 1023).with_mechanism("dsnu", maps=maps)
    write_sensor(path, model)
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    write = Path.write_bytes

    def full(self, content):
        if "json" in self.name:
            raise OSError(28, "No space left on device")
        return write(self, content)

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(BadInput, match="No space left"):
        write_sensor(path, model.with_mechanism("prnu", maps={"field": np.full((4, 6), 0.01, np.float32)}))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


@pytest.mark.parametrize("name", ["m.txt", "z.npz", "model"])
def test_a_model_of_another_suffix_is_not_saved(tmp_path, name):
    with pytest.raises(BadInput, match=r"a sensor model is a \.json file"):
        camera().save(tmp_path / name)
    assert not any(tmp_path.iterdir())


def test_a_model_saves_and_loads_itself(tmp_path):
    path = tmp_path / "sensor.json"
    SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 4095.0).with_mechanism("row_noise", sigma_dn=2.0).save(path)
    model = SensorModel.load(path)
    assert float(np.asarray(model.white_level)) == 4095 and len(model.mechanisms) == 1
    with pytest.raises(BadInput, match="exists: name another file, or replace it with force=True"):
        model.save(path)
    model.without("row_noise").save(path, force=True)
    assert not SensorModel.load(path).mechanisms


def test_a_name_of_any_length_is_refused_in_a_line_of_some_length(tmp_path):
    camera = SensorModel.poisson_gaussian(0.5, 3.0, 64, 1023, "RGGB").with_mechanism("prnu", sigma=0.01)
    write_sensor(tmp_path / "s.json", camera)
    text = (tmp_path / "s.json").read_text()
    (tmp_path / "s.json").write_text(text.replace('"prnu"', '"' + "a" * 5000 + '"'))
    with pytest.raises(BadInput, match="it is no mechanism") as refused:
        SensorModel.load(tmp_path / "s.json")
    assert len(str(refused.value)) < 1200


def test_what_names_no_file_is_refused_by_what_it_is(tmp_path):
    model = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 4095.0)
    for path, said in (
        ("", "path is ''"),
        (None, "path is None"),
        (3, "path is 3"),
        (tmp_path, "is a folder"),
    ):
        for force in (False, True):
            with pytest.raises(BadInput, match=said) as refused:
                model.save(path, force=force)
            assert "\n" not in str(refused.value)


@pytest.mark.parametrize("levels", ((64, 64), (64,) * 3, (64,) * 5))
def test_black_levels_are_one_or_four(levels):
    with pytest.raises(ValueError, match="black_level has .*: give 1, or 4"):
        SensorModel.poisson_gaussian(1.5, 3.0, levels, 4095.0)
