"""Suites that take a trained model apart, on one that has learned nothing: what they must then say."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.evaluation.beyond import BEYOND, beyond_bench
from cannoise_jax.evaluation.model_suites import ablation_suite, cameras_suite, encoder_suite, iso_suite
from cannoise_jax.evaluation.noise_models import Bench, baselines, learned, make_bench, references_of
from cannoise_jax.evaluation.suites import Request, kl_by_unit, noise_suite
from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.physics.core.settings import baseline_at
from cannoise_jax.physics.synthetic.virtual import virtual_cameras, virtual_patches
from cannoise_jax.sampling import make_model


@pytest.fixture(scope="module")
def request_():
    bench = make_bench(0, 2, 1, 4)
    generator = Generator(1 / 64, hidden=4, spectral=False, row_noise=False, physics=False)
    encoder = Encoder(1 / 64, hidden=8)
    image, key = jnp.ones((1, 32, 32, 4)), jax.random.key(0)
    shapes = jax.eval_shape(
        lambda: generator.init(
            {"params": key, "noise": key}, image, image, jnp.ones((1, 8)), image, train=False
        )
    )
    # All zero: the noise is the initial noise, at the level that the references show.
    generated = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    encoded = jax.jit(lambda: encoder.init(key, image, train=False))()
    model = make_model(generator, generated, encoder, encoded)
    everything = baselines(bench)
    draws = {name: everything[name] for name in ("truth", "pg", "pg_estimated", "pg_recalibrated")}
    return Request(bench, draws, (model,), seeds=1, references=2, ablations={"nothing": (model,)})


def test_a_part_that_does_nothing_is_worth_nothing(request_):
    rows = ablation_suite(request_).tables[0]["rows"]
    assert rows["nothing"]["over the whole"][:3] == (0, 0, 0)
    assert rows["nothing"]["excess KL"] == rows["whole"]["excess KL"]


@pytest.mark.slow
def test_the_networks_after_the_branches_are_left_out(request_):
    """Of a model whose networks add nothing yet that changes nothing; of one whose networks do, it does."""
    plain = request_.models[0]
    generator = Generator(1 / 64, hidden=4, spectral=False)
    image, key = jnp.ones((1, 32, 32, 4)), jax.random.key(0)
    keys = {"params": key, "noise": key}
    shapes = jax.eval_shape(lambda: generator.init(keys, image, image, jnp.ones((1, 8)), image, train=False))
    made = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    whole = plain.replace(generator_module=generator, generator=made)
    moved = jax.tree.map(lambda leaf: leaf + 0.05, made)
    for model, changed in ((whole, False), (whole.replace(generator=moved), True)):
        rows = ablation_suite(replace(request_, models=(model,), ablations={})).tables[0]["rows"]
        assert (abs(rows["U-Net left out"]["over the whole"].value) > 1e-4) == changed  # else: by rounding


def test_without_learning_the_model_is_the_estimate(request_):
    rows = cameras_suite(request_).tables[0]["rows"]
    assert set(rows) == {"IP", "GP", "S6", "N6", "G4", "all"}
    gap, own = rows["all"]["model - pg_estimated"], rows["all"]["model"]
    assert gap.low <= 0.02 * abs(own.value) and abs(gap.value) < 0.2 * abs(own.value)
    told, fitted = rows["all"]["model, level given"], rows["all"]["pg_recalibrated"]
    # Of ten patches a divergence near its floor is known to its own size: it is held against that of levels
    # that are off.
    assert abs(told.value - fitted.value) < min(fitted.high - fitted.low, 0.1 * rows["all"]["pg"].value)
    assert sum(rows[n]["pg"].patches for n in rows if n != "all") == request_.bench.size


@pytest.mark.slow
def test_wrong_references_cost_and_latents_are_of_every_patch(request_):
    outcome = encoder_suite(request_)
    which, many, latents = (table["rows"] for table in outcome.tables)
    assert which["(A|i) same setting"]["over (A|i)"].value == 0
    assert which["(A|j) other setting"]["over (A|i)"].value > 0
    assert set(many) == {"1", "2", "5"}
    assert [f["title"].split(": ")[1] for f in outcome.figures] == ["model", "nothing"] == list(latents)
    for figure in outcome.figures:
        assert figure["kind"] == "points"
        assert sum(len(points) for points in figure["data"].values()) == request_.bench.size
    share = latents["model"]["same camera among the 5 nearest"]
    assert 0 <= share.value <= 1 and share == latents["nothing"]["same camera among the 5 nearest"]


@pytest.mark.slow
def test_levels_beyond_the_prior_are_those_of_the_estimate_without_learning(request_):
    bench = beyond_bench(1, 4)
    outcome = iso_suite(dataclasses.replace(request_, beyond=bench))
    rows = outcome.tables[1]["rows"]
    assert len(rows) == len(BEYOND)
    for row in rows.values():
        for count in ("1 reference", "2 references"):
            ratio = row[f"model, {count}"].value / row[f"pg_estimated, {count}"].value
            assert ratio == pytest.approx(1, abs=0.06)


@pytest.mark.slow
def test_more_trained_models_stand_among_the_noise_models_each_camera_on_its_own_sensor(request_):
    """A generator that learned nothing, on the true sensors, is nearly the truth where the gain is told."""
    cameras, key = virtual_cameras()[::4], jax.random.key(0)  # two, for each sensor is a program of its own
    bench = Bench(*(virtual_patches(key, of, 5, 1, cameras) for of in ("test", "train")), cameras)
    own = dataclasses.replace(
        request_.models[0], sensors=tuple(c.sensor for c in bench.cameras), initial_noise="sensor",
        exposure_s=0.01, level="given",  # so is the level below: one program for both
    )  # fmt: skip
    everything = baselines(bench)
    draws = {name: everything[name] for name in ("truth", "pg")}
    asked = dataclasses.replace(request_, bench=bench, draws=draws, seeds=1, also={"on the sensor": (own,)})
    outcome = noise_suite(asked)
    assert set(outcome.tables[0]["rows"]) == {"truth", "pg", "model", "on the sensor"}
    assert [f["kind"] for f in outcome.figures] == ["bars", "image", "image"]
    shot = []
    for c, iso in zip(bench.test.camera, bench.test.iso, strict=True):
        camera = bench.cameras[int(c)]
        gain, _ = baseline_at(camera.sensor, float(iso))
        shot.append(np.full(4, np.mean(gain) / (camera.white_level - camera.black_level), np.float32))
    references = references_of(bench, 1, 0)
    told = (np.stack(shot), np.zeros((bench.size, 4), np.float32))
    made = learned(bench, own, given=told)(jax.random.key(0), references)
    kl = {
        name: kl_by_unit(bench, [noise]).mean()
        for name, noise in (
            ("own", made), *((n, draws[n](jax.random.key(1), references)) for n in ("truth", "pg"))
        )
    }  # fmt: skip
    assert kl["own"] - kl["truth"] < 0.2 * (kl["pg"] - kl["truth"])
