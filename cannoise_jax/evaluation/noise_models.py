"""The noise models that the experiments set side by side, all with one signature.

`draw(key, references) -> noise` gives, for every test patch of a `Bench`, noise as that model makes it;
packed `[n, h, w, 4]`, normalised units, clipped as a recording clips it. references: `[n, k]`, indices of the
test patches that a model may look at. What each model is told about the camera is said in `KNOWS`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Key
from scipy import stats

from cannoise_jax.evaluation.baselines import calibrate_by_setting
from cannoise_jax.evaluation.kl import clipped_noise
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.single_image import estimate_nlf
from cannoise_jax.physics.synthetic.scenes import numpy_generator
from cannoise_jax.physics.synthetic.virtual import (
    VirtualCamera,
    VirtualPatches,
    record,
    virtual_cameras,
    virtual_patches,
)
from cannoise_jax.recordings.packing import pack, unpack
from cannoise_jax.sampling import Model, of_camera, sample_noise

Draw = Callable[[Any, Int[np.ndarray, "n k"]], Float[np.ndarray, "n h w 4"]]

KNOWS = {
    "gaussian": "published shot coefficient, as a variance everywhere",
    "gaussian_pooled": "variance of all training noise",
    "pg": "published noise level function of the setting",
    "pg_estimated": "the references alone",
    "pg_recalibrated": "noise level function fitted to training pairs of the setting",
    "noise_flow": "training pairs of camera and setting, whose names it is told",
    "eld": "as pg_recalibrated, and a dark frame of the setting: tails, rows",
    "random_phase": "as pg_recalibrated, and a dark frame of the setting: its spectrum",
    "real_darks": "as pg_recalibrated, and dark frames of the setting",
    "calibrated": "flats and darks: bin/calibrate",
    "discovered": "flats and darks: bin/diagnose",
    "model": "the references alone",
    "truth": "the camera itself: the floor of every number",
}
_DARK_SIDE, _DARK_FRAMES = 256, 2


@dataclass(frozen=True, eq=False)
class Bench:
    """Test patches of cameras with known truth, and training patches for whatever is fitted to them."""

    test: VirtualPatches
    train: VirtualPatches
    cameras: tuple[VirtualCamera, ...]

    @property
    def size(self) -> int:
        """Number of test patches."""
        return len(self.test.camera)

    @property
    def group(self) -> Int[np.ndarray, "n"]:
        """A number for every camera and setting."""
        return 100_000 * np.asarray(self.test.camera) + np.asarray(self.test.iso)

    @property
    def unit(self) -> Int[np.ndarray, "n"]:
        """A number for every camera and scene: what intervals are drawn over."""
        return 100_000 * np.asarray(self.test.camera) + np.asarray(self.test.scene)


def make_bench(
    seed: int, scenes: int, per_scene: int, train_scenes: int, ratio: float | None = None
) -> Bench:
    """The five virtual cameras on test scenes that no training sees. ratio: see `virtual_cameras`."""
    key, cameras = jax.random.key(seed), virtual_cameras(ratio)
    test = virtual_patches(key, "test", scenes, per_scene, cameras)
    return Bench(test, virtual_patches(key, "train", train_scenes, per_scene, cameras), cameras)


def references_of(bench: Bench, count: int, seed: int, kind: str = "same") -> Int[np.ndarray, "n k"]:
    """`count` references of every patch, of other scenes where there are any.

    kind: "same" camera and setting (A|i), "setting": same camera at another setting (A|j), "camera": another
    camera (B|i). Repeated where there are too few.
    """
    camera, iso, scene = (np.asarray(v) for v in (bench.test.camera, bench.test.iso, bench.test.scene))
    rng = np.random.default_rng(seed)
    out = np.zeros((bench.size, count), int)
    for i in range(bench.size):
        own, away = camera == camera[i], scene != scene[i]
        wanted = {
            "same": (own & (iso == iso[i]) & away, own & (iso == iso[i]) & (np.arange(bench.size) != i), own),
            "setting": (own & (iso != iso[i]) & away, own & (iso != iso[i])),
            "camera": ((camera != camera[i]) & away, camera != camera[i]),
        }[kind]
        pool = next((np.flatnonzero(w) for w in wanted if w.any()), np.array([i]))
        # All of one camera and setting, as the noise model is promised.
        first = rng.choice(pool)
        pool = pool[(camera[pool] == camera[first]) & (iso[pool] == iso[first])]
        out[i] = rng.choice(pool, count, replace=len(pool) < count)
    return out


BASELINES = (
    *("gaussian", "gaussian_pooled", "pg", "pg_estimated", "pg_recalibrated", "eld", "random_phase"),
    *("real_darks", "truth"),
)
"""The names that `baselines` gives."""


def fitted_levels(bench: Bench) -> Float[np.ndarray, "n 2"]:
    """(shot, read) of every test patch's camera and setting, fitted to its training pairs; the published ones
    of a setting without any."""
    train, test = bench.train, bench.test
    pairs = clipped_noise(train.noisy - train.clean, train.clean)
    fitted = calibrate_by_setting(train.clean, pairs, train.camera, train.iso)
    keys = zip(test.camera.tolist(), test.iso.tolist(), strict=True)
    published = zip(test.shot[:, 0].tolist(), test.read[:, 0].tolist(), strict=True)
    return np.array([fitted.get(k, p) for k, p in zip(keys, published, strict=True)], np.float32)


def baselines(bench: Bench) -> dict[str, Draw]:
    """Every noise model that needs nothing but the bench."""
    test = bench.test
    pairs = clipped_noise(bench.train.noisy - bench.train.clean, bench.train.clean)
    levels = fitted_levels(bench)
    pooled = float(np.var(pairs))
    clean = np.maximum(test.clean, 0)

    def image(values):
        return np.asarray(values, np.float32).reshape(bench.size, 1, 1, -1)

    def white(variance) -> Draw:
        def draw(key, references):
            noise = np.asarray(jax.random.normal(key, test.clean.shape))
            return clipped_noise(np.sqrt(variance(references)) * noise, test.clean)

        return draw

    def recalibrated(_):
        return image(levels[:, 0]) * clean + image(levels[:, 1])

    floors = lru_cache(maxsize=None)(partial(_darks, bench))

    settings = list(zip(test.camera.tolist(), test.iso.tolist(), strict=True))

    def on_floor(noise: Callable[[np.random.Generator, np.ndarray, tuple], np.ndarray]) -> Draw:
        """Shot noise at the re-calibrated level, and a floor made from the darks of the setting."""

        def draw(key, references):
            rng = numpy_generator(key)
            made = np.empty_like(test.clean)
            for i, (c, iso) in enumerate(settings):
                shape = (2 * test.clean.shape[1], 2 * test.clean.shape[2])
                floor = pack(noise(rng, floors(c, iso), shape).astype(np.float32), bench.cameras[c].cfa)
                shot = levels[i, 0]
                light = shot * rng.poisson(clean[i] / max(shot, 1e-9)) if shot > 1e-9 else clean[i]
                made[i] = light - clean[i] + floor
            return clipped_noise(made, test.clean)

        return draw

    return {
        "gaussian": white(lambda _: image(test.shot[:, :1])),
        "gaussian_pooled": white(lambda _: np.float32(pooled)),
        "pg": white(lambda _: image(test.shot) * clean + image(test.read)),
        "pg_estimated": estimated_draw(bench),
        "pg_recalibrated": white(recalibrated),
        "eld": on_floor(_eld),
        "random_phase": on_floor(_random_phase),
        "real_darks": on_floor(_crop),
        "truth": sensors(bench, {c.name: c.sensor for c in bench.cameras}),
    }


def estimated_draw(bench: Bench) -> Draw:
    """Normal noise of the level that the references alone show."""
    test = bench.test

    def draw(key, references):
        levels = _estimated(test.noisy[references]).swapaxes(0, 1)
        shot, read = (np.asarray(v, np.float32).reshape(bench.size, 1, 1, -1) for v in levels)
        noise = np.asarray(jax.random.normal(key, test.clean.shape))
        return clipped_noise(np.sqrt(shot * np.maximum(test.clean, 0) + read) * noise, test.clean)

    return draw


@jax.jit
def _estimated(references):
    """(shot, read) of each patch by its references, `[n, 2, 4]`."""
    return jax.lax.map(lambda r: jnp.stack(estimate_nlf(r)), references)


def _darks(bench: Bench, camera: int, iso: int) -> Float[np.ndarray, "t h w"]:
    """Dark frames of a setting, normalised; cut at the black level where that is the lowest code."""
    own = bench.cameras[camera]
    key = jax.random.fold_in(jax.random.key(camera), iso)
    taken, _ = record(own, key, np.zeros((_DARK_SIDE, _DARK_SIDE), np.float32), iso, _DARK_FRAMES)
    return (taken.astype(np.float32) - own.black_level) / np.float32(own.white_level - own.black_level)


def _crop(rng, darks, shape) -> np.ndarray:
    y, x = (2 * int(rng.integers((n - s) // 2 + 1)) for n, s in zip(darks.shape[1:], shape, strict=True))
    return darks[rng.integers(len(darks)), y : y + shape[0], x : x + shape[1]]


def _random_phase(rng, darks, shape) -> np.ndarray:
    """Gaussian noise with the power spectrum of a dark; its mean stays."""
    dark = _crop(rng, darks, shape)
    size, white = np.abs(np.fft.rfft2(dark - dark.mean())), np.fft.rfft2(rng.normal(size=shape))
    return np.fft.irfft2(size * white / np.maximum(np.abs(white), 1e-12), shape) + dark.mean()


def _eld(rng, darks, shape) -> np.ndarray:
    """Tukey-lambda read noise and Gaussian rows about the mean of each colour, fitted to the darks (Wei et
    al. 2020); the rounding of the codes is in the darks that are fitted."""
    shape_, scale, rows, means = _eld_fit(darks.tobytes(), darks.shape)
    out = scale * stats.tukeylambda.rvs(shape_, size=shape, random_state=rng)
    out += rows * rng.normal(size=(shape[0], 1))
    return out + np.tile(means, (shape[0] // 2, shape[1] // 2))


@lru_cache(maxsize=64)
def _eld_fit(content: bytes, shape: tuple) -> tuple[float, float, float, np.ndarray]:
    darks = np.frombuffer(content, np.float32).reshape(shape)
    means = np.array([[darks[:, i::2, j::2].mean() for j in (0, 1)] for i in (0, 1)])
    z = darks - np.tile(means, (shape[1] // 2, shape[2] // 2))
    line = z.mean(axis=2)
    rows = float(np.sqrt(max(line.var() - z.var() / shape[2], 0)))
    values = np.sort((z - line[..., None]).ravel())[:: max(1, z.size // 4000)]
    best = float(stats.ppcc_max(values, brack=(-0.3, 0.3), dist="tukeylambda"))
    lam = float(np.clip(best, -0.45, 1.0))
    scale = float(np.std(values)) / float(np.sqrt(stats.tukeylambda.var(lam)))
    return lam, scale, rows, means


def sensors(bench: Bench, models: Mapping[str, SensorModel]) -> Draw:
    """Frames of camera models by camera name, at the setting of every patch, in their own black and white."""

    def draw(key, references):
        test, made = bench.test, np.empty_like(bench.test.clean)
        for i in range(bench.size):
            camera = bench.cameras[int(test.camera[i])]
            model = models[camera.name]
            mosaic = np.asarray(unpack(test.clean[i], camera.cfa), np.float32)
            own = jax.random.fold_in(key, i)
            if model is camera.sensor:
                taken, expected = record(camera, own, mosaic, int(test.iso[i]))
            else:
                taken = np.asarray(model.sample(own, mosaic, Settings(iso=float(test.iso[i]))))
                expected = mosaic
            frame = taken[0].astype(np.float32) - np.float32(camera.black_level)
            noise = frame / np.float32(camera.white_level - camera.black_level) - expected
            made[i] = pack(noise, camera.cfa)
        return clipped_noise(made, test.clean)

    return draw


def learned(bench: Bench, model: Model, batch: int = 16, given: Any = None) -> Draw:
    """A trained model by its public call: shown the references, told nothing else, unless it was trained with
    levels that are handed over: then the published ones. given: levels `(shot, read)`, `[n, 4]` each. Of a
    model with a sensor for each camera every patch gets that of its own."""
    told = given if given is not None else (bench.test.shot, bench.test.read)
    hand_over = given is not None or getattr(model, "level", "both") == "given"
    parts = [(model, np.arange(bench.size))]
    if len(getattr(model, "sensors", ())) > 1:
        camera = np.asarray(bench.test.camera)
        parts = [
            (of_camera(model, own.name), np.flatnonzero(camera == c)) for c, own in enumerate(bench.cameras)
        ]
    batch = min(batch, max(len(members) for _, members in parts))

    def draw(key, references):
        clean, noisy = bench.test.clean, bench.test.noisy
        made = np.empty_like(clean)
        for own, members in parts:
            for start in range(0, len(members), batch):
                index = members[np.minimum(np.arange(start, start + batch), len(members) - 1)]
                keys = jax.random.split(jax.random.fold_in(key, int(members[start])), batch)
                nlf = (told[0][index], told[1][index]) if hand_over else None
                noise = np.asarray(_sample(own, keys, clean[index], noisy[references[index]], nlf))
                count = min(batch, len(members) - start)  # the last batch is filled up with its last patch
                made[index[:count]] = clipped_noise(noise[:count], clean[index[:count]])
        return made

    return draw


@jax.jit
def _sample(model, keys, clean, references, nlf):
    return jax.vmap(partial(sample_noise, model))(keys, clean, references, nlf)


def draw_key(seed: int, name: str) -> Key[Array, ""]:
    """The key of a noise model's draws; that of the learned model does not depend on what it is shown."""
    return jax.random.fold_in(jax.random.key(seed), sum(name.encode()))
