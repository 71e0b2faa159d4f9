"""What a run trains on and is measured on: drawn cameras, virtual cameras, folders of recordings, or SIDD.

Drawn cameras come from a prior over the sensor grammar and are as many as one likes; a run that is trained on
them is measured on the virtual cameras, none of which it has seen. Three sets of scenes that share none:
training; validation, which picks the best checkpoint; test, which the final table is about and nothing else
looks at.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float, Int
from ml_collections import ConfigDict

from cannoise_jax.evaluation.baselines import calibrate_by_setting
from cannoise_jax.evaluation.kl import clipped_noise
from cannoise_jax.physics.synthetic.scenes import SPLITS
from cannoise_jax.physics.synthetic.virtual import virtual_cameras, virtual_patches
from cannoise_jax.recordings.patches import (
    PatchStore,
    counts_by_split,
    open_patches,
    split_scenes,
    write_patches,
)
from cannoise_jax.recordings.pipeline import ArrayPatches, BatchIterator, PatchSource, batches
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.sidd import load_sidd, scene_id
from cannoise_jax.sampling import Camera, Setting
from cannoise_jax.training.drawn import DrawnBatches, DrawnCameras, drawn_cameras
from cannoise_jax.training.recorded import recorded_patches

Levels = dict[tuple[int, int], tuple[float, float]]


@dataclass(eq=False)
class HeldOut:
    """Patches to measure on, as `evaluation.compare` takes them; packed `[n, h, w, 4]`, `[n, 4]`, `[n]`."""

    clean: Float[np.ndarray, "n h w 4"]
    noisy: Float[np.ndarray, "n h w 4"]
    shot: Float[np.ndarray, "n 4"]
    read: Float[np.ndarray, "n 4"]
    camera: Int[np.ndarray, "n"]
    iso: Int[np.ndarray, "n"]
    scene: Int[np.ndarray, "n"]

    def some(self, count: int) -> HeldOut:
        """`count` patches spread evenly over the set; all of them where it has no more."""
        chosen = self.spread(count)
        return HeldOut(**{name: np.asarray(value)[chosen] for name, value in vars(self).items()})

    def spread(self, count: int) -> Int[np.ndarray, "m"]:
        """Indices of `count` patches spread evenly over the set; of all where it has no more."""
        total = len(self.camera)
        return np.unique(np.linspace(0, total - 1, min(count, total)).round().astype(int))


@dataclass(frozen=True, eq=False)
class TrainingData:
    """train: patches to learn from. recalibrated: (shot, read) by (camera, ISO), fitted to them.

    examples: for each camera some of its noisy patches, and its noise level functions by ISO.
    validation_cameras, trained_on: names and number, where those of the test are not the ones of training.
    """

    train: PatchSource | DrawnCameras
    validation: HeldOut
    test: HeldOut
    cameras: tuple[str, ...]
    recalibrated: Levels
    examples: dict[str, Camera]
    validation_cameras: tuple[str, ...] | None = None
    trained_on: int | None = None

    @property
    def known(self) -> int:
        """How many cameras the critic may be told apart."""
        return len(self.cameras) if self.trained_on is None else self.trained_on

    def batches(self, config: ConfigDict, part: int = 0, parts: int = 1) -> BatchIterator:
        """Endless batches of the training patches as the config has them; of every batch the rows of one of
        equal parts."""
        if isinstance(self.train, DrawnCameras):
            return DrawnBatches(self.train, config.batch_size, config.seed, config.patch, part, parts)
        return batches(
            self.train,
            config.batch_size,
            seed=config.seed,
            size=config.patch,
            reference_size=config.reference,
            triplet=bool(config.loss.triplet),
            part=part,
            parts=parts,
        )

    def noisy_examples(self) -> Float[np.ndarray, "n h w 4"]:
        """Noisy training images of many cameras, on which E's statistics are standardised."""
        if isinstance(self.train, DrawnCameras):
            return self.train.noisy(np.arange(min(len(self.train), 128)), 0)
        return np.concatenate([camera.reference for camera in self.examples.values()])


