"""Everything that training changes, as one pytree; and how it is made.

The state holds the position in the data as well, so that a state, a config and the data determine every later
state bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key
from ml_collections import ConfigDict, FrozenConfigDict

from cannoise_jax.networks import Discriminator, Encoder, Generator
from cannoise_jax.networks.encoder import standardised
from cannoise_jax.physics.initial_noise import INITIAL_NOISE
from cannoise_jax.training.compiler import compiler_options

Variables = Mapping[str, Any]
COMPUTE = ("float32", "bfloat16")


class Networks(NamedTuple):
    """The three modules. `encoder` is None for a generator without camera awareness."""

    generator: Generator
    encoder: Encoder | None
    critic: Discriminator


class Optimisers(NamedTuple):
    """One for G and E together, one for D."""

    generator: optax.GradientTransformation
    critic: optax.GradientTransformation


class State(NamedTuple):
    """The combined training state.

    step: generator updates done. position: batches drawn from the data. key: of the whole run, never used up
    (step n uses fold_in(key, n)). generator, encoder, critic: `params` and `spectral` collections.
    average: exponential moving average of the parameters of G and E, which is what is sampled from.
    """

    step: Int[Array, ""]
    position: Int[Array, ""]
    key: Key[Array, ""]
    generator: Variables
    encoder: Variables
    critic: Variables
    generator_optimiser: optax.OptState
    critic_optimiser: optax.OptState
    average: Variables


def make_networks(config: ConfigDict | FrozenConfigDict, compute: str = "float32") -> Networks:
    """The modules that the config describes. Noise that is drawn from a sensor model has its mechanisms
    already, and is no normal number that the branches could shape: they are left out.

    compute: in what the convolutions are worked out; a model is always sampled in float32.
    """
    shared: dict[str, Any] = {
        "width": config.width,
        "literal": config.literal or config.paper,
        "dtype": None if compute == "float32" else compute,
    }
    norm: dict[str, Any] = {"output_norm": not config.paper}
    generator = config.networks.generator.to_dict()
    if config.initial_noise not in tuple(INITIAL_NOISE):
        generator["physics"] = False
    return Networks(
        Generator(**shared, **norm, **generator),
        Encoder(**shared, **config.networks.encoder) if config.encoder else None,
        Discriminator(**shared, **norm, **config.networks.critic),
    )


def make_optimisers(config: ConfigDict | FrozenConfigDict) -> Optimisers:
    """Adam for G and E, and for D.

    The cosine schedule ends at zero; that of G rises from zero for `warmup` steps first, so that an untrained
    critic does not drive it.
    """
    options = config.optimiser

    def adam(rate: float, warmup: int, updates: int) -> optax.GradientTransformation:
        schedule: Any = rate
        if options.schedule == "cosine":
            warmup = min(warmup, updates - 1)
            schedule = optax.warmup_cosine_decay_schedule(0.0 if warmup else rate, rate, warmup, updates)
        elif options.schedule != "constant":
            raise ValueError(f"optimiser.schedule must be constant or cosine, got {options.schedule!r}")
        return optax.adam(schedule, b1=options.beta1, b2=options.beta2)

    generator = {
        "generator": adam(options.generator_rate, options.warmup, config.steps),
        "encoder": adam(options.encoder_rate, 0, config.steps),
    }
    return Optimisers(
        optax.partition(generator, {name: name for name in generator}),
        adam(options.critic_rate, 0, config.steps * config.critic_updates),
    )


def init_state(config: ConfigDict, cameras: int, noisy: Float[Array, "n h w 4"] | None = None) -> State:
    """The state before the first step. Pure: the same arguments give the same state.

    noisy: training images of all cameras, on whose statistics E's are standardised.
    """
    first, standard = _first_programs(FrozenConfigDict(config), cameras)
    state = first(jax.random.key(config.seed))
    if noisy is None or "params" not in state.encoder:
        return state
    params = standard(state.encoder["params"], noisy)
    average = {**state.average, "encoder": jax.tree.map(jnp.copy, params)}
    return state._replace(encoder={**state.encoder, "params": params}, average=average)


def abstract_state(config: ConfigDict, cameras: int) -> State:
    """The shapes and dtypes of `init_state`, without computing it."""
    first, _ = _first_programs(FrozenConfigDict(config), cameras)
    return jax.eval_shape(first, jax.random.key(config.seed))


@lru_cache(maxsize=4)
def _first_programs(config: FrozenConfigDict, cameras: int):
    """From a key to the first state, and `standardised`. Cached: runs of one process trace them once."""
    # Dozens of small random draws take XLA half a minute to optimise and nothing to run.
    quick = {"xla_backend_optimization_level": 0, **(compiler_options(config) or {})}
    first = jax.jit(partial(_first_state, config, cameras), compiler_options=quick)
    return first, jax.jit(standardised, compiler_options=quick)


def _first_state(config: FrozenConfigDict, cameras: int, key: Key[Array, ""]) -> State:
    networks, optimisers = make_networks(config), make_optimisers(config)
    keys = jax.random.split(key, 4)
    image = jnp.ones((1, config.patch, config.patch, 4))
    encoder: Any = networks.encoder.init(keys[1], image, train=False) if networks.encoder else {}
    latent = latent_of(networks, encoder, image)
    generator: Any = networks.generator.init(
        {"params": keys[2], "noise": keys[2]}, image, image, latent, image, train=False
    )
    told = condition(config, latent, jnp.zeros(1, int), cameras)
    critic: Any = networks.critic.init(keys[3], image, image, image, train=False, latent=told)
    generator, encoder, critic = complete(generator), complete(encoder), complete(critic)
    trained = {"generator": generator["params"], "encoder": encoder["params"]}
    return State(
        step=jnp.zeros((), jnp.int32),
        position=jnp.zeros((), jnp.int32),
        key=keys[0],
        generator=generator,
        encoder=encoder,
        critic=critic,
        generator_optimiser=optimisers.generator.init(trained),
        critic_optimiser=optimisers.critic.init(critic["params"]),
        average=jax.tree.map(jnp.copy, trained),
    )


def complete(variables: Variables) -> Variables:
    """Both collections, empty where the module has none."""
    return {"params": variables.get("params", {}), "spectral": variables.get("spectral", {})}


def latent_of(networks: Networks, encoder: Variables, noisy: Any, train: bool = False) -> Any:
    """The camera latent `[B, L]`, or one zero per image where there is no encoder."""
    if networks.encoder is None:
        return jnp.zeros((noisy.shape[0], 1))
    return networks.encoder.apply(encoder, noisy, train=train)


def condition(config: ConfigDict | FrozenConfigDict, latent: Any, camera: Any, cameras: int) -> Any:
    """What the critic is told about the camera: nothing (the paper), its name, or the encoder's latent."""
    if config.critic_condition == "none":
        return None
    if config.critic_condition == "camera":
        return config.camera_scale * jax.nn.one_hot(camera, cameras)
    if config.critic_condition == "latent":
        return jax.lax.stop_gradient(latent)
    raise ValueError(f"critic_condition must be none, camera or latent, got {config.critic_condition!r}")
