"""What no name explains, as it was measured: fixed maps of one camera unit, and correlated noise by its power
spectrum with random phases. No entry of the catalogue: it is of no physics, and other units do not share it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Mechanism, Noise, Parameter
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.vocabulary import Term

KNOTS = 6
"""Signals at which lit frames are described, at most; between them and the dark it is interpolated."""
DARK = ("offset", "rate", "spread", "growth", "spectrum", "keep")
"""offset: DN; rate: DN/s.
spread: DN^2 of noise that single pixels have beyond the others.
growth: DN^2/s that every pixel gains by the exposure, shot noise of its charge included.
spectrum: power of the noise that pixels share, DN^2 by spatial frequency, its mean the variance that it adds.
keep: share of the variance of the baseline's read noise that stays beside it; the rest of it is taken from
every pixel alike."""
LIT = ("level", "fixed", "alone", "power", "unit", "left")
"""At one signal:
level: the signal of every pixel, DN; fixed: what stays, DN.
alone: DN^2 of noise of single pixels beyond the others.
power: of the noise that pixels share.
unit: the variance of every pixel over the mean, by which both are multiplied.
left: share of the variance of the baseline that stays beside it."""
MAPS = (*DARK, *(f"{name}{k}" for k in range(KNOTS) for name in LIT), "pixels")
"""Maps that are one pixel large say nothing (shares: they are one number). pixels: of the frame that the
spectra are of: those of a part of it are others."""

_LEAST = 0.02
"""Share of the variance of a pixel's read noise that always stays: quiet ones have less than is taken."""


def _nothing(key, values, context: Context):
    # Another unit, or another size of frame, has a residual of its own, which nobody measured.
    return {name: jnp.full((1, 1, 1), float(name.startswith(("keep", "left")))) for name in MAPS}


def _sample(key, x, values, maps, context: Context):
    size = context.size
    whole = jnp.all(jnp.abs(maps["pixels"] - size[0] * size[1]) < 0.5)
    lit = [k for k in range(KNOTS) if maps[f"level{k}"].size > 1]
    dark = maps["offset"].size > 1
    keys = jax.random.split(key, KNOTS + 2)

    def shared(k, power, weight):
        def drawn():
            half = jnp.sqrt(jnp.broadcast_to(power, (1, *size))[..., : size[1] // 2 + 1])
            waves = jnp.fft.rfft2(sample_normal(keys[k], x.shape)) * half
            return weight * jnp.fft.irfft2(waves, size)

        # Of a dark, or a flat of one level, all knots but one or two say nothing.
        return jax.lax.cond(whole & jnp.any(weight > 0), drawn, lambda: jnp.zeros(x.shape))

    fixed = alone = noise = jnp.zeros((1, *size))
    for k, share in enumerate(_hats(context.mean_dn, [maps[f"level{n}"] for n in lit], dark)):
        if dark and k == 0:
            charge = maps["rate"] * context.exposure_s
            fixed = fixed + share * (maps["offset"] + charge)
            own = maps["spread"] + maps["growth"] * context.exposure_s
            alone = alone + share * own
            noise = noise + shared(KNOTS, maps["spectrum"], jnp.sqrt(share))
            continue
        n = lit[k - int(dark)]
        beyond = (
            jnp.maximum(context.mean_dn / jnp.maximum(maps[f"level{n}"], 1e-6), 1.0) if n == lit[-1] else 1.0
        )
        fixed = fixed + share * beyond * maps[f"fixed{n}"]
        alone = alone + share * maps[f"unit{n}"] * maps[f"alone{n}"]
        noise = noise + shared(n, maps[f"power{n}"], jnp.sqrt(share * maps[f"unit{n}"]))
    alone = sample_normal(keys[KNOTS + 1], x.shape) * jnp.sqrt(alone)
    return x + values["weight"] * (fixed + alone + noise)


def _baseline(noise: Noise, values, maps, context: Context) -> Noise:
    """Less noise of the baseline where the spectrum takes it over: read noise in the dark, all of it in
    light. Of read noise it is a share of the baseline's own, whatever lines or pixels have of theirs."""
    lit = [k for k in range(KNOTS) if maps[f"level{k}"].size > 1]
    dark = maps["offset"].size > 1
    shares = ([1.0] if dark else []) + [maps[f"left{k}"] for k in lit]
    hats = _hats(context.mean_dn, [maps[f"level{k}"] for k in lit], dark)
    left = sum(hat * share for hat, share in zip(hats, shares, strict=True)) if hats else 1.0
    read = (
        sum(
            hat * share
            for hat, share in zip(hats, ([maps["keep"]] if dark else []) + shares[int(dark) :], strict=True)
        )
        if hats
        else 1.0
    )
    left, read = (1 + values["weight"] * (v - 1) for v in (left, read))
    # What is taken is the same everywhere, as what is given back is: pixels that are noisier stay so.
    own = (noise.gain_dn_per_e * noise.read_noise_e) ** 2
    plain = (context.gain_dn_per_e * context.read_noise_e) ** 2
    plain = plain * jnp.minimum(jnp.mean(own) / jnp.maximum(jnp.mean(plain), 1e-30), 1)
    rest = jnp.maximum(own - (1 - read) * plain, _LEAST * own)
    gain = noise.gain_dn_per_e * left
    return noise._replace(gain_dn_per_e=gain, read_noise_e=jnp.sqrt(rest) / gain)


def _hats(signal, levels, dark: bool) -> list:
    """Weights of the dark (if any) and of every knot at a signal: linear between neighbours, adding up to
    1."""
    knots = ([jnp.zeros_like(signal)] if dark else []) + levels
    out = []
    for k, at in enumerate(knots):
        up = 1.0 if k == 0 else jnp.clip((signal - knots[k - 1]) / jnp.maximum(at - knots[k - 1], 1e-6), 0, 1)
        last = k + 1 == len(knots)
        down = 1.0 if last else jnp.clip((knots[k + 1] - signal) / jnp.maximum(knots[k + 1] - at, 1e-6), 0, 1)
        out.append(jnp.broadcast_to(jnp.asarray(up * down), signal.shape))
    return out


RESIDUAL = Mechanism(
    id="residual",
    point=Point("readout", "signal", "pixel", "redrawn"),
    parameters=(Parameter("weight", "1", 1.0, 0.0, 1.0, "share of what was measured"),),
    equation=r"y \to y + w\,(o(s) + d\,t + n_{ij}(s) + \mathcal{F}^{-1}[\sqrt{S(s)}\,\mathcal{F} g])",
    sentence="What is left when every name has been tried: maps and a spectrum as measured, without a cause.",
    reference="random-phase synthesis from dark frames: arXiv 2512.03245; sampling of real darks: Zhang et "
    "al., ICCV 2021",
    needs=("dark", "flat"),
    sample=_sample,
    baseline=_baseline,
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
        "darks at two exposures or more, flats at several levels",
    ),
)
