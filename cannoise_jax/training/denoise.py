"""Training of denoisers, the same for every noise model: weights, scenes, crops and photons are paired.

Two denoisers of one seed differ in the noise model alone; without pairing, seeds spread by as much as noise
models do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax.errors import FlaxError
from flax.traverse_util import flatten_dict, unflatten_dict
from jaxtyping import Array, Float, Key

from cannoise_jax.networks.denoiser import DnCNN
from cannoise_jax.recordings.described import read_described, write_described
from cannoise_jax.recordings.opened import BROKEN_ARRAYS
from cannoise_jax.recordings.packing import pack
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.noise_sources import Source

_FORMAT = "cannoise/denoiser/1"


@dataclass(frozen=True)
class Recipe:
    """How a denoiser is trained. patch: packed pixels; realisations: noisy images of every scene.

    The paper states neither steps nor rate; Noise Flow's code trains for far longer, at 1e-3.
    """

    steps: int = 600
    batch_size: int = 8
    patch: int = 32
    features: int = 32
    depth: int = 9
    rate: float = 1e-3
    scenes: int = 32
    realisations: int = 3

    @property
    def module(self) -> DnCNN:
        """The network."""
        return DnCNN(self.depth, self.features)


class Denoiser(NamedTuple):
    """A trained network and what it was trained on, for messages and results."""

    recipe: Recipe
    variables: dict[str, Any]
    about: dict[str, Any]


def noisy_pool(
    source: Source, clean: Float[np.ndarray, "n h w"], realisations: int, key: Key[Array, ""]
) -> Float[np.ndarray, "m h w"]:
    """Noisy mosaics of every scene, `realisations` each: scene i is at i, i + n, ..."""
    return np.stack(
        [
            source(jax.random.fold_in(jax.random.fold_in(key, r), i), scene)
            for r in range(realisations)
            for i, scene in enumerate(clean)
        ]
    )


def crops(
    rng: np.random.Generator, clean: np.ndarray, noisy: np.ndarray, recipe: Recipe, cfa: str
) -> tuple[Float[np.ndarray, "b p p 4"], Float[np.ndarray, "b p p 4"]]:
    """A batch of packed patches at random even places of random images: clean and noisy."""
    side, (height, width) = 2 * recipe.patch, noisy.shape[1:]
    pairs = []
    for _ in range(recipe.batch_size):
        i = int(rng.integers(len(noisy)))
        y, x = (2 * int(rng.integers((size - side) // 2 + 1)) for size in (height, width))
        part = np.s_[y : y + side, x : x + side]
        pairs.append((clean[i % len(clean)][part], noisy[i][part]))
    a, b = (np.stack(images).astype(np.float32) for images in zip(*pairs, strict=True))
    return pack(a, cfa), pack(b, cfa)


@lru_cache(maxsize=4)
def _programs(recipe: Recipe):
    module = recipe.module
    optimiser = optax.adam(optax.cosine_decay_schedule(recipe.rate, recipe.steps))

    def loss(params, stats, clean, noisy):
        out, moved = module.apply(
            {"params": params, "batch_stats": stats}, noisy, train=True, mutable=["batch_stats"]
        )
        return jnp.mean(jnp.square(out - clean)), moved["batch_stats"]

    @partial(jax.jit, donate_argnums=(0, 1, 2))
    def step(params, stats, state, clean, noisy):
        (value, stats), grads = jax.value_and_grad(loss, has_aux=True)(params, stats, clean, noisy)
        updates, state = optimiser.update(grads, state, params)
        return optax.apply_updates(params, updates), stats, state, value

    return optimiser, step


def check_size(size: tuple[int, ...], recipe: Recipe) -> None:
    """Raises BadInput for images smaller than a patch."""
    if min(size) < 2 * recipe.patch:
        raise BadInput(
            f"training images of {size[0]} x {size[1]} pixels: patches need {2 * recipe.patch} on a side"
        )


def train_denoiser(
    recipe: Recipe,
    source: Source,
    clean: Float[np.ndarray, "n h w"],
    cfa: str,
    seed: int,
    about: dict[str, Any] | None = None,
    tell: Callable[[int, float], None] = lambda step, loss: None,
) -> Denoiser:
    """Trains on noisy images of the clean mosaics. The same seed pairs weights, crops and noise keys.

    Raises BadInput for images smaller than a patch, FloatingPointError for a loss that is not finite.
    """
    check_size(clean.shape[1:], recipe)
    key = jax.random.key(seed)
    noisy = noisy_pool(source, clean, recipe.realisations, jax.random.fold_in(key, 1))
    optimiser, step = _programs(recipe)
    variables: Any = recipe.module.init(key, jnp.zeros((1, 8, 8, 4)), train=False)
    params, stats = variables["params"], variables["batch_stats"]
    state = optimiser.init(params)
    rng = np.random.default_rng(seed)
    for i in range(recipe.steps):
        params, stats, state, value = step(params, stats, state, *crops(rng, clean, noisy, recipe, cfa))
        if i % 20 == 19 or i == recipe.steps - 1:
            if not np.isfinite(float(value)):
                raise FloatingPointError(f"step {i + 1}: the loss is not finite: lower the rate")
            tell(i + 1, float(value))
    return Denoiser(recipe, {"params": params, "batch_stats": stats}, about or {})


def save_denoiser(path: Path, denoiser: Denoiser) -> None:
    """One file of plain arrays with a description in JSON, complete or not at all. Raises BadInput."""
    description = {"format": _FORMAT, "recipe": asdict(denoiser.recipe), "about": denoiser.about}
    arrays = {name: np.asarray(leaf) for name, leaf in flatten_dict(denoiser.variables, sep="/").items()}
    write_described(path, description, arrays)


def load_denoiser(path: Path) -> Denoiser:
    """What `save_denoiser` wrote. Raises BadInput; nothing is unpickled."""
    if not path.is_file():
        raise BadInput(f"{path}: no such file: train a denoiser first")
    try:
        found = read_described(path)
        description = found.description
        if description["format"] != _FORMAT:
            raise ValueError(description["format"])
        variables = unflatten_dict({k: jnp.asarray(v) for k, v in found.arrays.items()}, sep="/")
        denoiser = Denoiser(Recipe(**description["recipe"]), variables, description["about"])
        image = jax.ShapeDtypeStruct((1, 8, 8, 4), jnp.float32)
        jax.eval_shape(applied(denoiser.recipe), denoiser.variables, image)
        return denoiser
    except (*BROKEN_ARRAYS, KeyError, TypeError, AttributeError, RecursionError, FlaxError) as error:
        raise BadInput(f"{path}: not a readable denoiser: train it again") from error


def denoised(denoiser: Denoiser, noisy: Float[np.ndarray, "n h w 4"]) -> list[Float[np.ndarray, "h w 4"]]:
    """Packed images, one after the other."""
    network = applied(denoiser.recipe)
    return [np.asarray(network(denoiser.variables, image[None]))[0] for image in noisy]


@lru_cache(maxsize=4)
def applied(recipe: Recipe) -> Callable[[dict[str, Any], Float[Array, "b h w 4"]], Float[Array, "b h w 4"]]:
    """The network in use, compiled once for all denoisers of a recipe: (variables, noisy) -> denoised."""
    return jax.jit(lambda variables, noisy: recipe.module.apply(variables, noisy, train=False))
