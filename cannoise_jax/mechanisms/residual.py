"""What no name explains, as it was measured: fixed maps of one camera unit, and correlated noise by its power
spectrum with random phases. No entry of the catalogue: it is of no physics, and other units do not share it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Mechanism, Parameter
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.vocabulary import Term

MAPS = ("offset", "rate", "response", "spread", "spectrum")
"""offset: DN; rate: DN/s, which brings shot noise of its own; response: share of the signal; spread: DN rms
of noise that single pixels have beyond the others; spectrum: power of the noise that pixels share, DN^2 by
spatial frequency, its mean the variance that it adds."""


def _nothing(key, values, context: Context):
    # Another unit, or another size of frame, has a residual of its own, which nobody measured.
    return {name: jnp.zeros((1, *context.size)) for name in MAPS}


def _sample(key, x, values, maps, context: Context):
    pixel, shared = jax.random.split(key)
    weight = values["weight"]
    charge = maps["rate"] * context.exposure_s
    fixed = maps["offset"] + charge + maps["response"] * context.mean_dn
    variance = maps["spread"] ** 2 + context.gain_dn_per_e * jnp.maximum(charge, 0.0)
    alone = sample_normal(pixel, x.shape) * jnp.sqrt(variance)
    waves = jnp.fft.fft2(sample_normal(shared, x.shape)) * jnp.sqrt(maps["spectrum"])
    return x + weight * (fixed + alone + jnp.fft.ifft2(waves).real)


RESIDUAL = Mechanism(
    id="residual",
    point=Point("readout", "signal", "pixel", "redrawn"),
    parameters=(Parameter("weight", "1", 1.0, 0.0, 1.0, "identity", "share of what was measured"),),
    equation=r"y \to y + w\,(o + d\,t + p\,s + n_{ij} + \mathcal{F}^{-1}[\sqrt{S}\,\mathcal{F} g])",
    sentence="What is left when every name has been tried: maps and a spectrum as measured, without a cause.",
    reference="random-phase synthesis from dark frames: arXiv 2512.03245; sampling of real darks: Zhang et "
    "al., ICCV 2021",
    needs=("dark",),
    sample=_sample,
    draw_maps=_nothing,
    home="cannoise_jax.mechanisms.residual:ENTRIES",
)

ENTRIES = (
    Entry(
        Term(
            "residual",
            "What no named mechanism explains, as it was measured.",
            None,
            "unknown",
            "1",
            "weight",
        ),
        RESIDUAL,
        "darks, at two exposures or more; flats for the response",
    ),
)
