"""Black level at one exposure, as the darks show it. No entry of the catalogue: it is no noise, but where the
darks of other exposures lie says what a camera's own black clamp did, which no law foretells.
"""

from __future__ import annotations

import jax.numpy as jnp

from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.core.settings import site_map
from cannoise_jax.vocabulary import Term

LEVELS = tuple(f"level{c}_dn" for c in range(4))


def _share(values, context: Context):
    """1 at the exposure, 0 at its neighbours, linear between; 1 beyond where it has no neighbour."""
    t, at = context.exposure_s, values["exposure_s"]
    below, above = values["below_s"], values["above_s"]
    up = jnp.where(below < at, (t - below) / jnp.maximum(at - below, 1e-12), 1.0)
    down = jnp.where(above > at, (above - t) / jnp.maximum(above - at, 1e-12), 1.0)
    return jnp.where(t < at, jnp.clip(up, 0.0, 1.0), jnp.clip(down, 0.0, 1.0))


def _levels(values, context: Context):
    levels = jnp.stack([jnp.broadcast_to(values[name], ()) for name in LEVELS])
    return _share(values, context) * site_map(levels, context.size)


PEDESTAL = Mechanism(
    id="pedestal",
    point=Point("readout", "signal", "channel", "frozen"),
    parameters=(
        *(
            Parameter(name, "DN", 0.0, -1e5, 1e5, f"level of mosaic site {c}")
            for c, name in enumerate(LEVELS)
        ),
        Parameter("exposure_s", "s", 1.0, 0.0, 1e6, "exposure at which it was measured"),
        Parameter("below_s", "s", 1.0, 0.0, 1e6, "next shorter one, or the same"),
        Parameter("above_s", "s", 1.0, 0.0, 1e6, "next longer one, or the same"),
    ),
    equation=r"y_{tij} \to y_{tij} + h(t_e)\, b_{c(i,j)}",
    sentence="The camera sets its black level anew at every exposure: darks lie where no dark current puts "
    "them.",
    reference="EMVA 1288 release 4.0, section 7.1 (black level compensation hides the dark current)",
    needs=("dark",),
    sample=lambda key, x, values, maps, context: x + _levels(values, context),
    effect=lambda values, maps, context: Effect(mean=_levels(values, context)),
    home="cannoise_jax.mechanisms.pedestal:ENTRIES",
)

ENTRIES = (
    Entry(
        Term("pedestal", "The black level at one exposure, as measured.", None, "unknown", "DN", "level"),
        PEDESTAL,
        "darks at two exposures or more",
    ),
)
