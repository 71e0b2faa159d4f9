"""How charge that is not light grows, and what it adds in closed form."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.physics.core.mechanism import DOUBLING_C, Context, Effect, Parameter, Scaling
from cannoise_jax.physics.core.poisson_gaussian import sample_normal

THERMAL = Scaling(exposure=1.0, doubling_c=DOUBLING_C)
"""Charge that gathers all the time, faster where it is warm."""
WIDENHORN = "Widenhorn et al., Temperature dependence of dark current in a CCD, Proc. SPIE 4669 (2002)"


def added_charge(charge, context: Context) -> Effect:
    """Closed form of Poisson charge of mean `charge` [1, H, W] or a number, e-."""
    gain = context.gain_dn_per_e
    charge = jnp.broadcast_to(charge, (1, *context.size))
    return Effect(
        mean=(gain * charge)[0],
        variance=(gain**2 * charge)[0],
        third=(gain**3 * charge)[0],
        fourth=(gain**4 * charge)[0],
    )


VARIATION = Parameter(
    "variation", "1", 0.0, 0.0, 10.0, "standard deviation of the pixels' dark currents over their mean", 0.0
)


def log_normal_pixels(key, values, context: Context):
    """What pixels have beyond the mean, in units of their standard deviation: log-normal, as the currents of
    one kind of defect that every pixel has many of."""
    size = (1, *context.size)

    def drawn():
        variation = jnp.maximum(values["variation"], 1e-6)
        shape = jnp.sqrt(jnp.log1p(variation**2))
        return jnp.expm1(shape * sample_normal(key, size) - shape**2 / 2) / variation

    # Most models have none, and a map costs a third of a frame.
    none = jnp.zeros(size)
    return {"pixels": jax.lax.cond(jnp.any(values["variation"] > 0), drawn, lambda: none)}


def of_pixels(values, maps):
    """Mean charge of every pixel, none below zero."""
    return values["e_per_s"] * jnp.maximum(1 + values["variation"] * maps["pixels"], 0.0)


def rate_of(definition: str, default: float) -> Parameter:
    """The strength of a dark current, in electrons per second."""
    return Parameter("e_per_s", "e-/s", default, 0.0, 1e7, definition)


def per_second(values, context: Context):
    """The strength per second: it comes scaled to the exposure."""
    return values["e_per_s"] / jnp.maximum(context.exposure_s, 1e-12)
