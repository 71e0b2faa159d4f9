"""What the training step draws, updates and leaves alone, and that every switch of the config is one."""

from __future__ import annotations

from pathlib import Path
from runpy import run_path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ml_collections import ConfigDict

from cannoise_jax.training.compiler import compiler_options
from cannoise_jax.training.state import abstract_state, init_state
from cannoise_jax.training.step import make_train_step

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@pytest.fixture(scope="module")
def config():
    return run_path(str(CONFIGS / "ci.py"))["get_config"]()


def make_batch(size=4, side=32, scale=0.02):
    rng = np.random.default_rng(0)
    # Smooth: texture would be taken for noise, and clipped.
    clean = np.tile(rng.uniform(0.1, 0.5, (size, 1, 1, 4)), (1, side, side, 1)).astype(np.float32)
    noisy = [clean + scale * rng.standard_normal(clean.shape).astype(np.float32) for _ in range(4)]
    return {
        "clean": clean,
        **dict(zip(("noisy", "anchor", "positive", "negative"), noisy, strict=True)),
        "shot": np.full((size, 4), 1e-3, np.float32),
        "read": np.full((size, 4), 1e-6, np.float32),
        "camera": np.arange(size, dtype=np.int32) % 2,
    }


@pytest.fixture(scope="module")
def trained(config):
    """The state before, after one step, and after two; and the metrics of the first."""
    step, batch = make_train_step(config, 2), make_batch()
    states = [init_state(config, 2)]
    kept = jax.tree.map(jnp.copy, states[0])
    first, metrics = step(states[0], batch)
    copy = jax.tree.map(jnp.copy, first)
    second, _ = step(first, batch)
    return kept, copy, second, metrics


def test_one_step_moves_every_network_and_counts(trained):
    before, after, later, metrics = trained
    assert [int(s.step) for s in trained[:3]] == [0, 1, 2]
    assert int(later.position) == 2
    for name in ("critic", "encoder"):
        moved = jax.tree.map(lambda a, b: bool((a != b).any()), getattr(before, name), getattr(after, name))
        # Not every leaf can move: a constant added to all scores cancels, a rectifier may be shut.
        leaves = jax.tree.leaves(moved)
        assert sum(leaves) > 0.8 * len(leaves), name
    assert not before.generator["params"]["pixels"]["out"]["kernel"].any()
    assert later.generator["params"]["pixels"]["out"]["kernel"].any()
    assert all(np.isfinite(value) for value in metrics.values())


def test_a_step_in_bfloat16_keeps_its_weights_in_float32(config):
    changed = config.copy_and_resolve_references()
    changed.compute = "bfloat16"
    after, _ = jax.eval_shape(make_train_step(changed, 2), abstract_state(changed, 2), make_batch())
    assert {x.dtype for x in jax.tree.leaves((after.generator, after.encoder, after.critic))} == {
        jnp.dtype("float32")
    }


@pytest.mark.slow
def test_a_step_in_bfloat16_is_near_and_its_weights_and_penalty_are_float32(config, trained):
    changed = config.copy_and_resolve_references()
    changed.compute = "bfloat16"
    after, metrics = make_train_step(changed, 2)(init_state(changed, 2), make_batch())
    assert {x.dtype for x in jax.tree.leaves((after.generator, after.encoder, after.critic))} == {
        jnp.dtype("float32")
    }
    exact = trained[3]
    # Of the same fake images up to their rounding; the slope itself is worked out in float32.
    assert float(metrics["critic/penalty"]) == pytest.approx(float(exact["critic/penalty"]), rel=0.02)
    for name in ("critic/wasserstein", "generator/triplet"):
        assert float(metrics[name]) == pytest.approx(float(exact[name]), rel=0.1, abs=0.01)
        assert float(metrics[name]) != float(exact[name]), name


def test_training_starts_at_the_initial_noise(trained):
    assert float(trained[3]["generator/spread"]) == pytest.approx(1, abs=0.02)


def test_the_key_is_never_used_up(trained):
    before, _, later, _ = trained
    assert (jax.random.key_data(before.key) == jax.random.key_data(later.key)).all()


SWITCHES = {
    "no encoder": ({"encoder": False}, {"generator/triplet"}),
    "no triplet": ({"loss.triplet": 0.0}, {"generator/triplet"}),
    "drawn triplets": ({"loss.triplets": "drawn"}, set()),
    "literal": ({"literal": True, "critic_condition": "none"}, set()),
    "latent": ({"critic_condition": "latent", "critic_updates": 2}, set()),
    "gaussian": ({"initial_noise": "gaussian", "clip": False}, set()),
}


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=() if n in ("no encoder", "latent") else pytest.mark.slow) for n in SWITCHES],
)
def test_switches(config, name):
    changes, absent = SWITCHES[name]
    changed = config.copy_and_resolve_references()
    changed.update_from_flattened_dict(changes)
    changed.loss.feature_matching = 1.0
    if changed.literal:
        changed.networks = {"generator": {}, "encoder": {}, "critic": {}}
    state = abstract_state(changed, 2)
    batch = make_batch()
    if not changed.loss.triplet:
        del batch["positive"], batch["negative"]
    after, metrics = jax.eval_shape(make_train_step(changed, 2), state, batch)
    assert jax.tree.structure(after) == jax.tree.structure(state)
    terms = {"generator/adversarial", "generator/feature_matching", "generator/triplet"}
    assert terms & set(metrics) == terms - absent


def test_feature_matching_is_off_by_weight(config, trained):
    assert config.loss.feature_matching == 0
    assert "generator/feature_matching" not in trained[3] and "generator/adversarial" in trained[3]


@pytest.mark.parametrize("field", ["critic_condition", "initial_noise"])
def test_unknown_names_are_refused(config, field):
    changed = config.copy_and_resolve_references()
    changed[field] = "nothing"
    with pytest.raises(ValueError, match=f"{field}.*nothing"):
        abstract_state(changed, 2)
        make_train_step(changed, 2)


def test_an_option_that_this_xla_does_not_know_is_left_out(config, caplog):
    changed = config.copy_and_resolve_references()
    changed.compiler = ConfigDict({"xla_backend_optimization_level": 0, "xla_no_such_option": True})
    assert compiler_options(changed) == {"xla_backend_optimization_level": 0}
    assert "xla_no_such_option" in caplog.text
    changed.compiler = ConfigDict()
    assert compiler_options(changed) is None
