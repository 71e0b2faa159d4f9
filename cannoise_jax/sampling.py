"""Camera-aware noise for a clean image: `sample_noise`, and the model that it takes.

A model is one pytree: the folded parameters of G and E and, for every camera it was trained on, reference
patches and noise level functions are its leaves; everything static is its structure. So it passes through
`jax.jit`, `jax.vmap` and `jax.grad` like any array.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Key

from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.networks.branches import NoiseLevel
from cannoise_jax.networks.encoder import mean_latent
from cannoise_jax.networks.layers import fold_spectral_norm
from cannoise_jax.physics.core.ranges import check_key
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.initial_noise import InitialNoise, initial_noise, sensors_of
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.single_image import estimate_nlf

SMALLEST = 16
"""Least height and width of clean images, packed pixels; smaller references are repeated up to it."""
LEVELS = ("estimated", "given", "both")
"""Where the level of the initial noise comes from: the references, whoever asks for noise, or either."""
_BRIGHTEST, _DARKEST = 4.0, -0.5
"""Median of a clean image beyond which it must be in DN: scenes may pass the white level, not by that."""
_MULTIPLE, _MARGIN = 32, 32
"""G works on multiples of 32; a reflected margin keeps the zero padding of its layers out of the image."""


@struct.dataclass
class Setting:
    """One ISO setting of a camera of the training set. shot, read: `[4]`, packed order, normalised units."""

    shot: Float[Array, "4"]
    read: Float[Array, "4"]


@struct.dataclass
class Camera:
    """A camera of the training set: noisy patches for the encoder and, by ISO, noise level functions."""

    reference: Float[Array, "n h w 4"]
    settings: dict[str, Setting]


@struct.dataclass
class Model:
    """What `sample_noise` needs. generator, encoder: variables, spectral norms folded; encoder: {} for none.

    generator_module, encoder_module, initial_noise, level: static; initial_noise a name or a function as in
    `physics.initial_noise`; level: of `LEVELS`, where the initial noise's level came from in training, as it
    must in use. sensors: the camera models that the initial noise is drawn from, instead of `initial_noise`:
    one for all cameras, or one for each, named by it; see `of_camera`. exposure_s: at which they are taken,
    with their own baseline; None: with the level that is told, at their default exposure.
    """

    generator: dict[str, Any]
    encoder: dict[str, Any]
    cameras: dict[str, Camera]
    generator_module: Generator = struct.field(pytree_node=False)
    encoder_module: Encoder | None = struct.field(pytree_node=False)
    initial_noise: str | InitialNoise = struct.field(pytree_node=False, default="poisson_gaussian")
    level: str = struct.field(pytree_node=False, default="both")
    sensors: tuple[SensorModel, ...] = ()
    exposure_s: float | None = struct.field(pytree_node=False, default=None)


def make_model(
    generator_module: Generator,
    generator: dict[str, Any],
    encoder_module: Encoder | None,
    encoder: dict[str, Any],
    cameras: dict[str, Camera] | None = None,
    initial_noise: str | InitialNoise = "poisson_gaussian",
    level: str = "both",
    exposure_s: float | None = None,
) -> Model:
    """A model from modules and their variables (`params` and `spectral`), as training leaves them.

    The sensors of an initial noise "sensor:FILE,FILE" are read and become part of the model. Raises
    ValueError for a level that is none of `LEVELS`, BadInput for a file that is no sensor.
    """
    if level not in LEVELS:
        raise ValueError(f"level must be one of {', '.join(LEVELS)}, got {level!r}")
    sensors = sensors_of(initial_noise)
    if sensors:
        initial_noise = "sensor"
    return Model(
        fold_spectral_norm(generator),
        fold_spectral_norm(encoder) if encoder_module else {},
        cameras or {},
        generator_module,
        encoder_module,
        initial_noise,
        level,
        sensors,
        exposure_s,
    )


def sample_noise(
    params: Model,
    key: Key[Array, ""],
    clean: Float[Array, "*b h w 4"],
    noisy_ref: Float[Array, "*n y x 4"],
    nlf: tuple[Any, Any] | None = None,
) -> Float[Array, "*b h w 4"]:
    """Noise as the camera of `noisy_ref` would put on `clean`: float32, normalised units, not clipped.

    clean, noisy_ref: packed R, Gr, Gb, B, normalised; h and w at least 16; references of any
    size, at least one. Several are of one camera and setting: their latents are averaged. nlf: (shot, read)
    of the setting wanted, one value or four in packed order, or `[*b, 4]`; without it the noise is that of
    the references' own setting, whose level is estimated from their pixels by the estimator that training
    used (`physics.single_image.estimate_nlf`). A reference without noise, constant or all zero, then gives
    next to none, sigma 3e-5. A noisy image is `clip(clean + noise, 0, 1)`.
    Pure; use `jax.vmap` for one reference per clean image.

    Raises ValueError for images of other shapes, in DN, or with NaN or infinite values, for a clean image
    with values far below black (-0.5; noise around black is fine), for an nlf that is negative or infinite,
    and for a level of another source than the model was trained with (`Model.level`), which would be
    corrected twice or not at all; TypeError for what is no model or no key. Of what is traced under jit only
    shapes are known: images in DN then give noise that is nan throughout, and single values and an nlf are
    not checked.
    """
    if not isinstance(params, Model):
        raise TypeError(f"params is a {type(params).__name__}: expected a Model, of load_model(workdir)")
    check_key(key)
    check_level(params.level, nlf is not None)
    initial_noise_of(params)  # a model with several sensors is refused before its images
    if any(jnp.iscomplexobj(image) for image in (clean, noisy_ref)):
        raise ValueError("clean and noisy_ref must be real")
    if any(jnp.asarray(image).dtype == bool for image in (clean, noisy_ref)):
        raise ValueError(
            "clean and noisy_ref must be numbers, 0 black and 1 white: these are truths, as of a mask"
        )
    clean, noisy_ref = jnp.asarray(clean, jnp.float32), jnp.asarray(noisy_ref, jnp.float32)
    _check(clean, "clean")
    _check(noisy_ref, "noisy_ref")
    if not noisy_ref.size:
        raise ValueError(f"noisy_ref must hold at least one image, got shape {noisy_ref.shape}")
    noisy_ref = repeated(noisy_ref)
    height, width = clean.shape[-3:-1]
    if min(height, width) < SMALLEST:
        raise ValueError(f"clean must be at least {SMALLEST}x{SMALLEST}, got shape {clean.shape}")
    shot, read = estimate_nlf(noisy_ref) if nlf is None else _checked_nlf(nlf)
    check_values(clean, noisy_ref)
    images = clean.reshape(-1, height, width, 4)
    per_image = (*clean.shape[:-3], 4)
    shot, read = (
        jnp.broadcast_to(jnp.asarray(v, jnp.float32), per_image).reshape(-1, 4) for v in (shot, read)
    )
    latent = jnp.repeat(_latent(params, noisy_ref), images.shape[0], 0)
    said = (float(nlf is not None), float(np.prod(noisy_ref.shape[:-3])))
    level = NoiseLevel(shot, read, *(jnp.full(images.shape[0], v) for v in said))
    noise = noise_at(params, key, images, latent, level).reshape(clean.shape)
    for image in (clean, noisy_ref):
        if isinstance(image, jax.core.Tracer):
            noise = jnp.where(_normalised(image), noise, jnp.nan)
    return noise


def noise_at(
    params: Model,
    key: Key[Array, ""],
    clean: Float[Array, "b h w 4"],
    latent: Float[Array, "b l"],
    level: NoiseLevel,
) -> Float[Array, "b h w 4"]:
    """`sample_noise` where the camera and the level are read off already."""
    height, width = clean.shape[1:3]
    noise_key, row_key = jax.random.split(key)
    margin = margin_of(params)
    padded = _pad(clean, margin)
    n_init, sigma = initial_noise_of(params)(noise_key, padded, level.shot, level.read)
    noise: Any = params.generator_module.apply(
        params.generator, padded, n_init, latent, sigma, train=False, level=level, rngs={"noise": row_key}
    )
    return noise[:, margin : margin + height, margin : margin + width]


def initial_noise_of(model: Model) -> InitialNoise:
    """What draws a model's initial noise: the sensor it holds, or the noise it names. Raises ValueError for a
    model with the sensors of several cameras."""
    if len(model.sensors) > 1:
        names = ", ".join(sensor.camera for sensor in model.sensors)
        raise ValueError(f"this model holds the sensors of {names}: choose one with of_camera(model, name)")
    if not model.sensors:
        return initial_noise(model.initial_noise)
    return model.sensors[0].n_init(exposure_s=model.exposure_s)


def of_camera(model: Model, name: str) -> Model:
    """The model with the sensor of one camera alone; as it is where it holds one for all, or none.

    Raises ValueError for a camera whose sensor it has not.
    """
    if len(model.sensors) < 2:
        return model
    own = tuple(sensor for sensor in model.sensors if sensor.camera == name)
    if not own:
        names = ", ".join(sensor.camera for sensor in model.sensors)
        raise ValueError(f"{name}: this model holds the sensors of {names}")
    return dataclasses.replace(model, sensors=own[:1])


def check_level(level: str, given: bool) -> None:
    """Raises ValueError where a model of this `Model.level` cannot take a level that is given, or none."""
    if level == "estimated" and given:
        raise ValueError("nlf: this model was trained with levels estimated from references: leave nlf out")
    if level == "given" and not given:
        raise ValueError(
            "nlf: missing: this model was trained with levels handed over: give nlf=(shot, read)"
        )


def _checked_nlf(nlf: tuple[Any, Any]) -> tuple[Any, Any]:
    if len(nlf) != 2:
        raise ValueError("nlf: give two numbers, (shot, read)")
    for name, value in zip(("shot", "read"), nlf, strict=True):
        if isinstance(value, jax.core.Tracer):
            continue
        values = np.asarray(value, np.float64)
        if not (np.isfinite(values).all() and (values >= 0).all()):
            raise ValueError(f"nlf: {name} must be finite and 0 or more, got {values.min():g} at least")
    return nlf


def check_values(clean: Array | np.ndarray, noisy_ref: Array | np.ndarray) -> None:
    """Raises ValueError where an image holds values that are not finite, or is in DN. Traced ones pass."""
    remedy = "so it is not normalised: give (DN - black) / (white - black)"
    for name, image in (("clean", clean), ("noisy_ref", noisy_ref)):
        if isinstance(image, jax.core.Tracer) or not image.size:
            continue
        values = np.asarray(image)  # of constants of a traced function too
        if not np.isfinite(values).all():
            raise ValueError(f"{name} holds NaN or infinite values: replace them")
        middle, least = float(median(values)), float(values.min())
        if not _DARKEST <= middle <= _BRIGHTEST:
            raise ValueError(f"{name} has median {middle:.4g}, {remedy}")
        # References are noisy: single pixels of theirs may be anywhere.
        if name == "clean" and least < _DARKEST:
            raise ValueError(f"clean has lowest value {least:.4g}, {remedy}")


def _normalised(image: Array) -> Bool[Array, ""]:
    """Whether the median of an image that is traced may be that of a normalised one: most pixels tell."""
    return (jnp.mean(image > _BRIGHTEST) <= 0.5) & (jnp.mean(image < _DARKEST) <= 0.5)


def _check(image, name):
    if image.ndim < 3 or image.shape[-1] != 4:
        raise ValueError(f"{name} must be packed, [..., h, w, 4], got shape {image.shape}")


def repeated(image: Float[Array, "*n h w 4"]) -> Float[Array, "*n y x 4"]:
    """The image tiled up to the least size: copies keep the noise's own distribution, reflections do not."""
    for axis in (-3, -2):
        size = image.shape[axis]
        if size < SMALLEST:
            image = jnp.take(image, np.arange(SMALLEST) % size, axis)
    return image


