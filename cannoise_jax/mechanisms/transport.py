"""Mechanisms that move collected charge: to the neighbours, along the column, into the next frame."""

from __future__ import annotations

import jax.numpy as jnp

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import FLAT, Case, Entry, Examples
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Context, Mechanism, Parameter, effect_in_dn
from cannoise_jax.physics.core.mosaic_ops import neighbour_mean, shifted
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import lag, neighbours
from cannoise_jax.vocabulary import Term


def _share(x, fraction):
    return (1 - fraction) * x + fraction * neighbour_mean(x, 1)


def _crosstalk_effect(values, maps, context):
    mu, a, gain = context.mean_charge(), values["fraction"], context.gain_dn_per_e
    variance = (1 - a) ** 2 * mu + a**2 / 4 * neighbour_mean(mu, 1)
    first = {
        d: (gain * shifted(gain, *d) * (1 - a) * a / 4 * (mu + shifted(mu, *d)))[0] for d in ((0, 1), (1, 0))
    }
    second = {(0, 2): (gain**2 * (a / 4) ** 2 * shifted(mu, 0, 1))[0],
              (2, 0): (gain**2 * (a / 4) ** 2 * shifted(mu, 1, 0))[0]}  # fmt: skip
    return effect_in_dn(context, _share(mu, a) - mu, variance - mu, lags={**first, **second})


CROSSTALK = Mechanism(
    id="crosstalk",
    point=Point("pixel", "charge", "pixel", "redrawn", "multiply"),
    parameters=(Parameter("fraction", "1", 0.02, 0.0, 0.8, "share of the charge given away"),),
    equation=r"e_{ij} \to (1-\alpha)\,e_{ij} + \frac{\alpha}{4}\sum_{\mathrm{nn}} e",
    sentence="Part of each pixel's signal shows up in its neighbours, colours mix, and the noise of "
    "neighbours is alike.",
    reference="Moore, Ninkov and Forrest, Quantum efficiency overestimation and deterministic cross talk "
    "resulting from interpixel capacitance, Opt. Eng. 45, 076402 (2006)",
    needs=("pair", "flat"),
    confused_with=("brighter_fatter", "in_camera_denoising", "demosaicing", "gain_error"),
    amplitude=lambda values, context: values["fraction"],
    sample=lambda key, x, values, maps, context: _share(x, values["fraction"]),
    effect=_crosstalk_effect,
)


