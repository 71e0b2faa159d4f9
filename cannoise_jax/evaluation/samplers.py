"""A trained model as evaluation takes it: a function of a key, clean patches, references and levels."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.evaluation.baselines import estimated_levels
from cannoise_jax.networks.branches import NoiseLevel
from cannoise_jax.sampling import repeated

_ENCODED = 16
"""Images that are encoded at once."""


class Samplers(NamedTuple):
    """A model as `evaluation` takes it, `(key, clean, reference, shot, read) -> noise`, in two ways of use.

    usual: the level as most users have it: off the references, unless the model was trained without.
    given: the level that is handed over; None where the model was trained without.
    """

    usual: Any
    given: Any


class ByCamera(NamedTuple):
    """A sampler that is also told the camera's index of every patch: `sample(..., camera)`."""

    sample: Callable[..., Any]


def samplers(level: str, sample: Callable[..., Any], by_camera: bool = False) -> Samplers:
    """Both from `sample(key, clean, reference, nlf) -> noise` of a model of this `Model.level`; by_camera:
    from `sample(key, clean, reference, nlf, camera)`, for `ByCamera`."""

    def given(key, clean, reference, shot, read, *camera):
        return sample(key, clean, reference, (shot, read), *camera)

    def estimated(key, clean, reference, shot, read, *camera):
        return sample(key, clean, reference, None, *camera)

    made = [ByCamera(f) if by_camera else f for f in (given, estimated)]
    return Samplers(made[level != "given"], None if level == "estimated" else made[0])


def by_latents(
    encode: Callable[[Any], Any], draw: Callable[..., Any]
) -> Callable[..., Float[Array, "b h w 4"]]:
    """`sample(key, clean, reference, nlf, *camera)` of a model in parts: `encode(images) -> latents [n, l]`
    and `draw(key, clean, latents [b, k, l], level, *camera)`.

    What costs most is reading the references, and a patch is a reference of many others, in every column of
    a comparison: each image is encoded once. The parts do not depend on one another's shapes, so that `draw`
    is compiled once, wherever the level comes from and however many references there are.
    """
    encoded = _once_each(encode)

    def sample(key, clean, reference, nlf, *camera):
        reference = np.asarray(repeated(reference))
        count, shown = reference.shape[:2]
        latents = encoded(reference.reshape(-1, *reference.shape[2:])).reshape(count, shown, -1)
        shot, read = nlf or estimated_levels(reference)
        known, shown = (jnp.full(count, float(v)) for v in (nlf is not None, shown))
        return draw(key, clean, latents, NoiseLevel(shot, read, known, shown), *camera)

    return sample


def _once_each(encode: Callable[[Any], Any]) -> Callable[[np.ndarray], np.ndarray]:
    """The same function of images `[n, h, w, 4]`, called with those that it has not seen yet."""
    known: dict[bytes, np.ndarray] = {}

    def of_images(images: np.ndarray) -> np.ndarray:
        names = [hashlib.sha256(image.tobytes()).digest() for image in images]
        new = {name: i for i, name in enumerate(names) if name not in known}
        for start in range(0, len(new), _ENCODED):
            some = list(new)[start : start + _ENCODED]
            # The last batch is filled up: one size is compiled once.
            places = [new[name] for name in some] + [new[some[-1]]] * (_ENCODED - len(some))
            known.update(zip(some, np.asarray(encode(images[places])), strict=False))
        return np.stack([known[name] for name in names])

    return of_images