def load_data(
    config: ConfigDict, workdir: Path, tell: Callable[[int, int], None] = lambda done, total: None
) -> TrainingData:
    """The data that `config.data` names. tell: how far the drawing of cameras is. Raises BadInput."""
    loaders: dict[str, Callable[[ConfigDict, Path], TrainingData]] = {
        "drawn": partial(_drawn, tell=tell),
        "virtual": _virtual,
        "recordings": _recordings,
        "sidd": _sidd,
    }
    if config.data.source not in loaders:
        raise BadInput(f"config.data.source: {config.data.source!r}: use one of {', '.join(loaders)}")
    return loaders[config.data.source](config, workdir)


def _drawn(config: ConfigDict, workdir: Path, tell: Callable[[int, int], None]) -> TrainingData:
    """Training and validation on drawn cameras; the virtual cameras are the test."""
    data, cameras = config.data, virtual_cameras()
    key = jax.random.key(data.seed)
    train = drawn_cameras(key, "train", data.cameras, data.references, data.scenes, tell)
    held = drawn_cameras(
        jax.random.fold_in(key, 1), "validation", data.validation_cameras, config.references,
        data.validation_scenes,
    )  # fmt: skip
    test = HeldOut(**virtual_patches(key, "test", data.test_scenes, data.held_out_per_scene)._asdict())
    shown = virtual_patches(key, "validation", data.calibration_scenes, data.per_scene)
    known = HeldOut(**shown._asdict())
    levels = calibrate_by_setting(
        known.clean, clipped_noise(known.noisy - known.clean, known.clean), known.camera, known.iso
    )
    for i, (c, iso) in enumerate(zip(known.camera.tolist(), known.iso.tolist(), strict=True)):
        known.shot[i], known.read[i] = levels[c, iso]
    names = tuple(camera.name for camera in cameras)
    return TrainingData(
        train, _held_out_of(held), test, names, levels, _examples(known, names),
        tuple(f"drawn {n}" for n in range(len(held))), len(train),
    )  # fmt: skip


def _held_out_of(drawn: DrawnCameras) -> HeldOut:
    """Every patch of the first setting of each camera."""
    count, patches = len(drawn), drawn.references + 1
    camera, patch = (v.ravel() for v in np.mgrid[:count, :patches])
    shot, read = (np.repeat(drawn.level[camera, i][:, None], 4, 1) for i in (0, 1))
    return HeldOut(
        clean=drawn.clean(camera, patch),
        noisy=drawn.noisy(camera, patch),
        shot=shot,
        read=read,
        camera=camera.astype(np.int32),
        iso=np.zeros(len(camera), np.int32),
        scene=np.arange(len(camera), dtype=np.int32),
    )


def _virtual(config: ConfigDict, workdir: Path) -> TrainingData:
    data, cameras = config.data, virtual_cameras()
    key = jax.random.key(data.seed)
    counts = (data.scenes, data.validation_scenes, data.test_scenes)
    per_scene = (data.per_scene, data.held_out_per_scene, data.held_out_per_scene)
    parts = [
        virtual_patches(key, split, count, each)
        for split, count, each in zip(SPLITS, counts, per_scene, strict=True)
    ]
    train, validation, test = (HeldOut(**part._asdict()) for part in parts)
    names, cfas = tuple(camera.name for camera in cameras), tuple(camera.cfa for camera in cameras)
    return _in_memory(train, validation, test, names, cfas)


def _recordings(config: ConfigDict, workdir: Path) -> TrainingData:
    data = config.data
    overrides: dict[str, Any] = {
        name: data[name] for name in ("cfa", "black_level", "white_level") if data[name] is not None
    }
    folders = [Path(folder) for folder in data.recordings]
    names, cfas, parts = recorded_patches(
        folders,
        overrides,
        jax.random.key(data.seed),
        data.half_real_scenes,
        data.per_recording,
        triplet=bool(config.loss.triplet),
        exposure_s=config.exposure_s,
    )
    train, validation, test = (HeldOut(**part) for part in parts)
    return _in_memory(train, validation, test, names, cfas)


