"""One training step, jitted as a whole: the critic's updates, then one update of generator and encoder.

The encoder sees the anchor j, the positive k and the negative l, never the target i (paper Sec. 3.4). The
initial noise is drawn inside, from keys that depend on the run's key and the step number alone.

Its level is the one that will be known when the model is used. Either it is handed over with the target; then
the camera may be shown at any setting, and the latent is that of k. Or it is estimated, by the function that
sampling uses, from the anchor, which is of the target's own setting; then the latent is the anchor's.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Key
from ml_collections import ConfigDict, FrozenConfigDict

from cannoise_jax.networks.branches import LEAST_READ, LEAST_SHOT, NoiseLevel, line_variance
from cannoise_jax.networks.encoder import mean_latent
from cannoise_jax.networks.layers import bent
from cannoise_jax.physics.core.poisson_gaussian import nlf_sigma
from cannoise_jax.physics.initial_noise import InitialNoise, initial_noise_by_camera
from cannoise_jax.physics.single_image import estimate_nlf
from cannoise_jax.training import losses
from cannoise_jax.training.compiler import compiler_options
from cannoise_jax.training.devices import everywhere
from cannoise_jax.training.state import (
    Networks,
    State,
    condition,
    latent_of,
    make_networks,
    make_optimisers,
)

Batch = dict[str, Any]
_LEAST = {"shot": LEAST_SHOT, "read": LEAST_READ}


def visible(noise: Float[Array, "..."], clean: Float[Array, "..."]) -> Float[Array, "..."]:
    """The noise that a recording clipped to [0, 1] shows."""
    return jnp.clip(clean + noise, 0, 1) - clean


def choose_level(level: str, key: Key[Array, ""], batch: Batch) -> NoiseLevel:
    """The level of each element as `config.level` says; for "both", by the toss of a coin."""
    count = batch["clean"].shape[0]
    shown = batch.get("shown", jnp.ones(count))
    if level == "given":
        return NoiseLevel(batch["shot"], batch["read"], jnp.ones(count), jnp.ones(count))
    shot, read = jax.vmap(estimate_nlf)(batch["anchor"])
    if level == "estimated":
        return NoiseLevel(shot, read, jnp.zeros(count), shown)
    known = jax.random.bernoulli(key, shape=(count,))
    shot, read = (
        jnp.where(known[:, None], given, found)
        for given, found in ((batch["shot"], shot), (batch["read"], read))
    )
    return NoiseLevel(shot, read, known.astype(jnp.float32), jnp.where(known, 1.0, shown))


def make_train_step(
    config: ConfigDict, cameras: int, draw: InitialNoise | None = None, mesh: Mesh | None = None
) -> Callable[[State, Batch], tuple[State, dict[str, Array]]]:
    """The jitted `train_step(state, batch) -> (state, metrics)`; the old state's memory is reused.

    cameras: how many there are, for a critic that is told which. draw: instead of config.initial_noise.
    mesh: of devices that share the batch, see `devices`.
    """
    return _train_step(FrozenConfigDict(config), cameras, draw or config.initial_noise, mesh)


@lru_cache(maxsize=4)
def _train_step(config: FrozenConfigDict, cameras: int, choice: str | InitialNoise, mesh: Mesh | None):
    """Cached, so that a run that is resumed in the same process compiles once."""
    networks = make_networks(config, config.get("compute", "float32"))
    optimisers = make_optimisers(config)
    exact = make_networks(config)  # the penalty is a slope of a slope, for which few bits are too few
    draw = initial_noise_by_camera(choice, config.exposure_s)
    weights = config.loss
    adversarial = bool(weights.adversarial or weights.feature_matching)
    # With a level that is handed over the camera may be shown at another setting: by the positive.
    wanted = 1 if config.level == "estimated" else 2
    if weights.triplet:
        wanted = 2 if weights.triplets == "batch" else 3

    def shown(noise, clean):
        return visible(noise, clean) if config.clip else noise

    def encoded(state: State, batch: Batch):
        """The latents, what turns their gradient into that of E's parameters, and new spectral vectors: one
        pass of E serves all updates of a step, for E changes with the last of them only."""
        return jax.vjp(
            lambda params: _latents(networks, params, state, batch, wanted),
            state.encoder["params"],
            has_aux=True,
        )

    def critic_update(state: State, batch: Batch, latents, key) -> tuple[State, dict[str, Array]]:
        draw_key, row_key, mix_key, level_key = jax.random.split(key, 4)
        clean = batch["clean"]
        level = choose_level(config.level, level_key, batch)
        n_init, sigma = draw(draw_key, clean, level.shot, level.read, batch["camera"])
        latent = _choose_latent(latents, level)
        fake = networks.generator.apply(
            state.generator, clean, n_init, latent, sigma, train=False, level=level,
            rngs={"noise": row_key},
        )  # fmt: skip
        told = condition(config, latent, batch["camera"], cameras)
        # The penalty asks for slope one per unit of noise: sigma, unless literal.
        unit = jnp.ones_like(sigma) if config.literal or config.paper else sigma
        real = shown(batch["noisy"] - clean, clean) / unit
        fake = shown(fake, clean) / unit
        between = losses.interpolate(real, fake, jax.random.uniform(mix_key, clean.shape[:1]))

        def loss(params):
            variables = {"params": params, "spectral": state.critic["spectral"]}
            (scores, _), changed = networks.critic.apply(
                variables, jnp.concatenate([real, fake]) * jnp.concatenate([unit, unit]), _twice(clean),
                _twice(sigma), train=True, latent=_twice(told), mutable=["spectral"],
            )  # fmt: skip
            real_scores, fake_scores = jnp.split(scores, 2)
            spectral = changed.get("spectral", {})

            def scores_at(noise):
                frozen = {"params": params, "spectral": spectral}
                return exact.critic.apply(frozen, noise * unit, clean, sigma, train=False, latent=told)[0]

            wasserstein = losses.critic_loss(real_scores, fake_scores)
            penalty = losses.gradient_penalty(scores_at, between, weights.slope)
            aux = {"critic/wasserstein": -wasserstein, "critic/penalty": penalty}
            return wasserstein + weights.penalty * penalty, (aux, spectral)

        (_, (aux, spectral)), gradient = jax.value_and_grad(loss, has_aux=True)(state.critic["params"])
        updates, optimiser = optimisers.critic.update(gradient, state.critic_optimiser)
        critic = {"params": optax.apply_updates(state.critic["params"], updates), "spectral": spectral}
        return state._replace(critic=critic, critic_optimiser=optimiser), aux

    def generator_update(state: State, batch: Batch, encoding, key) -> tuple[State, dict[str, Array]]:
        latents, pull, e_spectral = encoding
        draw_key, row_key, level_key = jax.random.split(key, 3)
        clean = batch["clean"]
        level = choose_level(config.level, level_key, batch)
        draws = 2 if weights.quantiles or weights.spectra else 1
        several = jax.tree.map(lambda x: jnp.concatenate([x] * draws), (clean, level, batch["camera"]))
        n_init, sigmas = draw(draw_key, several[0], several[1].shot, several[1].read, several[2])
        sigma = sigmas[: len(clean)]
        real = shown(batch["noisy"] - clean, clean)
        # The level that the data state, not the one estimated: where that is far too low, noise in its units
        # would outweigh all other images.
        unit = nlf_sigma(
            clean, *(jnp.maximum(batch[name], least)[:, None, None] for name, least in _LEAST.items())
        )

        def loss(params, latents):
            latent = _choose_latent(latents, level)
            generated, changed = networks.generator.apply(
                {"params": params, "spectral": state.generator["spectral"]},
                several[0], n_init, jnp.concatenate([latent] * draws), sigmas, train=True, level=several[1],
                mutable=["spectral", "physics"], rngs={"noise": row_key},
            )  # fmt: skip
            made = [shown(g, clean) for g in jnp.split(generated, draws)]
            terms = {}
            if adversarial:
                told = condition(config, latent, batch["camera"], cameras)
                seen: Any = networks.critic.apply(
                    state.critic, made[0], clean, sigma, train=False, latent=told
                )
                terms["adversarial"] = losses.generator_loss(seen[0])
                if weights.feature_matching:
                    target = {"clean": clean, "real": real}[weights.feature_target]
                    matched: Any = networks.critic.apply(
                        state.critic, target, clean, sigma, train=False, latent=told
                    )[1]
                    terms["feature_matching"] = losses.feature_matching_loss(seen[1], matched)
            if weights.triplet and networks.encoder:
                terms["triplet"] = _triplet(latents, batch["camera"], weights)
            if weights.statistics:
                terms["statistics"] = losses.statistics_loss(made[0] / sigma, real / sigma, clean)
            for name, statistic in (("quantiles", losses.quantiles), ("spectra", losses.log_spectra)):
                if weights[name]:
                    terms[name] = losses.paired_loss(
                        *(statistic(bent(n / unit, weights.knee)) for n in (*made, real))
                    )
            total = sum(weights[name] * value for name, value in terms.items())
            if weights.physics and "truth" in batch and "physics" in changed:
                physics = jax.tree.map(lambda x: x[: len(clean)], changed["physics"]["parameters"][0])
                more = losses.physics_loss(
                    line_variance(physics, level, clean), clean, physics, losses.Truth(**batch["truth"])
                )
                parts = {name: weights.parts[name] * value for name, value in more.items()}
                total = total + weights.physics * sum(parts.values())
                terms |= {f"physics_{name}": value for name, value in more.items()}
            aux = {f"generator/{name}": value for name, value in terms.items()}
            aux["generator/spread"] = jnp.std(made[0] / sigma)
            return total, (aux, changed.get("spectral", {}))

        trained = {"generator": state.generator["params"], "encoder": state.encoder["params"]}
        slopes = jax.value_and_grad(loss, (0, 1), has_aux=True)
        (_, (aux, g_spectral)), (slope, latent_slope) = slopes(trained["generator"], latents)
        gradient = {"generator": slope, "encoder": pull(latent_slope)[0]}
        updates, optimiser = optimisers.generator.update(gradient, state.generator_optimiser)
        trained = optax.apply_updates(trained, updates)
        count = state.step.astype(jnp.float32)
        # Until it is reached the average weighs step t as t^3, so that the start is soon forgotten.
        decay = jnp.minimum(config.ema, count / (4 + count))
        return state._replace(
            step=state.step + 1,
            position=state.position + 1,
            generator={"params": trained["generator"], "spectral": g_spectral},
            encoder={"params": trained["encoder"], "spectral": e_spectral},
            generator_optimiser=optimiser,
            average=jax.tree.map(lambda old, new: new + decay * (old - new), state.average, trained),
        ), aux

    placed = {"out_shardings": everywhere(mesh)} if mesh else {}

    @partial(jax.jit, donate_argnums=0, compiler_options=compiler_options(config), **placed)
    def train_step(state: State, batch: Batch) -> tuple[State, dict[str, Array]]:
        batch = _stacked(batch)
        keys = jax.random.split(jax.random.fold_in(state.key, state.step), config.critic_updates + 1)
        metrics: dict[str, Array] = {}
        encoding = encoded(state, batch)
        for key in keys[1:] if adversarial else ():
            state, metrics = critic_update(state, batch, encoding[0], key)
        state, more = generator_update(state, batch, encoding, keys[0])
        return state, metrics | more

    return train_step


def _stacked(batch: Batch) -> Batch:
    """The batch with one or several anchors of each element, `[b, k, h, w, 4]`."""
    anchor = jnp.asarray(batch["anchor"])
    return {**batch, "anchor": anchor if anchor.ndim == 5 else anchor[:, None]}


def _choose_latent(latents, level: NoiseLevel):
    """That of any image of the camera where the level is known, else that of the images of the setting."""
    if len(latents) == 1:
        return latents[0]
    return jnp.where(level.known[:, None] > 0, latents[1], latents[0])


def _twice(x):
    return None if x is None else jnp.concatenate([x, x])


def _triplet(latents, camera, weights):
    if weights.triplets == "batch":
        return losses.batch_triplet_loss(
            jnp.concatenate(latents), jnp.concatenate([camera, camera]), weights.margin
        )
    return losses.triplet_loss(latents[0], latents[1], latents[2], weights.margin)


def _latents(networks: Networks, params, state: State, batch: Batch, wanted: int):
    """The latents of the anchors, mean over them, of the positive and of the negative, the first `wanted` of
    them in one pass of E, and the new spectral vectors; those that the batch has."""
    count, several = batch["anchor"].shape[:2]
    if networks.encoder is None:
        return (latent_of(networks, {}, batch["anchor"][:, 0]),), {}
    names = [name for name in ("positive", "negative")[: wanted - 1] if name in batch]
    images = [batch["anchor"].reshape(-1, *batch["anchor"].shape[2:]), *(batch[name] for name in names)]
    latent, changed = networks.encoder.apply(
        {"params": params, "spectral": state.encoder["spectral"]},
        jnp.concatenate(images), train=True, mutable=["spectral"],
    )  # fmt: skip
    anchors, *rest = jnp.split(latent, [several * count + i * count for i in range(len(names))])
    anchors = mean_latent(networks.encoder, anchors.reshape(count, several, -1))
    return (anchors, *rest), changed.get("spectral", {})
