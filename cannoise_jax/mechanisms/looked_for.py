"""The signatures that recordings are searched for, by name, and the mechanisms that they are of."""

from __future__ import annotations

from cannoise_jax.signatures import (
    codes,
    covariance,
    curve,
    flicker,
    glow,
    groups,
    hot,
    levels,
    light,
    lines,
    means,
    patterns,
    pixels,
    reference,
    shape,
    spectra,
    taps,
    waves,
)
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.signature import Signature

SCALES = ("reference_scale", "description_scale")
"""Signatures of the levels of light, which what a frame or its colours share scatters."""
DARK_LEVELS = ("black_channels", "black_level", "greens", "stated_read")
LIGHT_LEVELS = ("greens", "shading", *SCALES)
"""Signatures of levels, whose standard errors know pixel noise only: a pattern of lines or pixels scatters
channel means by more, so they are set aside once such a pattern is in the model. A shared offset is
part of the fitted read noise too, so a stated read noise is not judged beside it."""
NOISY = ("kurtosis", "light_tails", "pixel_spread", "telegraph", "skewness", "hot_additive", "hot_thermal")
"""Signatures of shape that cannot be trusted once one of them is in the model."""
MAPS = ("pixel_additive_static", "pixel_thermal_static")
SCENES = (
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "scene_static",
    "curvature",
    *SCALES,
)
"""Signatures of scenes against their references."""
BENT = "variance_curve"
BLENDS = ("lags_in_camera_denoising", "lags_in_camera_denoising_8")
SHARED = "lags_crosstalk"
SHAPES = ("kurtosis", "light_tails", "pixel_spread", "skewness", "telegraph")


def _lines() -> tuple[Signature, ...]:
    out: list[Signature] = []
    for axis, temporal, static, gain in (
        ("row", "row_noise", "row_fpn", None),
        ("column", "column_noise", "column_fpn", "column_gain"),
    ):
        out += [
            lines.redrawn(
                axis,
                "additive",
                name=f"{axis}_additive_temporal",
                mechanism=temporal,
                parameter="sigma_dn",
                covers=DARK_LEVELS,
            ),
            lines.frozen(
                axis,
                "additive",
                name=f"{axis}_additive_static",
                mechanism=static,
                parameter="sigma_dn",
                covers=DARK_LEVELS,
            ),
            lines.redrawn(axis, "signal", name=f"{axis}_relative_temporal", covers=LIGHT_LEVELS),
            lines.frozen(
                axis,
                "signal",
                name=f"{axis}_relative_static",
                mechanism=gain,
                parameter="sigma" if gain else None,
                covers=LIGHT_LEVELS,
            ),
        ]
    return tuple(out)


def _groups() -> tuple[Signature, ...]:
    layouts = ("tile_8", "tile_16", "tile_32", "tile_64", "diagonal", "antidiagonal")
    few = ("site", "row_parity", "column_parity")  # what stays per colour site is the black level's
    out = [
        groups.shared(f"{layout}_{time}", layout, time, covers=DARK_LEVELS)
        for layout in (*layouts, *few)
        for time in ("redrawn", "frozen")
        if time == "redrawn" or layout not in few
    ]
    # A lamp that drifts in colour.
    lamp = groups.shared("site_relative_redrawn", "site", "redrawn", scaling="signal", covers=SCALES)
    return (*out, lamp)


