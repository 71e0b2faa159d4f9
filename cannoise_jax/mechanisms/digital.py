"""What a camera does to its codes before it writes them to the raw file."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import DARK, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Effect, Mechanism, Parameter
from cannoise_jax.physics.core.mosaic_ops import neighbour_maximum, neighbour_mean, shifted
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import neighbours
from cannoise_jax.vocabulary import Term


def _blend(x, weight):
    return (1 - weight) * x + weight * neighbour_mean(x, 2)


def _denoise_effect(values, maps, context: Context):
    w, own = values["weight"], context.own_variance()
    variance = (1 - w) ** 2 * own + w**2 / 4 * neighbour_mean(own, 2)
    lags = {}
    for d in ((0, 2), (2, 0)):
        lags[d] = ((1 - w) * w / 4 * (own + shifted(own, *d)))[0]
        lags[2 * d[0], 2 * d[1]] = ((w / 4) ** 2 * shifted(own, *d))[0]
    lags[2, 2] = ((w / 4) ** 2 * (shifted(own, 0, 2) + shifted(own, 2, 0)))[0]
    mean = _blend(context.mean_dn, w) - context.mean_dn
    return Effect(mean=mean[0], variance=(variance - own)[0], lags=lags)


IN_CAMERA_DENOISING = Mechanism(
    id="in_camera_denoising",
    # Before the values are stored: of codes that are rounded anew a weak blend would leave nothing.
    point=Point("digital", "signal", "pixel", "redrawn", "multiply"),
    parameters=(Parameter("weight", "1", 0.15, 0.0, 1.0, "weight of the four neighbours' mean"),),
    equation=r"y \to (1-w)\,y + \frac{w}{4}\sum_{\mathrm{nn,\ same\ colour}} y",
    sentence="The camera smoothed its raw data: noise is lower than physics allows, and pixels of one colour "
    "resemble their neighbours.",
    reference="Clark, Digital camera raw spatial filtering tests, clarkvision.com (spectra of dark frames)",
    needs=("pair", "dark"),
    confused_with=("crosstalk", "gain_error", "demosaicing", "lossy_compression"),
    amplitude=lambda values, context: values["weight"],
    sample=lambda key, x, values, maps, context: _blend(x, values["weight"]),
    effect=_denoise_effect,
)


_KERNELS = tuple(looks.defects.MEANS.values())
"""Places of the neighbours whose mean is put in a pixel's place: the first, unless the map says another."""


def _around(x, sites, power: int = 1):
    """Sum over the neighbours over their number^power: of those that the map names, which is k where kernel k
    is put, from 1 on."""

    def summed(steps):
        return lambda y: jnp.asarray(sum(shifted(y, dy, dx) for dy, dx in steps)) / len(steps) ** power

    kernel = jnp.clip(jnp.round(jnp.max(sites)).astype(jnp.int32) - 1, 0, len(_KERNELS) - 1)
    return jax.lax.switch(kernel, [summed(steps) for steps in _KERNELS], x)


def _painted(x, sites):
    return x + jnp.clip(sites, 0, 1) * (_around(x, sites) - x)


def _defect_maps(key, values, context: Context):
    return {"sites": (jax.random.uniform(key, (1, *context.size)) < values["fraction"]).astype(jnp.float32)}


def _defect_effect(values, maps, context: Context):
    own, base, sites = context.own_variance(), context.mean_dn, maps["sites"]
    return Effect(
        mean=(_painted(base, sites) - base)[0],
        variance=(jnp.clip(sites, 0, 1) * (_around(own, sites, 2) - own))[0],
    )


