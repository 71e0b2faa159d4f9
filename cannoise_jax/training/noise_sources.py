"""What a denoiser can be trained on: one function a noise model, from a clean mosaic to a noisy one.

A source is `(key, clean) -> noisy`, mosaics `[H, W]` of the training part's size, normalised as in
`denoise_data`: 1 is full scale. All are about a black level of zero: that of the recordings is the median of
the training darks of the exposure, and that of a sensor model is the median of its own darks.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.model_file import load_model
from cannoise_jax.physics.core.mechanism import HasRecord
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.single_image import estimate_nlf
from cannoise_jax.physics.synthetic.scenes import numpy_generator
from cannoise_jax.recordings.packing import pack, to_mosaic_order, unpack
from cannoise_jax.recordings.recording import BadInput, mosaic_map
from cannoise_jax.sampling import Model, sample_noise
from cannoise_jax.training.denoise_data import HalfReal, dim_scenes, site_medians, with_photons
from cannoise_jax.training.refine import iso_of, own_black, span_of

Source = Callable[[Any, Float[np.ndarray, "h w"]], Float[np.ndarray, "h w"]]

REFERENCE_SCENES = 8


class LightWarning(UserWarning):
    """What a sensor model has of the light of its recordings, which other scenes do not have."""


def gaussian(data: HalfReal) -> Source:
    """N(0, shot): the shot coefficient taken as a variance, the paper's Gaussian."""
    return _white(lambda clean: np.full_like(clean, 1 / data.full_scale_e))


def gaussian_pooled(data: HalfReal) -> Source:
    """One variance for all pixels, that of the training noise at the scenes' mean signal (Noise Flow's)."""
    read = float(np.var(data.train))
    return _white(lambda clean: np.full_like(clean, clean.mean() / data.full_scale_e + read))


def poisson_gaussian(data: HalfReal) -> Source:
    """Counted photons and Gaussian read noise, as photon transfer measures it on the training part."""
    return _photons_and(
        data, lambda rng, shape: data.read_noise_e / data.full_scale_e * rng.normal(size=shape)
    )


def poisson_gaussian_at_exposure(data: HalfReal) -> Source:
    """The same, the read noise that of the darks of this very exposure, robust against hot pixels."""
    sigma = robust_std(data.train, 0)
    return _photons_and(data, lambda rng, shape: sigma * rng.normal(size=shape))


def poisson_gaussian_estimated(data: HalfReal) -> Source:
    """Normal noise of the level that `estimate_nlf` reads off noisy training images, without any fit."""
    shot, read = (np.asarray(v) for v in estimate_nlf(jnp.asarray(references(data))))
    shot, read = (np.asarray(to_mosaic_order(v, data.cfa)) for v in (shot, read))

    def variance(clean):
        return mosaic_map(shot, clean.shape) * np.maximum(clean, 0) + mosaic_map(read, clean.shape)

    return _white(variance)


def real_darks(data: HalfReal) -> Source:
    """Counted photons on the training darks themselves: the best that darks can teach."""
    return _photons_and(data, lambda rng, shape: data.train[rng.integers(len(data.train))])


def random_phase(data: HalfReal) -> Source:
    """Counted photons and Gaussian noise with the power spectrum of a training dark: its phases at random.

    Rows, columns and neighbours are kept with it; tails and hot pixels are not.
    """

    def noise(rng, shape):
        dark = data.train[rng.integers(len(data.train))]
        size = np.abs(np.fft.rfft2(dark - dark.mean()))
        white = np.fft.rfft2(rng.normal(size=shape))
        return np.fft.irfft2(size * white / np.maximum(np.abs(white), 1e-12), shape)

    return _photons_and(data, noise)


def sensor(data: HalfReal, model: SensorModel) -> Source:
    """Frames of a camera model at this exposure, about the median of its own darks."""
    iso = iso_of(data, model)
    settings = Settings(iso=iso, exposure_s=data.exposure_s, frames=1)
    span = np.float32(span_of(model, iso))
    # The frozen patterns of the unit are drawn once, and so is where its black level lies.
    height, width = data.train.shape[1:]
    model = model.with_maps((height, width))
    black = mosaic_map(own_black(data, model), (height, width))

    def draw(key, clean):
        # The model's own gain may differ from the measured one: the signal is what must agree.
        frame = model.sample(key, clean * np.float32(data.span_dn) / span, settings)[0]
        return (np.asarray(frame, np.float32) - black) / np.float32(data.span_dn)

    return draw


def learned(data: HalfReal, folder: Path) -> Source:
    """Noise of a trained model that is shown noisy training images of this camera."""
    model, shown = load_model(folder), jnp.asarray(references(data))
    sample = jax.jit(sample_noise)

    def draw(key, clean):
        packed = jnp.asarray(pack(clean, data.cfa))
        return np.asarray(unpack(np.asarray(packed + sample(model, key, packed, shown)), data.cfa))

    return draw