@jax.jit
def _latent(params, noisy_ref):
    """The latent of all references, `[1, L]`."""
    return common_latent(params, latents_of(params, noisy_ref.reshape(-1, *noisy_ref.shape[-3:])))[None]


def latents_of(params: Model, noisy: Float[Array, "n h w 4"]) -> Float[Array, "n l"]:
    """The latent of each image; one zero where the model has no encoder."""
    if params.encoder_module is None:
        return jnp.zeros((noisy.shape[0], 1))
    return params.encoder_module.apply(params.encoder, noisy, train=False)  # type: ignore[return-value]


def common_latent(params: Model, latents: Float[Array, "*b n l"]) -> Float[Array, "*b l"]:
    """One latent for n images of a camera."""
    if params.encoder_module is None:
        return latents[..., 0, :]
    return mean_latent(params.encoder_module, latents)


def margin_of(model: Model) -> int:
    """Pixels that are drawn beyond an image on every side and cut off again. None for the paper's tables:
    their norms reach over the whole image, so that they give what they were trained to give on a patch as it
    is, and on four times its pixels something else."""
    return 0 if model.generator_module.literal else _MARGIN


def _pad(images, margin):
    """The image reflected all around, up to multiples of 32."""
    sides = [(margin, margin + -(size + 2 * margin) % _MULTIPLE) for size in images.shape[1:3]]
    return jnp.pad(images, ((0, 0), *sides, (0, 0)), mode="symmetric")
