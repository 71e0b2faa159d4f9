"""The training loop: resume, step, report, measure, checkpoint, stop cleanly; then the final comparison."""

from __future__ import annotations

import json
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool
from ml_collections import ConfigDict, FrozenConfigDict

from cannoise_jax.evaluation.compare import draw_noise, evaluate_model, model_columns
from cannoise_jax.evaluation.evaluators import EVALUATORS
from cannoise_jax.evaluation.samplers import Samplers, by_latents, samplers
from cannoise_jax.networks.encoder import mean_latent
from cannoise_jax.physics.initial_noise import initial_noise_by_camera
from cannoise_jax.recordings.opened import check_plain, json_of
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.check import check_config, check_sensors
from cannoise_jax.training.checkpoint import Checkpoints
from cannoise_jax.training.compiler import compiler_options
from cannoise_jax.training.data import HeldOut, TrainingData
from cannoise_jax.training.devices import any_process, copied, everywhere, is_first, own_copy, shared_out
from cannoise_jax.training.metrics import MetricWriter, noise_panel
from cannoise_jax.training.state import State, abstract_state, init_state, latent_of, make_networks
from cannoise_jax.training.step import make_train_step

_MOST_CAMERAS = 12
"""Cameras whose validation is written one by one."""


class Progress(Protocol):
    """What shows progress; `tqdm` is one."""

    def update(self, n: int = 1) -> Any: ...
    def set_postfix(self, ordered_dict: Any = None, refresh: bool = True, **numbers: Any) -> None: ...


class Outcome(NamedTuple):
    """finished: False after a signal. state: the last one, or the best by validation KL when finished.
    step: of that state."""

    finished: bool
    state: State
    step: int


class NonFiniteLoss(RuntimeError):
    """A loss or a parameter is no longer finite; the message names the last good checkpoint."""


def check_workdir(config: ConfigDict, workdir: Path) -> None:
    """Makes the workdir. Raises BadInput where it cannot be written, or holds another config."""
    path = workdir / "config.json"
    if workdir.is_file():
        raise BadInput(f"{workdir}: is a file: name a folder for --workdir")
    try:
        workdir.mkdir(parents=True, exist_ok=True)
        if path.exists():
            check_plain(path, "use another --workdir")
            stored = json_of(path.read_text(encoding="utf-8"))
            if isinstance(stored, dict):  # runs of before there was a choice
                stored.setdefault("compute", "float32")
            difference = _difference(stored, json.loads(_text(config)))
            if difference:
                raise BadInput(
                    f"{workdir}: holds a run with another config ({difference}): use another --workdir, "
                    "or the same config to resume"
                )
        with tempfile.TemporaryFile(dir=workdir):  # permissions do not tell of all places, nor of a full disk
            pass
    except BadInput:
        raise
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not valid JSON: use another --workdir") from error
    except OSError as error:
        raise not_written(workdir, error) from error


def not_written(workdir: Path, error: OSError) -> BadInput:
    """What to say of a workdir that takes no files."""
    reason = error.strerror or error
    return BadInput(f"{workdir}: cannot be written ({reason}): make it writable, or name another --workdir")


def _write_config(config: ConfigDict, workdir: Path) -> None:
    """config.json, which marks the workdir as this run's: only once the run is known to start."""
    unfinished = workdir / ".config.json.partial"
    try:
        unfinished.write_text(_text(config) + "\n")
        unfinished.replace(workdir / "config.json")
    except OSError as error:
        raise not_written(workdir, error) from error


def _text(config: ConfigDict) -> str:
    return config.to_json_best_effort(indent=1, sort_keys=True)