def _in_memory(
    train: HeldOut, validation: HeldOut, test: HeldOut, cameras: tuple[str, ...], cfas: tuple[str, ...]
) -> TrainingData:
    source = ArrayPatches(
        train.clean, train.noisy, train.shot, train.read, train.camera, cameras, cfas, train.iso
    )
    noise = clipped_noise(train.noisy - train.clean, train.clean)
    levels = calibrate_by_setting(train.clean, noise, train.camera, train.iso)
    return TrainingData(source, validation, test, cameras, levels, _examples(train, cameras))


def _examples(train: HeldOut, cameras: tuple[str, ...], count: int = 8) -> dict[str, Camera]:
    made = {}
    for c, name in enumerate(cameras):
        own = np.flatnonzero(train.camera == c)
        settings = {}
        for iso in np.unique(train.iso[own]):
            first = own[train.iso[own] == iso][0]
            settings[str(iso)] = Setting(train.shot[first], train.read[first])
        spread = own[np.unique(np.linspace(0, len(own) - 1, min(count, len(own))).astype(int))]
        made[name] = Camera(train.noisy[spread], settings)
    return made


def _sidd(config: ConfigDict, workdir: Path) -> TrainingData:
    """SIDD Medium: the paper's scenes 001, 002 and 008 are the test, one more scene is for validation."""
    data = config.data
    if not data.path:
        raise BadInput("config.data.path: not set: name the folder of SIDD Medium: --config.data.path=DIR")
    store = _sidd_store(config, workdir)
    rest, test = split_scenes(store, tuple(data.test_scenes))
    if data.validation_scene not in store.scenes or data.validation_scene in data.test_scenes:
        known = ", ".join(scene for scene in store.scenes if scene not in data.test_scenes)
        raise BadInput(f"config.data.validation_scene: {data.validation_scene!r}: use one of {known}")
    validation_scene = store.scenes.index(data.validation_scene)
    indices = np.asarray(rest.indices)  # type: ignore[attr-defined]
    held = store.scene[indices] == validation_scene
    train = type(rest)(store, indices[~held])  # type: ignore[call-arg]
    sample = _held_out(store, indices[~held], data.calibration_patches)
    noise = clipped_noise(sample.noisy - sample.clean, sample.clean)
    return TrainingData(
        train,
        _held_out(store, indices[held], data.held_out_patches),
        _held_out(store, np.asarray(test.indices), data.held_out_patches),  # type: ignore[attr-defined]
        store.cameras,
        calibrate_by_setting(sample.clean, noise, sample.camera, sample.iso),
        _examples(sample, store.cameras),
    )


def _sidd_store(config: ConfigDict, workdir: Path) -> PatchStore:
    folder = workdir / "patches"
    if folder.is_dir():
        return open_patches(folder)
    if jax.process_count() > 1:
        raise BadInput(f"{folder}: missing: start the run by one process, which stores them, then by several")
    captures = load_sidd(config.data.path)
    recordings = [(r, scene_id(r)) for captured in captures for r in captured.recordings]
    scenes = [scene for _, scene in recordings]
    counts = counts_by_split(
        scenes, config.data.test_scenes, config.data.train_patches, config.data.test_patches
    )
    return write_patches(folder, recordings, counts, seed=config.data.seed)


def _held_out(store: PatchStore, indices: Sequence[int] | np.ndarray, count: int) -> HeldOut:
    """`count` stored patches in memory, spread evenly, cut to 64 x 64."""
    indices = np.asarray(indices)
    chosen = indices[np.unique(np.linspace(0, len(indices) - 1, min(count, len(indices))).astype(int))]
    found = [store[int(i)] for i in chosen]
    return HeldOut(
        clean=np.stack([f["clean"][:64, :64] for f in found]),
        noisy=np.stack([f["noisy"][:64, :64] for f in found]),
        shot=np.stack([f["shot"] for f in found]),
        read=np.stack([f["read"] for f in found]),
        camera=store.camera[chosen],
        iso=np.array([round(float(f["iso"])) for f in found], np.int32),
        scene=store.scene[chosen],
    )
