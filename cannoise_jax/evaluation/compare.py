"""Noise models side by side on held-out patches: one row per camera, one column per model.

A model gets, for every patch, noisy references of *other* patches of the same camera and setting, of other
scenes where there are any, never the target itself; how loud the noise is, it must read off them. So must
`poisson_gaussian_estimated`, which has learned nothing. The column `model_given` is told the re-calibrated
noise level function, and `model_wrong_reference` gets references of another camera at that same level and
with the same random numbers: what it loses there is what the model knows about the camera beside its level.
A model may be given several references; `model_one_reference` then shows what one does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np
from jaxtyping import Array, Float, Int, Key

from cannoise_jax.evaluation.baselines import (
    Sampler,
    gaussian,
    poisson_gaussian,
    poisson_gaussian_estimated,
)
from cannoise_jax.evaluation.evaluators import EVALUATORS, Evaluator, Samples, evaluate, pooled
from cannoise_jax.evaluation.kl import clipped_noise
from cannoise_jax.evaluation.samplers import ByCamera

MODELS = (
    "gaussian",
    "poisson_gaussian",
    "poisson_gaussian_estimated",
    "poisson_gaussian_recalibrated",
    "model",
    "model_given",
    "model_wrong_reference",
    "model_one_reference",
)
Results = dict[str, Any]


class Patches(Protocol):
    """Recorded pairs, as `physics.synthetic.virtual.VirtualPatches` holds them; packed `[n, h, w, 4]`."""

    clean: Any
    noisy: Any
    shot: Any
    read: Any
    camera: Any
    iso: Any
    scene: Any


class Column(NamedTuple):
    """One noise model: its sampler, the patches that its references come from, its noise levels."""

    sampler: Sampler | ByCamera
    reference: Int[np.ndarray, "n k"]
    shot: Float[np.ndarray, "n 4"]
    read: Float[np.ndarray, "n 4"]


def evaluate_model(
    sampler: Sampler | ByCamera | None,
    patches: Patches,
    camera_names: Sequence[str],
    key: Key[Array, ""],
    *,
    recalibrated: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    batch: int = 64,
    evaluators: tuple[Evaluator, ...] = EVALUATORS,
    columns: Sequence[str] = MODELS,
    references: int = 1,
    given: Sampler | ByCamera | None = None,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> Results:
    """Every model of `columns` on every patch.

    `{"settings": {name: {iso: row}}, "cameras": {name: row}, "pooled": row}` with rows `{model: numbers}`:
    numbers are computed for every camera and ISO, a camera's are the mean over its patches, and so on up.

    sampler: the learned model, `(key, clean, reference_noisy, shot, read) -> noise` or one `ByCamera`, called
      on batches of `batch` patches with references `[b, k, h, w, 4]` (jit it); None leaves its columns out.
      shot and read are the published ones: a model that reads its level off the references looks at neither.
    given: the same model, where it obeys shot and read that it is given; None: it cannot.
    references: k, how many noisy images of the camera the model is shown.
    camera_names: by camera index. recalibrated: from `baselines.calibrate_by_setting` on training recordings;
      a setting that it lacks uses the published function; None leaves the column out.
    tell: called with the number of parts that are done, draws of a model or numbers of a setting, and of all.
    Numbers per model are those of `evaluators`, the first of which must count the patches; see there. The
    same key gives the same result.
    """
    draw_key, pair_key = jax.random.split(key)
    made = model_columns(sampler, patches, pair_key, recalibrated, references, given)
    wanted = {name: column for name, column in made.items() if name in columns}
    camera, iso = np.asarray(patches.camera), np.asarray(patches.iso)
    isos = {c: np.unique(iso[camera == c]).tolist() for c in range(len(camera_names)) if (camera == c).any()}
    total = len(wanted) + sum(map(len, isos.values()))
    noise: dict[str, Any] = {}
    for name, column in wanted.items():
        noise[name] = draw_noise(column, patches, _column_key(draw_key, name), batch)
        tell(len(noise), total)
    done = len(noise)
    settings: dict[str, dict[str, Any]] = {}
    for c, of_camera in isos.items():
        rows = settings.setdefault(camera_names[c], {})
        for setting in of_camera:
            mask = (camera == c) & (iso == setting)
            rows[str(setting)] = {
                model: _numbers(patches, fake, mask, evaluators) for model, fake in noise.items()
            }
            done += 1
            tell(done, total)
    cameras = {name: _pool(rows.values(), noise) for name, rows in settings.items()}
    return {"cameras": cameras, "pooled": _pool(cameras.values(), noise), "settings": settings}


def _column_key(key: Key[Array, ""], name: str) -> Key[Array, ""]:
    """The learned model draws the same numbers whatever it is shown: only what it is shown differs."""
    return jax.random.fold_in(key, MODELS.index("model" if name.startswith("model") else name))


def model_columns(
    sampler: Sampler | ByCamera | None,
    patches: Patches,
    key: Key[Array, ""],
    recalibrated: Mapping[tuple[int, int], tuple[float, float]] | None = None,
    references: int = 1,
    given: Sampler | ByCamera | None = None,
) -> dict[str, Column]:
    """The columns of the comparison by name, each with its references and noise levels."""
    right, wrong = choose_references(patches.camera, patches.scene, key, references, patches.iso)
    shot, read = np.asarray(patches.shot), np.asarray(patches.read)
    made = {
        "gaussian": Column(gaussian, right, shot, read),
        "poisson_gaussian": Column(poisson_gaussian, right, shot, read),
        "poisson_gaussian_estimated": Column(poisson_gaussian_estimated, right, shot, read),
    }
    fitted = [shot, read]
    if recalibrated is not None:
        settings = zip(np.asarray(patches.camera), np.asarray(patches.iso), shot, read, strict=True)
        levels = [recalibrated.get((int(c), int(i)), (s, r)) for c, i, s, r in settings]
        fitted = [np.stack([np.broadcast_to(level[k], 4) for level in levels]) for k in (0, 1)]
        made["poisson_gaussian_recalibrated"] = Column(poisson_gaussian, right, *fitted)
    if sampler is not None:
        made["model"] = Column(sampler, right, shot, read)
        if given is not None:
            made["model_given"] = Column(given, right, *fitted)
        if (wrong >= 0).all():
            made["model_wrong_reference"] = Column(given or sampler, wrong, *fitted)
        if references > 1:
            made["model_one_reference"] = Column(sampler, right[:, :1], shot, read)
    return made


def choose_references(
    camera: Int[np.ndarray, "n"],
    scene: Int[np.ndarray, "n"],
    key: Key[Array, ""],
    count: int = 1,
    setting: Int[np.ndarray, "n"] | None = None,
) -> tuple[Int[np.ndarray, "n k"], Int[np.ndarray, "n k"]]:
    """For every patch the indices of `count` references of its camera and of as many of one other camera.

    The first are of its setting, where settings are told and it has another patch, and from other scenes
    where there is more than one, else other patches where there are any; the second are of any setting, -1
    where there is no other camera. None is repeated where there are enough.
    """
    camera, scene = np.asarray(camera), np.asarray(scene)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)).tolist())
    right, wrong = np.tile(np.arange(camera.size)[:, None], count), np.full((camera.size, count), -1)
    for i in range(camera.size):
        same = camera == camera[i]
        other = np.arange(camera.size) != i
        here = same if setting is None else same & (np.asarray(setting) == np.asarray(setting)[i])
        for allowed in (here & (scene != scene[i]), here & other, same & (scene != scene[i]), same & other):
            if allowed.any():
                right[i] = rng.choice(np.flatnonzero(allowed), count, replace=allowed.sum() < count)
                break
        if not same.all():
            other = camera == rng.choice(camera[~same])
            wrong[i] = rng.choice(np.flatnonzero(other), count, replace=other.sum() < count)
    return right, wrong


def draw_noise(
    column: Column,
    patches: Patches,
    key: Key[Array, ""],
    batch: int = 64,
    chosen: Int[np.ndarray, "m"] | None = None,
) -> Float[np.ndarray, "m h w 4"]:
    """Noise of one model for the `chosen` patches (default: all), clipped as a recording clips it; float32.

    Patches go through in batches of one size (the last is filled up), so a jitted sampler compiles once;
    a batch is at most all patches, chosen or not.
    """
    clean, noisy = np.asarray(patches.clean), np.asarray(patches.noisy)
    chosen = np.arange(clean.shape[0]) if chosen is None else np.asarray(chosen)
    batch = min(batch, clean.shape[0])
    made = []
    for number, start in enumerate(range(0, chosen.size, batch)):
        index = chosen[np.minimum(np.arange(start, start + batch), chosen.size - 1)]
        asked = [
            jax.random.fold_in(key, number),
            clean[index],
            noisy[column.reference[index]],
            np.asarray(column.shot[index], np.float32),
            np.asarray(column.read[index], np.float32),
        ]
        if isinstance(column.sampler, ByCamera):
            noise = column.sampler.sample(*asked, np.asarray(patches.camera)[index])
        else:
            noise = column.sampler(*asked)
        made.append(clipped_noise(np.asarray(noise, np.float32), clean[index])[: chosen.size - start])
    return np.concatenate(made)


def _numbers(
    patches: Patches, fake: np.ndarray, here: np.ndarray, evaluators: tuple[Evaluator, ...]
) -> dict[str, float]:
    clean = np.asarray(patches.clean)[here]
    real = clipped_noise(np.asarray(patches.noisy)[here] - clean, clean)
    shot, read = (np.asarray(v)[here][:, None, None, :] for v in (patches.shot, patches.read))
    sigma = np.sqrt(shot * np.maximum(clean, 0) + read)
    return evaluate(Samples(real, fake[here], clean, sigma), evaluators)


def _pool(rows: Iterable[Mapping[str, Mapping[str, float]]], models: Iterable[str]) -> dict[str, Any]:
    rows = list(rows)
    return {model: pooled([row[model] for row in rows]) for model in models}


def excess(numbers: Mapping[str, float]) -> float:
    """KL above its finite-sample floor, nats."""
    return numbers["kl"] - numbers["kl_floor"]