DEFECT_CORRECTION = Mechanism(
    id="defect_correction",
    point=Point("digital", "code", "pixel", "frozen", distribution="sparse"),
    parameters=(Parameter("fraction", "1", 0.01, 1e-7, 1.0, "share of the pixels"),),
    equation=r"y_{ij} \to \frac{1}{n}\sum_{\mathrm{neighbours}} y \ \mathrm{at\ listed\ pixels}",
    sentence="Bad pixels and focus pixels are painted over with their neighbours' mean: too smooth to be "
    "true.",
    reference="Adobe Digital Negative specification 1.7, opcode FixBadPixelsList",
    needs=("pair", "burst"),
    confused_with=("in_camera_denoising", "dead_pixels"),
    amplitude=lambda values, context: values["fraction"],
    sample=lambda key, x, values, maps, context: _painted(x, maps["sites"]),
    draw_maps=_defect_maps,
    effect=_defect_effect,
)


@functools.cache
def _above_others(count: int) -> tuple[float, float]:
    """Of the largest v and the second largest u of standard normal numbers: E(v - u) and E((v - u)^2), by the
    trapezoid rule over their joint density n (n-1) pdf(u) pdf(v) cdf(u)^(n-2). E(v (v - u)) is 1 (Stein)."""
    from scipy.stats import norm

    u = np.linspace(-8.0, 8.0, 801)
    v = u[:, None]
    weight = count * (count - 1) * norm.pdf(u) * norm.pdf(v) * norm.cdf(u) ** (count - 2) * (v > u)
    weight *= (u[1] - u[0]) ** 2
    return float(np.sum(weight * (v - u))), float(np.sum(weight * (v - u) ** 2))


def _clamp_effect(values, maps, context: Context):
    # Of white noise on an even light: the share that a pixel stands above the second largest is taken off.
    w, own = values["weight"], context.own_variance()
    gap, square = _above_others(9)  # one pixel in nine is above its neighbours
    mean = -w * gap / 9 * jnp.sqrt(own)
    variance = own * (1 - 2 * w / 9 + w**2 * square / 9) - mean**2
    return Effect(mean=mean[0], variance=(variance - own)[0])


HOT_PIXEL_SUPPRESSION = Mechanism(
    id="hot_pixel_suppression",
    point=Point("digital", "code", "pixel", "redrawn", "multiply"),
    parameters=(Parameter("weight", "1", 1.0, 0.0, 1.0, "weight of the clamped value"),),
    equation=r"y \to (1-w)\,y + w\,\min(y, \mathrm{max}_{\mathrm{8\ of\ same\ colour}}\,y)",
    sentence="A pixel above all its neighbours is taken for a hot one and clamped to them: stars disappear, "
    "and equal neighbours abound.",
    reference="Shelley, Nikon coolpix and DSLR star eater tests, markshelley.co.uk",
    needs=("pair", "dark"),
    confused_with=("in_camera_denoising", "defect_correction"),
    amplitude=lambda values, context: values["weight"],
    sample=lambda key, x, values, maps, context: (
        x + values["weight"] * (jnp.minimum(x, neighbour_maximum(x)) - x)
    ),
    effect=_clamp_effect,
)