def refined(data: HalfReal, model: Model) -> Source:
    """Frames of a generator that starts from a sensor model at this exposure (`refine`), about the median of
    its own darks."""
    own = model.sensors[0]
    scale = np.float32(data.span_dn / span_of(own, iso_of(data, own)))
    level = (scale / data.full_scale_e, 0.0)
    sample = jax.jit(sample_noise)

    def frame(key, clean):
        packed = jnp.asarray(pack(clean * scale, data.cfa))
        noise = sample(model, key, packed, packed, level)
        return np.asarray(unpack(np.asarray(packed + noise), data.cfa)) / scale

    flat = np.zeros(data.train.shape[1:], np.float32)
    darks = np.stack([frame(jax.random.key(k), flat) for k in range(4)])
    height, width = data.train.shape[1:]
    black = mosaic_map(site_medians(darks), (height, width))
    return lambda key, clean: frame(key, clean) - black


def references(data: HalfReal) -> Float[np.ndarray, "n h w 4"]:
    """Noisy training images, packed, as a model or an estimator of levels is shown them."""
    height, width = data.train.shape[1:]
    size = (min(128, height), min(128, width))
    clean = dim_scenes(jax.random.key(17), "train", REFERENCE_SCENES, size, data.cfa)
    out = []
    for i, scene in enumerate(clean):
        left = (i * size[1]) % (width - size[1] + 1) // 2 * 2
        dark = data.train[i % len(data.train), : size[0], left : left + size[1]]
        out.append(with_photons(jax.random.key(100 + i), scene, data.full_scale_e) + dark)
    return pack(np.stack(out).astype(np.float32), data.cfa)


def _white(variance: Callable[[np.ndarray], np.ndarray]) -> Source:
    def draw(key, clean):
        noise = numpy_generator(key).normal(size=clean.shape)
        return (clean + np.sqrt(variance(clean)) * noise).astype(np.float32)

    return draw


def _photons_and(data: HalfReal, noise: Callable[[np.random.Generator, tuple], np.ndarray]) -> Source:
    """The photons' key is the same for every noise model, so that they differ in the floor alone."""

    def draw(key, clean):
        photons, floor = jax.random.split(key)
        lit = with_photons(photons, clean, data.full_scale_e)
        return (lit + noise(numpy_generator(floor), clean.shape)).astype(np.float32)

    return draw


NAMED: dict[str, Callable[[HalfReal], Source]] = {
    "gaussian": gaussian,
    "gaussian_pooled": gaussian_pooled,
    "pg": poisson_gaussian,
    "pg_at_exposure": poisson_gaussian_at_exposure,
    "pg_estimated": poisson_gaussian_estimated,
    "random_phase": random_phase,
    "real_darks": real_darks,
}
"""Sources that need the recordings alone."""
FITTED = ("calibrated", "discovered")
"""Sensor models, fitted to the training part."""
REFINED = {f"ours_on_{name}": name for name in FITTED}
"""Generators that start from them, trained on the training part."""


def open_source(
    name: str, data: HalfReal, sensors: dict[str, SensorModel], models: dict[str, Model | None] | None = None,
    mechanisms: Sequence[HasRecord] = (),
) -> Source:  # fmt: skip
    """A source by its name in `NAMED`, `sensors` or `models` (generators that refine a sensor; None: nothing
    was gained by it, and the sensor is taken as it is), or of a sensor.json or trained model named by path.
    mechanisms: entries from outside the package that a sensor.json may name.

    "A+real_darks" shows one image of real darks to five of A. Raises BadInput for what is none.
    """
    base, plus, more = name.partition("+")
    if plus:
        synthetic, real = (open_source(n, data, sensors, models, mechanisms) for n in (base, more))
        return mixed(synthetic, real)
    if models and name in models:
        model = models[name]
        return sensor(data, sensors[REFINED[name]]) if model is None else refined(data, model)
    if name in NAMED:
        return NAMED[name](data)
    if name in sensors:
        return sensor(data, sensors[name])
    path = Path(name)
    if path.suffix == ".json" and path.is_file():
        camera = SensorModel.load(path, mechanisms)
        alone = camera.under_steady_light()
        gone = {f.mechanism for f in camera.mechanisms} - {f.mechanism for f in alone.mechanisms}
        if gone:
            said = f"{path}: taken without {', '.join(sorted(gone))}: the light of its recordings"
            warnings.warn(said, LightWarning, stacklevel=2)
        return sensor(data, alone)
    if path.exists():
        return learned(data, path)
    known = ", ".join([*NAMED, *FITTED, *REFINED])
    raise BadInput(f"--noise {name}: neither {known}, nor a sensor.json or a trained model")


def mixed(synthetic: Source, real: Source, ratio: int = 5) -> Source:
    """`ratio` synthetic images to one real one, at random."""

    def draw(key, clean):
        chosen = int(numpy_generator(jax.random.fold_in(key, 3)).integers(ratio + 1))
        return (real if chosen == ratio else synthetic)(key, clean)

    return draw
