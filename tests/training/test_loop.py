"""Determinism, interruption and resumption, and everything that stops a run: on the tiny config."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import resource
import signal
from pathlib import Path
from runpy import run_path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh

from cannoise_jax.networks.statistics import noise_statistics
from cannoise_jax.recordings.pipeline import ArrayPatches, Subset
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training import loop
from cannoise_jax.training import state as state_module
from cannoise_jax.training import step as step_module
from cannoise_jax.training.checkpoint import Checkpoints
from cannoise_jax.training.data import load_data
from cannoise_jax.training.devices import everywhere
from cannoise_jax.training.state import abstract_state, init_state

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


@pytest.fixture(scope="module")
def config():
    return run_path(str(CONFIGS / "ci.py"))["get_config"]()


@pytest.fixture(scope="module")
def data(config, tmp_path_factory):
    return load_data(config, tmp_path_factory.mktemp("data"))


class Watched:
    """Progress that calls a function with the number of steps done."""

    def __init__(self, batch, done, act):
        self.batch, self.done, self.act = batch, done, act

    def update(self, n=1):
        self.done += n // self.batch
        self.act(self.done)

    def set_postfix(self, ordered_dict=None, refresh=True, **numbers):
        pass


def run(config, folder, data, act=lambda step: None):
    return loop.train(config, folder, data, lambda done, total: Watched(config.batch_size, done, act))


def digest(state):
    """SHA-256 of all that was learned."""
    whole = hashlib.sha256()
    learned = (state.generator, state.encoder, state.critic, state.average, state.generator_optimiser)
    for leaf in jax.tree.leaves(learned):
        whole.update(np.asarray(leaf).tobytes())
    return whole.hexdigest()


@pytest.fixture(scope="module")
def first_state(config):
    return init_state(config, 5)


@pytest.fixture(scope="module")
def finished(config, data, tmp_path_factory):
    """A workdir trained without interruption, and the digest of its last state."""
    folder = tmp_path_factory.mktemp("first")
    run(config, folder, data)
    return folder, digest(newest_state(config, folder))


def newest_state(config, folder):
    checkpoints = Checkpoints(folder)
    state, _ = checkpoints.restore(abstract_state(config, 5), checkpoints.newest())
    checkpoints.close()
    assert int(state.step) == config.steps
    return state


def test_the_same_config_interrupted_and_resumed_gives_the_same_bits(
    config, data, finished, tmp_path, monkeypatch
):
    """And so it does without validation, which only looks."""
    monkeypatch.setattr(loop, "_validate", lambda *_: 0.0)
    for programs in (state_module._first_programs, step_module._train_step):
        programs.cache_clear()  # traced anew, as in another process

    def interrupt(step):
        if step == 4:
            os.kill(os.getpid(), signal.SIGTERM)

    stopped = run(config, tmp_path, data, interrupt)
    assert not stopped.finished
    assert stopped.step == 4 and stopped.step % config.checkpoint_every
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    seen = []
    resumed = run(config, tmp_path, data, seen.append)
    assert resumed.finished
    assert seen == [5, 6]
    assert digest(newest_state(config, tmp_path)) == finished[1]


def test_the_encoder_starts_with_statistics_of_mean_zero_and_variance_one(config, data):
    noisy = data.noisy_examples()
    state = init_state(config, 5, noisy)
    params, (statistics, _) = state.encoder["params"], jax.jit(noise_statistics)(noisy)
    z = (statistics - params["centre"]) / params["spread"]
    np.testing.assert_allclose(z.mean(0), 0, atol=1e-3)
    varied = statistics.std(0) > 0.01
    assert varied.mean() > 0.8
    np.testing.assert_allclose(z.std(0)[varied], 1, rtol=1e-3)
    for name in ("centre", "spread"):
        np.testing.assert_array_equal(state.average["encoder"][name], params[name])


def test_what_the_statistics_are_standardised_by_is_never_trained(config, data, finished):
    noisy = data.noisy_examples()
    start, end = init_state(config, 5, noisy), newest_state(config, finished[0])
    for name in ("centre", "spread"):
        np.testing.assert_array_equal(end.encoder["params"][name], start.encoder["params"][name])
    assert (end.encoder["params"]["latent"]["kernel"] != start.encoder["params"]["latent"]["kernel"]).any()


def test_another_seed_gives_other_bits(config, first_state):
    other = config.copy_and_resolve_references()
    other.seed = 1
    assert digest(init_state(other, 5)) != digest(first_state)


def test_a_workdir_keeps_numbers_and_pictures(finished):
    folder, _ = finished
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    assert sum("validation/model/pooled" in line for line in lines) == 2
    assert sum("critic/wasserstein" in line for line in lines) == 6
    assert list(folder.glob("events*"))
    assert 1 <= len(list((folder / "checkpoints").glob("[0-9]*"))) <= 2


def test_a_run_starts_from_the_networks_of_another(config, finished, first_state, tmp_path):
    other = config.copy_and_resolve_references()
    other.start = str(finished[0])
    state = loop.started(other, first_state, 5)
    best = Checkpoints(finished[0])
    wanted, _ = best.restore(abstract_state(config, 5), best.best())
    best.close()
    assert int(state.step) == 0
    for network, name in ((state.generator, "generator"), (state.encoder, "encoder")):
        jax.tree.map(np.testing.assert_array_equal, network["params"], wanted.average[name])
    other.start = str(tmp_path / "nowhere")
    with pytest.raises(BadInput, match="holds no checkpoints"):
        loop.started(other, first_state, 5)


def test_another_config_is_refused(config, data, finished):
    other = config.copy_and_resolve_references()
    other.loss.penalty = 5.0
    with pytest.raises(BadInput, match=r"loss.penalty: 10.0 there, 5.0 here") as refused:
        run(other, finished[0], data)
    assert "\n" not in str(refused.value)


def test_a_loss_that_is_not_finite_stops_with_the_last_good_checkpoint(config, data, tmp_path, monkeypatch):
    made = loop.make_train_step

    def poisoned(*arguments):
        step = made(*arguments)

        def at_step_four(state, batch):
            state, metrics = step(state, batch)
            nan = jnp.nan if int(state.step) == 4 else 0
            return state, {name: value + nan for name, value in metrics.items()}

        return at_step_four

    monkeypatch.setattr(loop, "make_train_step", poisoned)
    with pytest.raises(loop.NonFiniteLoss, match=r"step 4: .* not finite.*checkpoints/3"):
        run(config, tmp_path, data)
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.newest() == 3
    checkpoints.close()


def test_a_full_disk_is_one_line_and_keeps_what_was_saved(first_state, finished, monkeypatch):
    checkpoints = Checkpoints(finished[0])
    before = checkpoints.newest()
    state = first_state._replace(step=jnp.asarray(99))

    def full(*arguments, **named):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints._manager, "save", full)
    with pytest.raises(BadInput, match="No space left on device") as refused:
        checkpoints.save(state, {})
    assert "\n" not in str(refused.value)
    assert checkpoints.newest() == before
    checkpoints.close()


def test_a_failed_write_is_one_line_without_tracebacks(first_state, tmp_path, capfd, caplog):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(first_state, {})
    capfd.readouterr()
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limit[1]))  # writes fail as on a full disk
    try:
        with pytest.raises(BadInput, match="cannot be written") as refused:
            checkpoints.save(first_state._replace(step=jnp.asarray(1)), {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert "\n" not in str(refused.value)
    printed = capfd.readouterr()
    assert "Traceback" not in printed.out + printed.err + caplog.text
    assert checkpoints.newest() == 0
    checkpoints.close()


def test_a_full_disk_under_the_metrics_ends_training_in_one_line(config, data, tmp_path, monkeypatch):
    class Full(loop.MetricWriter):
        def _write_event(self, step, summary):
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(loop, "MetricWriter", Full)
    monkeypatch.setattr(
        loop, "make_train_step", lambda *_: lambda state, batch: (state, {"critic/wasserstein": 0.0})
    )
    with pytest.raises(BadInput, match=r"cannot be written \(No space left on device\)") as refused:
        run(config, tmp_path, data)
    assert "\n" not in str(refused.value)


def test_a_start_that_fails_leaves_the_workdir_free(config, data, tmp_path):
    t = data.test
    patches = ArrayPatches(t.clean, t.noisy, t.shot, t.read, t.camera, data.cameras, ("RGGB",) * 5)
    few = dataclasses.replace(data, train=Subset(patches, np.arange(1)))
    with pytest.raises(BadInput, match="at least two"):
        run(config, tmp_path, few)
    assert list(tmp_path.iterdir()) == []


def test_parameters_that_are_not_finite_are_not_scored(config, data, tmp_path, monkeypatch):
    def poisoned(state, batch):
        average = jax.tree.map(lambda leaf: leaf * jnp.nan, state.generator)
        return state._replace(generator=average, step=state.step + 1), {"critic/wasserstein": 0.0}

    monkeypatch.setattr(loop, "make_train_step", lambda *_: poisoned)
    with pytest.raises(loop.NonFiniteLoss, match="step 3: a parameter is not finite"):
        run(config, tmp_path, data)


def test_the_best_checkpoint_and_the_newest_are_kept(first_state, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    state = first_state
    for step, score in [(1, 0.5), (2, 0.1), (3, 0.3), (4, None)]:
        checkpoints.save(state._replace(step=jnp.asarray(step)), {"next_index": step}, score)
    checkpoints.close()
    checkpoints = Checkpoints(tmp_path)  # as another process finds them
    assert checkpoints.best() == 2
    assert checkpoints.newest() == 4
    restored, iterator = checkpoints.restore(state, 2)
    assert iterator == {"next_index": 2}
    assert digest(restored) == digest(state)
    assert (jax.random.key_data(restored.key) == jax.random.key_data(state.key)).all()
    checkpoints.close()


def test_a_checkpoint_is_restored_where_it_shall_be(first_state, tmp_path):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(first_state._replace(step=jnp.asarray(1)), {"next_index": 1}, None)
    where = everywhere(Mesh(np.array(jax.devices()[:1]), ("batch",)))
    state, _ = checkpoints.restore(first_state, 1, where)
    assert all(leaf.sharding == where for leaf in jax.tree.leaves(state._replace(key=())))
    state, _ = checkpoints.restore(first_state, 1)
    assert not any(leaf.committed for leaf in jax.tree.leaves(state._replace(key=())))
    checkpoints.close()


def test_a_checkpoint_of_another_size_is_refused_in_one_line(config, finished):
    other = config.copy_and_resolve_references()
    other.width = 1 / 16
    checkpoints = Checkpoints(finished[0])
    with pytest.raises(BadInput, match="cannot be restored") as refused:
        checkpoints.restore(abstract_state(other, 5), checkpoints.newest())
    assert "\n" not in str(refused.value)
    checkpoints.close()