def _lattice(context: Context):
    """1 on every second pixel of each colour, like the squares of a chess board."""
    height, width = context.size
    return jnp.asarray((np.arange(height)[:, None] // 2 + np.arange(width)[None, :] // 2) % 2, jnp.float32)


def _demosaic(key, x, values, maps, context: Context):
    return x + values["weight"] * _lattice(context) * (neighbour_mean(x, 2) - x)


def _demosaic_effect(values, maps, context: Context):
    w, own, base, on = values["weight"], context.own_variance(), context.mean_dn, _lattice(context)
    variance = on * ((1 - w) ** 2 * own + w**2 / 4 * neighbour_mean(own, 2) - own)
    mean = on * w * (neighbour_mean(base, 2) - base)
    # Of two neighbours of one colour exactly one is interpolated, and holds w/4 of the other.
    lags = {d: (w / 4 * (on * shifted(own, *d) + (1 - on) * own))[0] for d in ((0, 2), (2, 0))}
    return Effect(mean=mean[0], variance=variance[0], lags=lags)


DEMOSAICING = Mechanism(
    id="demosaicing",
    point=Point("digital", "code", "pixel", "redrawn", "multiply"),
    parameters=(Parameter("weight", "1", 1.0, 0.0, 1.0, "weight of the interpolated value"),),
    equation=r"y \to (1-w)\,y + \frac{w}{4}\sum_{\mathrm{nn}} y \ \mathrm{on\ every\ second\ pixel\ of\ a\ "
    r"colour}",
    sentence="Half of the samples were never measured but interpolated: their noise is halved and copied "
    "from their neighbours, in a regular lattice.",
    reference="Popescu and Farid, Exposing Digital Forgeries in Color Filter Array Interpolated Images, IEEE "
    "TSP 53, 3948 (2005)",
    needs=("pair",),
    confused_with=("in_camera_denoising", "crosstalk", "defect_correction"),
    amplitude=lambda values, context: values["weight"],
    sample=_demosaic,
    effect=_demosaic_effect,
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("demosaicing",
             "The mosaic has been interpolated from a coarser or another mosaic.",
             48, "sensor", "1", "blend weight of the interpolated value", listed=520),
        DEMOSAICING,
        needs="two frames or more at one setting",
        signatures=lambda recorded: (
            looks.covariance.neighbours("white", looks.covariance.INTERPOLATED, name="lags_demosaicing",
                parameter="weight", covers=looks.COVERS_NOTHING),
            looks.lattice.interpolated(recorded, name="lattice", covers=imprints.LATTICE,
                lifted_by=imprints.LATTICE),
        ),
        examples=Examples("lags"),
    ),
    Entry(
        Term("in_camera_denoising",
             "The camera has averaged each pixel with its neighbours of the same colour.",
             45, "sensor", "1", "blend weight of the neighbours' mean", listed=290),
        IN_CAMERA_DENOISING,
        needs="two frames or more at one setting",
        signatures=looks.always(
            looks.covariance.neighbours("white", looks.covariance.BLENDED_4, name=looks.BLENDS[0],
                parameter="weight", least=looks.covariance.blended,
                covers=looks.COVERS_NOTHING),
            looks.covariance.neighbours("white", looks.covariance.BLENDED_8, name=looks.BLENDS[1],
                parameter="weight", least=looks.covariance.blended,
                covers=looks.COVERS_NOTHING),
        ),
        estimator=Estimator(neighbours.in_camera_denoising, least=0.01, smooths=neighbours.kept, white=True),
        examples=Examples("lags", shown={"weight": 0.4}, strong={"weight": 0.4},
                          cases=(Case({"weight": 0.15}, DARK), Case({"weight": 0.45}, DARK, note="strong"),
                          Case({"weight": 0.5}, DARK, note="eighths of a code"))),
    ),
    Entry(
        Term("defect_correction",
             "Listed pixels are replaced by the mean of their neighbours.",
             47, "sensor", "1", "fraction of the pixels", listed=500),
        DEFECT_CORRECTION,
        needs="twenty frames or more of one flat",
        signatures=lambda recorded: (
            looks.defects.corrected(recorded, name="corrected", lifted_by=imprints.CORRECTED),
        ),
        examples=Examples("gaps", shown={"fraction": 0.05}, strong={"fraction": 0.2}),
    ),
    Entry(
        Term("hot_pixel_suppression",
             "Pixels above all their neighbours of the same colour are clamped to them.",
             46, "sensor", "1", "blend weight of the clamped value", listed=510),
        HOT_PIXEL_SUPPRESSION,
        needs="twenty long darks",
        signatures=looks.always(
            looks.peaks.peaks(name="peaks", covers=imprints.PEAKS, lifted_by=imprints.PEAKS),
        ),
        examples=Examples("tail", strong={"weight": 0.7}),
    ),
)  # fmt: skip