def _repel(key, x, values, maps, context: Context):
    """Charge flows across each pixel border in proportion to the difference and the mean of both sides."""
    a = values["a00"] / 8
    near = [shifted(x, *d) for d in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    return x - a * sum((x - n) * (x + n) / 2 for n in near)


def _repel_effect(values, maps, context):
    mu, a, gain = context.mean_charge(), values["a00"] / 8, context.gain_dn_per_e
    near = [shifted(mu, *d) for d in ((0, 1), (0, -1), (1, 0), (-1, 0))]
    own = 1 - 4 * a * mu  # derivative of a pixel by its own charge, and by a neighbour's: a times that charge
    variance = own**2 * mu + a**2 * sum(n**3 for n in near)
    lags = {}
    for d in ((0, 1), (1, 0)):
        there = shifted(mu, *d)
        lags[d] = (gain * shifted(gain, *d) * a * (own * mu * mu + (1 - 4 * a * there) * there * there))[0]
    return effect_in_dn(context, -a * sum(mu**2 - n**2 for n in near) / 2, variance - mu, lags=lags)


BRIGHTER_FATTER = Mechanism(
    id="brighter_fatter",
    point=Point("pixel", "charge", "pixel", "redrawn", "multiply", signal=2.0),
    parameters=(Parameter("a00", "1/e-", 2e-6, 0.0, 1e-3, "relative loss of variance per electron"),),
    equation=r"\mathrm{var} = \mu + a_{00}\mu^2,\quad \mathrm{cov}_{ij} = a_{ij}\mu^2,\quad \sum a_{ij} = 0",
    sentence="A full pixel repels new electrons into its neighbours: shot noise bends down at high signal "
    "and neighbours move together.",
    reference="Astier et al., The shape of the photon transfer curve of CCD sensors, A&A 629, A36 (2019)",
    needs=("flat",),
    confused_with=("crosstalk", "nonlinearity", "gain_error"),
    amplitude=lambda values, context: values["a00"],
    sample=_repel,
    effect=_repel_effect,
)


def _lag(key, x, values, maps, context: Context):
    # The last frame of x is the one before the first.
    kept = values["fraction"]
    return (1 - kept) * x + kept * jnp.roll(x, 1, axis=0)


def _lag_effect(values, maps, context):
    mu, kept, gain = context.mean_charge(), values["fraction"], context.gain_dn_per_e
    change = ((1 - kept) ** 2 + kept**2 - 1) * mu
    return effect_in_dn(context, variance=change, temporal={1: (gain**2 * kept * (1 - kept) * mu)[0]})


IMAGE_LAG = Mechanism(
    id="image_lag",
    point=Point("pixel", "charge", "pixel", "drifting", "multiply"),
    parameters=(Parameter("fraction", "1", 0.01, 0.0, 0.9, "share of the charge left behind"),),
    equation=r"e_t \to (1-\lambda)\,e_t + \lambda\,e_{t-1}",
    sentence="Not all charge leaves the pixel: a ghost of the last frame is in this one.",
    reference="Fossum and Hondongwa, A Review of the Pinned Photodiode, IEEE JEDS 2, 33 (2014), section VI",
    needs=("burst",),
    confused_with=("scene_motion", "rts", "illumination_drift"),
    amplitude=lambda values, context: values["fraction"],
    sample=_lag,
    looks_back=True,
    effect=_lag_effect,
)


def _smear(key, x, values, maps, context: Context):
    return x + values["fraction"] * jnp.mean(x, axis=-2, keepdims=True)


def _smear_effect(values, maps, context):
    mu, s, rows = context.mean_charge(), values["fraction"], context.size[0]
    column = jnp.mean(mu, axis=-2, keepdims=True)
    return effect_in_dn(context, s * column + 0 * mu, 2 * s * mu / rows + s**2 * column / rows)


SMEAR = Mechanism(
    id="smear",
    point=Point("pixel", "charge", "column", "frozen", "multiply"),
    parameters=(Parameter("fraction", "1", 0.002, 0.0, 1.0, "share of the column's mean signal"),),
    equation=r"e_{ij} \to e_{ij} + s\,\langle e_{\cdot j} \rangle",
    sentence="While rows are shifted out, light still falls on them: bright spots draw a vertical streak.",
    reference="Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 5",
    needs=("pair_independent", "flat"),
    confused_with=("column_gain", "column_fpn", "reference_error"),
    amplitude=lambda values, context: values["fraction"],
    sample=_smear,
    effect=_smear_effect,
)


ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("brighter_fatter",
             "Collected charge repels further charge: shot noise correlates.",
             12, "sensor", "1/e-", "minus a00: relative loss of shot-noise variance per electron",
             listed=420),
        BRIGHTER_FATTER,
        needs="two frames or more of bright flats",
        signatures=looks.always(
            # The variance that is lost bends the curve, which counts for it where both reject.
            looks.covariance.neighbours("charge", looks.covariance.REPELLED, name="lags_brighter_fatter",
                parameter="a00", covers=looks.CURVES, lifted_by=(looks.BENT,)),
        ),
        examples=Examples("variance", shown={"a00": 0.0001}, strong={"a00": 0.0003}),
    ),
    Entry(
        Term("image_lag",
             "A frame keeps part of the charge of the frame before it.",
             14, "sensor", "1", "fraction of the charge left behind", listed=340),
        IMAGE_LAG,
        needs="three frames or more of a flat, one after the other; a change from bright to dark tells more",
        signatures=lambda recorded: (
            looks.memory.lag(recorded, name="lag_in_time", before=looks.SLOW, lifted_by=imprints.LAG),
        ),
        estimator=Estimator(lag.image_lag, least=5e-3, smooths=lag.kept, white=True),
        examples=Examples("temporal", shown={"fraction": 0.15}, strong={"fraction": 0.2},
                          cases=(Case({"fraction": 0.03}, FLAT),)),
    ),
    Entry(
        Term("smear",
             "Bright pixels leak into their whole column.",
             11, "sensor", "1", "added signal as a fraction of the column's mean signal", listed=480),
        SMEAR,
        needs="a scene with a saturated light source, two frames or more",
        signatures=looks.always(
            looks.smear.smeared(name="smear", lifted_by=imprints.SMEAR),
        ),
        examples=Examples("columns", shown={"fraction": 0.02}, strong={"fraction": 0.1}),
    ),
    Entry(
        Term("crosstalk",
             "Charge or signal leaks into the neighbouring pixels of the mosaic after collection.",
             13, "sensor", "1", "total fraction of charge given away", listed=80),
        CROSSTALK,
        needs="two frames or more of a lit scene or flat",
        signatures=lambda recorded: (
            looks.covariance.neighbours("shot", looks.covariance.GIVEN, name=looks.SHARED,
                parameter="fraction", least=looks.covariance.shared_charge,
                covers=looks.COVERS_NOTHING),
            looks.reference.blurred(recorded, "spread", name="reference_spread", error="reference_error",
                camera="crosstalk", parameter="fraction", partner=looks.SHARED,
                template=looks.covariance.GIVEN, covers=(*looks.SCENES, looks.SHARED)),
        ),
        estimator=Estimator(neighbours.crosstalk, least=5e-3, smooths=neighbours.kept, white=True),
        examples=Examples("lags", shown={"fraction": 0.15}, strong={"fraction": 0.3},
                          cases=(Case({"fraction": 0.03}, FLAT),)),
    ),
)  # fmt: skip
