"""Mechanisms that alter the two noise steps themselves: the slope of the shot noise, the size and shape of
the read noise, pixel by pixel."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax.numpy as jnp

from cannoise_jax.mechanisms import looks
from cannoise_jax.mechanisms.entry import DARK, FLAT, Case, Entry, Examples
from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Effect, Mechanism, Parameter
from cannoise_jax.physics.core.places import Site, place
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.physics.transfer import maps as measured
from cannoise_jax.physics.transfer.estimate import Estimates
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import loud_lines, maps, noise
from cannoise_jax.physics.transfer.noise_of_lines import Line
from cannoise_jax.vocabulary import Term


def _gain(noise, values, maps, context):
    factor = 1 + values["error"]
    # The read noise in DN stays: only the slope of the variance over the signal is wrong.
    return noise._replace(
        gain_dn_per_e=noise.gain_dn_per_e * factor, read_noise_e=noise.read_noise_e / factor
    )


def _gain_effect(values, maps, context):
    factor, gain, mean = 1 + values["error"], context.gain_dn_per_e, context.mean_dn
    return Effect(
        variance=(factor - 1) * gain * mean,
        third=(factor**2 - 1) * gain**2 * mean,
        fourth=(factor**3 - 1) * gain**3 * mean,
    )


GAIN_ERROR = Mechanism(
    id="gain_error",
    point=Point("photons", "charge", "pixel", "redrawn", "multiply", signal=0.5),
    parameters=(Parameter("error", "1", 0.05, -0.9, 10.0, "true over assumed gain, minus one"),),
    equation=r"\mathrm{var} = (1+\epsilon)\,K\,(y-b) + K^2 s^2",
    sentence="The number of electrons behind each DN is not what the metadata says, so shot noise is larger "
    "or smaller than predicted in proportion at every signal level.",
    reference="EMVA 1288 release 4.0, section 2.2 (photon transfer)",
    needs=("pair",),
    confused_with=("in_camera_denoising", "crosstalk", "brighter_fatter", "excess_noise", "reference_error"),
    amplitude=lambda values, context: values["error"],
    baseline=_gain,
    effect=_gain_effect,
)


def _read(noise, values, maps, context):
    return noise._replace(read_noise_e=noise.read_noise_e * (1 + values["error"]))


def _read_effect(values, maps, context):
    read = (context.gain_dn_per_e * context.read_noise_e) ** 2
    return Effect(variance=((1 + values["error"]) ** 2 - 1) * read)


READ_NOISE_ERROR = Mechanism(
    id="read_noise_error",
    point=Point("readout", "signal", "pixel", "redrawn"),
    parameters=(Parameter("error", "1", 0.1, -0.99, 10.0, "true over assumed read noise, minus one"),),
    equation=r"s \to (1+\epsilon)\,s",
    sentence="The electronics are noisier or quieter than specified, by the same amount in every pixel and "
    "at every signal level.",
    reference="EMVA 1288 release 4.0, section 2.2 (temporal dark noise)",
    needs=("dark", "pair"),
    confused_with=(
        "quantization",
        "pixel_read_noise_map",
        "heavy_tails",
        "reference_error",
        "compensated_dark_current",
    ),
    amplitude=lambda values, context: values["error"],
    baseline=_read,
    effect=_read_effect,
)


def _tails(noise, values, maps, context):
    return noise._replace(tukey_lambda=values["tukey_lambda"])


def _tails_effect(values, maps, context):
    read = (context.gain_dn_per_e * context.read_noise_e) ** 2
    return Effect(fourth=tukey_lambda.excess_kurtosis(values["tukey_lambda"]) * read**2)


HEAVY_TAILS = Mechanism(
    id="heavy_tails",
    point=Point("readout", "signal", "pixel", "redrawn", distribution="tukey_lambda"),
    parameters=(Parameter("tukey_lambda", "1", -0.1, -0.45, 0.3, "shape: 0.135 is near Gaussian"),),
    equation=r"n = s\,Q(u)/\sqrt{V_\lambda},\quad Q(u) = \frac{u^\lambda-(1-u)^\lambda}{\lambda}",
    sentence="Read noise throws outliers more often than a Gaussian of the same size would, in any pixel and "
    "any frame alike.",
    reference="Wei et al., Physics-based Noise Modeling for Extreme Low-light Photography, TPAMI 2021, "
    "section 3.2",
    needs=("dark", "burst"),
    confused_with=("pixel_read_noise_map", "rts", "quantization", "cosmic_rays"),
    amplitude=lambda values, context: tukey_lambda.excess_kurtosis(values["tukey_lambda"]),
    baseline=_tails,
    effect=_tails_effect,
)


def _spread_maps(over: Site):
    def draw(key, values, context):
        width = values["spread"]
        # Log-normal with unit mean square: the mean variance over the pixels is the baseline's.
        log_width = jnp.sqrt(jnp.log1p(jnp.asarray(width, jnp.float32) ** 2))
        at = place(over)
        normal = sample_normal(key, (1, *at.sites(context.size, (1, 1))))
        return {"factor": jnp.exp(log_width * at.spread(normal, context.size) - log_width**2)}

    return draw


def _spread(noise, values, maps, context):
    return noise._replace(read_noise_e=noise.read_noise_e * maps["factor"])


def _spread_effect(values, maps, context):
    read = (context.gain_dn_per_e * context.read_noise_e) ** 2
    return Effect(variance=jnp.broadcast_to((maps["factor"] ** 2 - 1) * read, (1, *context.size))[0])


_READOUT = "El Gamal and Eltoukhy, CMOS Image Sensors, IEEE Circuits and Devices 21(3), 2005 (readout)"


def _read_noise_map(over: Site, equation: str, sentence: str, **record) -> Mechanism:
    """A fixed read noise of every pixel, row or column, log-normal."""
    return Mechanism(
        id=f"{over}_read_noise_map",
        point=Point("pixel" if over == "pixel" else "readout", "signal", over, "redrawn"),
        parameters=(
            Parameter(
                "spread", "1", 0.3, 0.0, 3.0, f"standard deviation over mean of the {over}s' read noise"
            ),
        ),
        equation=equation + r",\quad w^2 = \ln(1+\mathrm{spread}^2)",
        sentence=sentence,
        needs=("dark", "burst"),
        amplitude=lambda values, context: values["spread"],
        baseline=_spread,
        draw_maps=_spread_maps(over),
        effect=_spread_effect,
        **record,
    )


PIXEL_READ_NOISE_MAP = _read_noise_map(
    "pixel",
    r"s_{ij} = s\,e^{wz_{ij}-w^2}",
    "Every pixel has its own source follower, and some are noisier than others, always the same ones.",
    reference="Nakamura, Image Sensors and Signal Processing for Digital Still Cameras, 2006, chapter 3 "
    "(pixel source follower)",
    confused_with=("heavy_tails", "rts"),
)
ROW_READ_NOISE_MAP = _read_noise_map(
    "row",
    r"s_{ij} = s\,e^{wz_i-w^2}",
    "Rows that are read by different converters, or in other phases of the readout, are not equally noisy, "
    "and always the same ones are.",
    reference=_READOUT,
    confused_with=("pixel_read_noise_map", "heavy_tails"),
)
COLUMN_READ_NOISE_MAP = _read_noise_map(
    "column",
    r"s_{ij} = s\,e^{wz_j-w^2}",
    "Every column has its own amplifier and converter, and some are noisier than others, always the same "
    "ones.",
    reference=_READOUT,
    confused_with=("pixel_read_noise_map", "heavy_tails", "column_noise"),
)


def _skew(noise, values, maps, context):
    return noise._replace(poisson_share=values["strength"])


def _skew_effect(values, maps, context):
    gain, mean, share = context.gain_dn_per_e, context.mean_dn, values["strength"]
    return Effect(third=(share**3 - 1) * gain**2 * mean, fourth=(share**4 - 1) * gain**3 * mean)


POISSON_SKEW = Mechanism(
    id="poisson_skew",
    point=Point("photons", "charge", "pixel", "redrawn", signal=0.5),
    parameters=(Parameter("strength", "1", 0.0, 0.0, 1.0, "0: Gaussian shot noise, 1: Poisson"),),
    equation=r"N = \mu + \sigma_P\,(P(\mu)-\mu) + \sqrt{1-\sigma_P^2}\,\sqrt{\mu}\,z",
    sentence="Photons are counted, so dark areas have rare bright pixels that a Gaussian does not have; this "
    "baseline counts photons, and the strength says how much of that is kept.",
    reference="EMVA 1288 release 4.0, section 2.1 (Poisson statistics of the light)",
    needs=("pair",),
    confused_with=("hot_pixels", "cosmic_rays", "black_clipping"),
    amplitude=lambda values, context: values["strength"],
    baseline=_skew,
    effect=_skew_effect,
)

_LINES: tuple[tuple[Line, Mechanism, Callable[..., Estimates], int], ...] = (
    ("row", ROW_READ_NOISE_MAP, loud_lines.row_read_noise_map, 320),
    ("column", COLUMN_READ_NOISE_MAP, loud_lines.column_read_noise_map, 330),
)

ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("gain_error",
             "The system gain differs from the one assumed, so shot noise has another slope.",
             1, "sensor", "1", "relative error of the gain: true over assumed, minus one", listed=0),
        GAIN_ERROR,
        needs="run with --simulator nlf on files that state shot and read, with scenes or flats at two "
              "levels",
        signatures=lambda recorded: looks.curve.restated(
            recorded, "gain", name="stated_gain", covers=("stated_gain",)
        ),
        estimator=Estimator(noise.gain_error, in_baseline=True),
        examples=Examples("variance", shown={"error": 0.5}, strong={"error": 0.4},
                          cases=(Case({"error": 0.1}, FLAT),)),
    ),
    Entry(
        Term("read_noise_error",
             "The white read noise differs from the one assumed.",
             39, "sensor", "1", "relative error of the read noise: true over assumed, minus one",
             listed=10),
        READ_NOISE_ERROR,
        needs="run with --simulator nlf on files that state shot and read, with darks of two frames or "
              "more",
        signatures=lambda recorded: looks.curve.restated(
            recorded, "read", name="stated_read", covers=("stated_read",)
        ),
        estimator=Estimator(noise.read_noise_error, in_baseline=True),
        examples=Examples("variance", shown={"error": 1.0}, dim=True, strong={"error": 0.5},
                          cases=(Case({"error": 0.1}, DARK),)),
    ),
    Entry(
        Term("heavy_tails",
             "Read noise has heavier tails than a Gaussian, in every pixel alike.",
             26, "sensor", "1", "excess kurtosis of the read noise", listed=120),
        HEAVY_TAILS,
        needs="darks of two frames or more whose noise exceeds two thirds of a code",
        signatures=looks.always(
            looks.shape.tails(name="kurtosis", heavy=True, covers=looks.NOISY, smooth=("comb",)),
        ),
        estimator=Estimator(noise.heavy_tails, white=True, least=0.02, law="tails",
                            neutral=tukey_lambda.GAUSSIAN, against=noise.no_heavier),
        examples=Examples("tail", shown={"tukey_lambda": -0.15}, dim=True,
                          cases=(Case({"tukey_lambda": -0.05}, DARK),)),
    ),
    *(
        Entry(
            Term(f"{axis}_read_noise_map",
                 f"Every {axis} has its own fixed read noise.",
                 27, "sensor", "1", f"rms relative spread of the read noise over the {axis}s",
                 ("pixel_read_noise_map",), listed=listed),
            record,
            needs="darks of three frames or more whose noise exceeds two thirds of a code",
            signatures=looks.always(
                looks.noisy_lines.own_noise(axis, name=f"{axis}_spread", parameter="spread", smooth=("comb",),
                                            of_pixels=("pixel_spread", "kurtosis", "telegraph")),
            ),
            estimator=Estimator(measure, white=True, least=0.01,
                                maps=partial(measured.read_noise_of_lines, axis=axis)),
            examples=Examples(f"{axis} loudness", shown={"spread": 0.8}, dim=True, strong={"spread": 0.5},
                              cases=(Case({"spread": 0.2}, DARK),)),
        )
        for axis, record, measure, listed in _LINES
    ),
    Entry(
        Term("pixel_read_noise_map",
             "Every pixel has its own fixed read noise.",
             27, "sensor", "1", "rms relative spread of the read noise over the pixels", listed=130),
        PIXEL_READ_NOISE_MAP,
        needs="three dark frames or more whose noise exceeds two thirds of a code; eight are better",
        signatures=looks.always(
            looks.pixels.own_noise(name="pixel_spread", parameter="spread", covers=looks.NOISY,
                                   smooth=("comb",), before=("telegraph",)),
        ),
        estimator=Estimator(maps.pixel_read_noise_map, white=True, least=0.03, law="spread",
                            maps=measured.read_noise, spares=maps.pixel_read_noise_map),
        examples=Examples("spread", shown={"spread": 0.8}, dim=True, cases=(Case({"spread": 0.2}, DARK),
                          Case({"spread": 0.8}, DARK, note="strong"))),
    ),
    Entry(
        Term("poisson_skew",
             "Shot noise is Poisson, with its skewness, where a Gaussian was assumed.",
             2, "sensor", "1", "strength: 0 Gaussian, 1 Poisson", listed=360),
        POISSON_SKEW,
        needs="a simulator whose shot noise is Gaussian (that of the baseline is Poisson)",
        examples=Examples("tail", shown={"strength": 0.0}, dim=True),
    ),
)  # fmt: skip
