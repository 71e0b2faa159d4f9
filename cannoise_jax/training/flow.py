"""Noise Flow trained by likelihood on pairs of patches: one camera and ISO to a batch, as the reference."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Key

from cannoise_jax.networks.noise_flow import NoiseFlow, log_likelihood, with_levels
from cannoise_jax.recordings.recording import BadInput


class Pairs(Protocol):
    """Recorded pairs, packed `[n, h, w, 4]`; shot, read `[n, 4]`; camera, iso `[n]`."""

    clean: Any
    noisy: Any
    shot: Any
    read: Any
    camera: Any
    iso: Any


@dataclass(frozen=True)
class FlowRecipe:
    """How a flow is trained; in brackets the reference: rate 1e-3 (1e-4, up to 2000 epochs), batch 32 (138).

    depth: couplings before the gain, and after it.
    """

    steps: int = 1500
    batch_size: int = 32
    patch: int = 32
    rate: float = 1e-3
    depth: int = 4


class Flow(NamedTuple):
    """A trained flow. nats: its mean log density per value on the last training batches."""

    module: NoiseFlow
    variables: dict[str, Any]
    nats: float


def train_flow(
    pairs: Pairs,
    cameras: int,
    seed: int,
    recipe: FlowRecipe | None = None,
    tell: Callable[[int, float], None] = lambda step, nats: None,
) -> Flow:
    """Adam on the mean log density per value, weights at the end.

    Starts from the published noise levels of the pairs, as the reference's released weights did.
    Raises BadInput for patches smaller than the recipe's, FloatingPointError for a density not finite.
    """
    recipe = recipe or FlowRecipe()
    clean, noisy = (np.asarray(v, np.float32) for v in (pairs.clean, pairs.noisy))
    if min(clean.shape[1:3]) < recipe.patch:
        raise BadInput(
            f"patches of {clean.shape[1:3]}: Noise Flow is trained on {recipe.patch} packed pixels"
        )
    camera, iso = np.asarray(pairs.camera), np.asarray(pairs.iso)
    isos = tuple(float(v) for v in np.unique(iso))
    module = NoiseFlow(isos, cameras, recipe.depth)
    place = np.searchsorted(isos, iso)
    groups = [np.flatnonzero((camera == c) & (place == i)) for c in range(cameras) for i in range(len(isos))]
    groups = [g for g in groups if g.size]
    rng = np.random.default_rng(seed)
    one = jnp.zeros(1, jnp.int32)
    image = jnp.zeros((1, 8, 8, 4))
    variables = module.init(jax.random.key(seed), image, image, one, one)
    shot = np.array([np.mean(np.asarray(pairs.shot)[place == i]) for i in range(len(isos))])
    variables = with_levels(dict(variables), isos, shot, float(np.median(np.asarray(pairs.read))))
    params, stats, fixed = (variables[name] for name in ("params", "batch_stats", "fixed"))
    optimiser = optax.adam(optax.cosine_decay_schedule(recipe.rate, recipe.steps))
    state = optimiser.init(params)

    @partial(jax.jit, donate_argnums=(0, 1, 2))
    def step(params, stats, state, noise, clean, camera, iso):
        def loss(params):
            (latent, log_det), moved = module.apply(
                {"params": params, "batch_stats": stats, "fixed": fixed}, noise, clean, camera, iso,
                train=True, mutable=["batch_stats"],
            )  # fmt: skip
            return -jnp.mean(log_likelihood(latent, log_det)), moved["batch_stats"]

        (value, new_stats), grads = jax.value_and_grad(loss, has_aux=True)(params)
        updates, new_state = optimiser.update(grads, state, params)
        return optax.apply_updates(params, updates), new_stats, new_state, value

    recent: list[float] = []
    for number in range(recipe.steps):
        group = groups[int(rng.integers(len(groups)))]
        index = rng.choice(group, recipe.batch_size)
        y, x = (int(rng.integers(size - recipe.patch + 1)) for size in clean.shape[1:3])
        part = np.s_[index, y : y + recipe.patch, x : x + recipe.patch]
        about = (jnp.asarray(camera[index], jnp.int32), jnp.asarray(place[index], jnp.int32))
        params, stats, state, value = step(
            params, stats, state, noisy[part] - clean[part], clean[part], *about
        )
        recent = [*recent[-99:], -float(value)]
        if not np.isfinite(recent[-1]):
            raise FloatingPointError(
                f"Noise Flow, step {number + 1}: the density is not finite: lower the rate"
            )
        if number % 50 == 49:
            tell(number + 1, float(np.mean(recent)))
    made = {"params": params, "batch_stats": stats, "fixed": fixed}
    return Flow(module, made, float(np.mean(recent)))


def held_out_nats(flow: Flow, pairs: Pairs, batch: int = 64) -> float:
    """Mean log density per value of pairs, by the running statistics; ISOs as `flow_noise` takes them."""
    clean, noisy = (np.asarray(v, np.float32) for v in (pairs.clean, pairs.noisy))
    camera, place = np.asarray(pairs.camera), _nearest(flow, np.asarray(pairs.iso))
    total = 0.0
    for start in range(0, len(clean), batch):
        part = np.s_[start : start + batch]
        latent, log_det = _forward(
            flow.module, flow.variables, noisy[part] - clean[part], clean[part],
            jnp.asarray(camera[part], jnp.int32), place[part],
        )  # fmt: skip
        total += float(jnp.sum(log_likelihood(latent, log_det)))
    return total / len(clean)


def flow_noise(
    flow: Flow, key: Key[Array, ""], clean: Float[np.ndarray, "b h w 4"], camera: np.ndarray, iso: np.ndarray
) -> Float[Array, "b h w 4"]:
    """Noise of these cameras (indices) and ISOs, those nearest to known ones; at temperature 1."""
    return _inverse(
        flow.module, flow.variables, key, jnp.asarray(clean), jnp.asarray(camera, jnp.int32),
        _nearest(flow, iso),
    )  # fmt: skip


def _nearest(flow: Flow, iso: np.ndarray) -> Array:
    """The index of the known ISO nearest to each."""
    known = np.log(np.asarray(flow.module.isos))
    return jnp.asarray(np.abs(np.log(np.asarray(iso, float))[:, None] - known).argmin(1), jnp.int32)


@partial(jax.jit, static_argnames="module")
def _inverse(module, variables, key, clean, camera, iso):
    latent = jax.random.normal(key, clean.shape)
    return module.apply(variables, latent, clean, camera, iso, method="inverse")


@partial(jax.jit, static_argnames="module")
def _forward(module, variables, noise, clean, camera, iso):
    return module.apply(variables, noise, clean, camera, iso)