def _difference(old: Any, new: Any, name: str = "") -> str:
    """The first field that differs, as `name: old there, new here`; empty where none does."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            found = _difference(old.get(key), new.get(key), f"{name}.{key}" if name else key)
            if found:
                return found
        return ""
    return "" if old == new else f"{name}: {old!r} there, {new!r} here"


def make_sampler(config: ConfigDict) -> Callable[[State], Samplers]:
    """A function from a state to its averaged model as `evaluation` takes it; compiled once for all
    states."""
    networks = make_networks(config)
    encode, draw = _averaged(FrozenConfigDict(config))

    def of_state(state: State) -> Samplers:
        encoder, generator = (
            {"params": state.average[name], "spectral": getattr(state, name)["spectral"]}
            for name in ("encoder", "generator")
        )

        def of_latents(key, clean, latents, level, camera):
            if networks.encoder is None:
                return draw(generator, key, clean, latents[:, 0], level, camera)
            return draw(generator, key, clean, mean_latent(networks.encoder, latents), level, camera)

        return samplers(config.level, by_latents(partial(encode, encoder), of_latents), by_camera=True)

    return of_state


@lru_cache(maxsize=4)
def _averaged(config: FrozenConfigDict) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """E and G as programs, see `by_latents`."""
    networks, draw = make_networks(config), initial_noise_by_camera(config.initial_noise, config.exposure_s)
    options = compiler_options(config)

    @partial(jax.jit, compiler_options=options)
    def encode(encoder, noisy):
        return latent_of(networks, encoder, noisy)

    @partial(jax.jit, compiler_options=options)
    def sample(generator, key, clean, latent, level, camera):
        noise_key, row_key = jax.random.split(key)
        n_init, sigma = draw(noise_key, clean, level.shot, level.read, camera)
        return networks.generator.apply(
            generator, clean, n_init, latent, sigma, train=False, level=level, rngs={"noise": row_key}
        )

    return encode, sample


@contextmanager
def stop_requested() -> Iterator[Callable[[], bool]]:
    """Within it SIGTERM and Ctrl-C only set what the yielded function tells; a second Ctrl-C interrupts.

    Outside the main thread, where signals cannot be caught, it tells False.
    """
    caught: list[int] = []

    def handle(number, frame):
        if caught and number == signal.SIGINT:
            raise KeyboardInterrupt
        caught.append(number)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield lambda: bool(caught)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def train(
    config: ConfigDict,
    workdir: Path,
    data: TrainingData,
    progress: Callable[[int, int], Progress],
    mesh: Mesh | None = None,
) -> Outcome:
    """Trains from the newest checkpoint of the workdir, or from the start, to `config.steps`.

    progress: (steps done, steps in all) -> what shows progress.
    mesh: of devices that share every batch, see `devices`; each process reads its own rows of it, and the
      first writes what is left beside the checkpoints.
    Raises NonFiniteLoss, and BadInput for a full disk, a workdir that holds another config, or a config that
    cannot be trained.
    """
    check_config(config)
    check_sensors(config, data.cameras)
    check_workdir(config, workdir)
    source = data.batches(config, jax.process_index(), jax.process_count())
    if is_first():
        _write_config(config, workdir)
    checkpoints, where = Checkpoints(workdir), everywhere(mesh) if mesh else None
    newest = checkpoints.newest()
    if newest is None:
        state = init_state(config, data.known, jnp.asarray(data.noisy_examples()))
        if config.start:
            state = started(config, state, data.known)
        state = copied(state, mesh)
    else:
        state, position = checkpoints.restore(abstract_state(config, data.known), newest, where)
        source.set_state(position)
    train_step = make_train_step(config, data.known, None, mesh)
    validation_cameras = data.validation_cameras or data.cameras
    sampler = make_sampler(config)
    validation = data.validation.some(config.validation_patches)
    step, scored = int(state.step), None
    try:
        with stop_requested() as stopping, _metrics(workdir) as folder, MetricWriter(folder) as writer:
            bar = progress(step, config.steps)
            while step < config.steps and not any_process(stopping()):
                state, metrics = train_step(state, shared_out(next(source), mesh))
                step += 1
                bar.update(config.batch_size)
                last = step == config.steps
                if step % config.log_every == 0 or last:
                    numbers = {name: float(value) for name, value in metrics.items()}
                    _check_finite(numbers, step, checkpoints)
                    name, value = next(iter(numbers.items()))
                    bar.set_postfix({name.partition("/")[2]: f"{value:.3f}"}, refresh=False)
                    writer.write_scalars(step, numbers)
                scored = None
                if step % config.evaluate_every == 0 or last:
                    _check_state(state, metrics, checkpoints)
                    scored = _validate(
                        writer, step, sampler(own_copy(state, mesh)), validation, validation_cameras,
                        config.references,
                    )  # fmt: skip
                if step % config.checkpoint_every == 0 or scored is not None:
                    _save(checkpoints, state, metrics, source, scored)
                    writer.flush()
            finished = step >= config.steps
            if not finished:
                _save(checkpoints, state, metrics if step > int(newest or 0) else {}, source, scored)
        best = checkpoints.best() if finished else None
        if best is not None and best != step:
            state, _ = checkpoints.restore(state, best, where)
        return Outcome(finished, own_copy(state, mesh), int(state.step))
    finally:
        checkpoints.close()


@contextmanager
def _metrics(workdir: Path) -> Iterator[Path]:
    """Where metrics go: the workdir. Other processes than the first have the same ones, and drop theirs."""
    if is_first():
        yield workdir
    else:
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)


def started(config: ConfigDict, state: State, cameras: int) -> State:
    """The first state with the networks of another run, `config.start`, as it samples from them.

    Raises BadInput where that folder holds no checkpoint, or one of other networks.
    """
    folder = Path(config.start)
    if not (folder / "checkpoints").is_dir():
        raise BadInput(f"config.start: {folder}: holds no checkpoints: name the folder of a training run")
    checkpoints = Checkpoints(folder)
    try:
        best = checkpoints.best()
        if best is None:
            raise BadInput(f"config.start: {folder}: holds no finished checkpoint: let that run go on first")
        other, _ = checkpoints.restore(abstract_state(config, cameras), best)
    finally:
        checkpoints.close()
    networks: dict[str, Any] = {
        name: {"params": other.average[name], "spectral": getattr(other, name)["spectral"]}
        for name in ("generator", "encoder")
    }
    copied = jax.tree.map(jnp.copy, other.average)
    return state._replace(critic=other.critic, average=copied, **networks)


def _save(checkpoints: Checkpoints, state: State, metrics, source, score: float | None) -> None:
    """A checkpoint is good by definition: what is not finite is never stored."""
    _check_state(state, metrics, checkpoints)
    checkpoints.save(state, source.get_state(), score)


def _check_state(state: State, metrics, checkpoints: Checkpoints) -> None:
    _check_finite({name: float(value) for name, value in metrics.items()}, int(state.step), checkpoints)
    trained = (state.generator, state.encoder, state.critic)
    if not bool(_all_finite(trained)):
        _check_finite({"a parameter": np.nan}, int(state.step), checkpoints)


@jax.jit
def _all_finite(tree) -> Bool[Array, ""]:
    return jnp.stack([jnp.isfinite(leaf).all() for leaf in jax.tree.leaves(tree)]).all()


def _check_finite(numbers: dict[str, float], step: int, checkpoints: Checkpoints) -> None:
    wrong = [name for name, value in numbers.items() if not np.isfinite(value)]
    if wrong:
        good = checkpoints.path(checkpoints.newest())
        raise NonFiniteLoss(
            f"step {step}: {wrong[0]} is not finite; last good checkpoint: {good}; "
            "lower config.optimiser.generator_rate and critic_rate"
        )


def _validate(
    writer: MetricWriter,
    step: int,
    sampler: Samplers,
    patches: HeldOut,
    cameras: tuple[str, ...],
    references: int,
) -> float:
    """KL on validation scenes to the writer, with pictures; returns the pooled KL."""
    key = jax.random.key(0)  # the same draws every time, so that steps can be compared
    columns = ("model", "model_wrong_reference")
    results = evaluate_model(
        sampler.usual, patches, cameras, key, columns=columns, evaluators=EVALUATORS[:1],
        references=references, given=sampler.given,
    )  # fmt: skip
    scalars = {
        f"validation/{name}/{camera}": row[name]["kl"]
        for camera, row in {**results["cameras"], "pooled": results["pooled"]}.items()
        for name in row
        if camera == "pooled" or len(cameras) <= _MOST_CAMERAS
    }
    writer.write_scalars(step, scalars)
    made, shown = model_columns(sampler.usual, patches, key, None, references), patches.spread(5)
    noises = [draw_noise(made[name], patches, key, chosen=shown) for name in ("poisson_gaussian", "model")]
    clean = patches.clean[shown]
    real = np.clip(patches.noisy[shown], 0, 1) - clean
    writer.write_images(step, {"clean, n_init, generated, real": noise_panel(clean, (*noises, real))})
    writer.flush()
    return results["pooled"]["model"]["kl"]
