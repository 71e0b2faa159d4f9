"""Mains flicker: a lamp that pulses while rows are read, each colour of its light in its way."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.grammar_effects import effect_of
from cannoise_jax.physics.core.mechanism import Context, Parameter

POINT = Point("photons", "mean", "row", "redrawn", "multiply", spectrum="sinusoid")
_SHARES, _LATES = (tuple(f"{name}_{c // 2}{c % 2}" for c in range(4)) for name in ("share", "late"))
"""Parameters of the mosaic's sites, by row and column in a cell."""


def of_sites(share: Float[np.ndarray, "4"], late: Float[np.ndarray, "4"]) -> dict[str, float]:
    """The parameters of light of which every site has this share, this late (radians)."""
    measured = zip((*_SHARES, *_LATES), (*share, *late), strict=True)
    return {name: float(value) for name, value in measured}


def _per_pixel(values, names: tuple[str, ...], size: tuple[int, int]):
    """The values of the four sites at the pixels `[H, W]`."""
    cell = jnp.stack([jnp.asarray(values[name], jnp.float32) for name in names])
    rows, columns = (-(-n // 2) for n in size)
    return jnp.tile(cell.reshape(2, 2), (rows, columns))[: size[0], : size[1]]


def _sample(key, x, values, maps, context: Context):
    cosine, sine = (
        fields.sinusoid(key, x.shape[0], (context.size[0], 1), values["frequency"], redrawn=True, late=late)
        for late in (0.0, jnp.pi / 2)
    )
    share = values["amplitude"] * _per_pixel(values, _SHARES, context.size)
    late = _per_pixel(values, _LATES, context.size)
    return x + x * (share * jnp.cos(late)) * cosine + x * (share * jnp.sin(late)) * sine


def _effect(values, maps, context: Context):
    """As of one phase: neighbours of two colours share less as theirs part, by less than the square of it."""
    share = _per_pixel(values, _SHARES, context.size)
    return effect_of(POINT, "amplitude")({**values, "amplitude": values["amplitude"] * share}, maps, context)


FLICKER = dataclasses.replace(
    mechanism_from_grammar(
        POINT,
        id="flicker",
        parameters=(
            Parameter("amplitude", "1", 0.02, 0.0, 1.0, "peak, as a fraction of the signal"),
            Parameter("frequency", "cycles/row", 0.02, 0.0, 0.5, "twice the mains over the row rate"),
            *(
                Parameter(name, "1", 1.0, 0.0, 4.0, f"of the amplitude at the mosaic's site {name[-2:]}", 1.0)
                for name in _SHARES
            ),
            *(
                Parameter(name, "rad", 0.0, -3.2, 3.2, f"phase by which site {name[-2:]} is late", 0.0)
                for name in _LATES
            ),
        ),
        equation=r"\mu_{tij} \to \mu_{ij}\,(1+m\,a_c\cos(2\pi f i+\phi_t-\beta_c))",
        sentence="Lamps on mains light blink, and a rolling shutter turns the blinking into bands that move "
        "from frame to frame. A lamp's phosphors glow on for a while, each in its colour: the bands of one "
        "colour are weaker and later than those of another.",
        reference="Sheinin et al., Computational Imaging on the Electric Grid, CVPR 2017",
        needs=("pair", "burst"),
        confused_with=("row_noise", "row_pink_noise", "banding", "illumination_drift"),
        of_light=True,
    ),
    sample=_sample,
    effect=_effect,
)
