"""What the families say of their signatures: the kit, and the signatures that one finding makes doubtful."""

from __future__ import annotations

from collections.abc import Callable

from cannoise_jax.signatures import (
    behind_gain,
    channel_levels,
    clocking,
    code_spacing,
    codes,
    covariance,
    curvature,
    curve,
    dark_noise,
    defects,
    events,
    flicker,
    gain_curve,
    glow,
    groups,
    hot,
    in_time,
    jumps_beside,
    lattice,
    levels,
    light,
    line_maps,
    line_turns,
    lines,
    means,
    memory,
    modulated,
    motion,
    moved_tiles,
    moving_taps,
    noisy_lines,
    other_response,
    patterns,
    peaks,
    pixels,
    random_gain,
    reference,
    repeats,
    response,
    scales,
    shape,
    site_light,
    smear,
    smooth_maps,
    spectra,
    tails,
    tap_gain,
    taps,
    telegraph,
    warm,
    waves,
)
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.signature import COVERS_NOTHING, Signature

SCALES = ("reference_scale", "description_scale")
"""Signatures of the levels of light, which what a frame or its colours share scatters."""
DARK_LEVELS = ("black_level", "greens", "stated_read")
LIGHT_LEVELS = ("greens", "shading", *SCALES)
"""Signatures of levels, whose standard errors know pixel noise only: a pattern of lines or pixels scatters
channel means by more, so they are set aside once such a pattern is in the model. A shared offset is
part of the fitted read noise too, so a stated read noise is not judged beside it."""
OF_CODES = ("kurtosis", "light_tails", "pixel_spread", "skewness")
"""Of the shape of the noise of single pixels: where values that are moved from code to code leave a trace."""
SHAPES = (*OF_CODES, "telegraph")
"""Signatures of the shape of the noise of single pixels."""
HOT = ("hot_additive", "hot_thermal")
NOISY = (*SHAPES, *HOT)
"""Those that cannot be trusted once one of them is in the model."""
MAPS = ("pixel_additive_static", "pixel_thermal_static")
"""Signatures of maps of all pixels, which are judged once hot ones that stand out from them are gone."""
THERMAL_LINES = ("row_thermal_static", "column_thermal_static")
"""Signatures of charge that lines collect, which a glow along an edge is as well."""
GLOW, SMOOTH = ("glow",), ("smooth_additive", "smooth_thermal")
"""Signatures of light that falls off from a corner or edge, and of what is smooth: each takes the other."""
AREAS = ("tile_8_frozen", "tile_16_frozen", "tile_32_frozen", "tile_64_frozen")
"""Signatures of offsets of small areas."""
LINES = tuple(
    f"{axis}_{kind}_static" for axis in ("row", "column") for kind in ("additive", "relative", "thermal")
)
TURNS, WAVES = ("column_turns_additive", "column_turns_relative"), ("wave_frozen",)
"""Signatures of frozen lines, of those that turn from row to row, and of frozen interference."""
SCENES = ("reference_shift", "reference_blur", "reference_spread", "scene_static", "curvature", *SCALES)
"""Signatures of scenes against their references."""
SLOW = (*MAPS, "pixel_relative_static", "scene_static")
"""Signatures of what stays, which frames that remember the last one scatter by more than their number
says."""
BENT = "variance_curve"
"""How the variance grows with the light, which a converter that bends bends as well."""
CURVES = (BENT, "curvature_of_flats")
"""Signatures of that growth."""
BLENDS = ("lags_in_camera_denoising", "lags_in_camera_denoising_8")
SHARED = "lags_crosstalk"


def always(*signatures: Signature) -> Callable[[Recorded], tuple[Signature, ...]]:
    """These signatures, whatever was recorded."""
    return lambda recorded: signatures


def if_exposures_differ(*signatures: Signature) -> Callable[[Recorded], tuple[Signature, ...]]:
    """These signatures, those of what grows with the exposure only where recordings tell it from what does
    not."""
    fixed = tuple(s for s in signatures if s.axes.scales != "exposure")
    return lambda recorded: signatures if recorded.several_exposures else fixed


def wherever(
    before: Signature, of_codes: Signature, *growing: Signature
) -> Callable[[Recorded], tuple[Signature, ...]]:
    """The signatures of what comes before the gain, of the same behind it where several gains were recorded,
    and of what grows with the exposure where recordings tell it."""
    beside, grows = either_side(before, of_codes), if_exposures_differ(*growing)
    return lambda recorded: (*beside(recorded), *grows(recorded))


def either_side(
    signature: Signature, of_codes: Signature | None = None
) -> Callable[[Recorded], tuple[Signature, ...]]:
    """The signature of what comes before the gain, and, where several gains were recorded, of the same behind
    it. of_codes: the latter, of what stays."""
    other = of_codes or behind_gain.behind(signature)
    return lambda recorded: (signature, other) if recorded.several_gains else (signature,)