def looked_for(recorded: Recorded) -> tuple[Signature, ...]:
    """All signatures, for what the recordings of one split say."""
    return (
        *_lines(),
        *_groups(),
        patterns.frame("additive", name="frame_additive", mechanism="offset_drift", parameter="sigma_dn"),
        patterns.frame(
            "signal", name="frame_relative", mechanism="illumination_drift", parameter="sigma", covers=SCALES
        ),
        patterns.pixel(
            "additive",
            name="pixel_additive_static",
            mechanism="dsnu",
            parameter="sigma_dn",
            covers=DARK_LEVELS,
        ),
        patterns.pixel(
            "signal", name="pixel_relative_static", mechanism="prnu", parameter="sigma", covers=LIGHT_LEVELS
        ),
        patterns.pixel(
            "exposure",
            name="pixel_thermal_static",
            mechanism="dsnu",
            parameter="sigma_dn",
            covers=DARK_LEVELS,
        ),
        patterns.scenes(name="scene_static", mechanism="reference_error", covers=SCALES),
        spectra.slope(
            "raster", name="raster_slope", mechanism="pink_noise", parameter="sigma_dn", covers=DARK_LEVELS
        ),
        spectra.slope(
            "row", name="row_slope", mechanism="row_pink_noise", parameter="sigma_dn", covers=DARK_LEVELS
        ),
        waves.interference("redrawn", name="wave_redrawn", mechanism="banding", parameter="amplitude_dn"),
        waves.interference("frozen", name="wave_frozen", mechanism="banding", parameter="amplitude_dn"),
        flicker.mains(name="flicker", mechanism="flicker", parameter="amplitude"),
        covariance.neighbours(
            "shot",
            covariance.GIVEN,
            name=SHARED,
            mechanism="crosstalk",
            parameter="fraction",
            least=covariance.shared_charge,
        ),
        covariance.neighbours(
            "charge",
            covariance.REPELLED,
            name="lags_brighter_fatter",
            mechanism="brighter_fatter",
            parameter="a00",
            # The variance that is lost bends the curve, which counts for it where both reject.
            covers=(BENT,),
            lifted_by=(BENT,),
        ),
        *(
            covariance.neighbours(
                "white",
                template,
                name=name,
                mechanism="in_camera_denoising",
                parameter="weight",
                least=covariance.blended,
            )
            for name, template in zip(BLENDS, (covariance.BLENDED_4, covariance.BLENDED_8), strict=True)
        ),
        covariance.neighbours(
            "white",
            covariance.INTERPOLATED,
            name="lags_demosaicing",
            mechanism="demosaicing",
            parameter="weight",
        ),
        covariance.any_lag(name="lags_any"),
        shape.tails(name="kurtosis", heavy=True, mechanism="heavy_tails", covers=NOISY),
        shape.tails(name="light_tails", heavy=False, covers=NOISY),
        shape.skewed(name="skewness"),
        pixels.own_noise(
            name="pixel_spread", mechanism="pixel_read_noise_map", parameter="spread", covers=NOISY
        ),
        pixels.jumping(name="telegraph", mechanism="rts", covers=NOISY),
        hot.standing_out(
            "additive", name="hot_additive", mechanism="hot_pixels", maps=MAPS, covers=("hot_thermal",)
        ),
        hot.standing_out(
            "exposure", name="hot_thermal", mechanism="hot_pixels", maps=MAPS, covers=("hot_additive",)
        ),
        means.halves(name="step", mechanism="amplifier_mismatch", parameter="step_dn", covers=("taps",)),
        taps.regions(name="taps", mechanism="amplifier_mismatch", parameter="step_dn", covers=("step",)),
        glow.from_edges(name="glow", mechanism="amp_glow", parameter="e_per_s"),
        light.two_greens(
            recorded, name="greens", mechanism="green_imbalance", parameter="sigma", covers=("greens",)
        ),
        light.shaded(
            recorded,
            name="shading",
            mechanism="lens_shading",
            parameter="sigma",
            covers=("shading", *SCALES),
        ),
        light.curved(recorded, name="curvature", mechanism="nonlinearity", parameter="loss", covers=SCALES),
        reference.scaled(
            recorded, name="reference_scale", mechanism="reference_error", common=False, covers=SCALES
        ),
        reference.scaled(
            recorded, name="description_scale", mechanism="bookkeeping", common=True, covers=SCALES
        ),
        reference.moved(recorded, name="reference_shift", mechanism="misregistration", covers=SCENES),
        reference.blurred(
            recorded,
            "blur",
            name="reference_blur",
            mechanism="reference_error",
            error="reference_error",
            camera="in_camera_denoising",
            parameter="weight",
            partner=BLENDS[0],
            template=covariance.BLENDED_4,
            covers=(*SCENES, *BLENDS),
        ),
        reference.blurred(
            recorded,
            "spread",
            name="reference_spread",
            mechanism="crosstalk",
            error="reference_error",
            camera="crosstalk",
            parameter="fraction",
            partner=SHARED,
            template=covariance.GIVEN,
            covers=(*SCENES, SHARED),
        ),
        levels.black(recorded, name="black_level", mechanism="bookkeeping", covers=("black_level", *SCALES)),
        levels.black_of_channels(
            recorded,
            name="black_channels",
            mechanism="channel_offset",
            parameter="sigma_dn",
            covers=("black_channels",),
        ),
        levels.by_exposure(
            recorded,
            name="dark_level",
            mechanism="dark_current",
            parameter="e_per_s",
            covers=("dark_level",),
        ),
        curve.bent(recorded, name=BENT, covers=(BENT,)),
        curve.ceiling(
            recorded,
            name="saturation",
            mechanism="saturation",
            parameter="full_well_e",
            covers=("saturation", BENT, "skewness", "kurtosis", *SCENES),
        ),
        *curve.restated(
            recorded, "gain", name="stated_gain", mechanism="gain_error", covers=("stated_gain",)
        ),
        *curve.restated(
            recorded, "read", name="stated_read", mechanism="read_noise_error", covers=("stated_read",)
        ),
        codes.combed(
            recorded,
            name="comb",
            mechanism="missing_codes",
            parameter="period",
            covers=("comb",),
            shapes=SHAPES,
        ),
        codes.coarse(
            recorded,
            name="coarse",
            mechanism="quantization",
            parameter="step_dn",
            covers=("coarse", "comb"),
        ),
        codes.piled_up(
            recorded,
            name="pile_up",
            mechanism="black_clipping",
            parameter="level_dn",
            # Levels cut off at black are far to one side, and their means curved, without more.
            covers=(
                "pile_up",
                *SHAPES,
                BENT,
                "black_level",
                "black_channels",
                "lags_any",
                "hot_additive",
                "hot_thermal",
                "curvature",
            ),
        ),
    )
