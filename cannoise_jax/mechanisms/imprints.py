"""Signatures whose statistic an effect moves beside its own, by the effect: where both reject, what they gain
counts for it, so that it is judged before what it imprints."""

from __future__ import annotations

_PLACES = ("tile_8", "tile_16", "tile_32", "tile_64", "diagonal", "antidiagonal", "site", "row_parity")
_PLACES_THAT_STAY = ("tile_8", "tile_16", "tile_32", "tile_64", "diagonal", "antidiagonal")
_LINES = tuple(f"{axis}_{law}" for axis in ("row", "column") for law in ("additive", "relative"))
_TEMPLATES = ("crosstalk", "brighter_fatter", "in_camera_denoising", "in_camera_denoising_8", "demosaicing")
BLENDS = ("lags_in_camera_denoising", "lags_in_camera_denoising_8", "lags_demosaicing")
"""Correlations of the noise of darks as well as of light, by their proportions."""
IN_FRAMES = (
    *(f"{name}_redrawn" for name in (*_PLACES, "column_parity", "wave", "site_relative")),
    *(f"{name}_temporal" for name in _LINES),
    *(f"lags_{name}" for name in (*_TEMPLATES, "any", "read")),
    *("frame_additive", "frame_relative", "raster_slope", "row_slope", "flicker", "variance_curve"),
)
"""What a few far pixels of single frames imprint on: sums over places and products of neighbours."""
IN_MEANS = (
    *(f"{name}_frozen" for name in (*_PLACES_THAT_STAY, "wave")),
    *(f"{name}_static" for name in (*_LINES, "pixel_additive", "pixel_relative", "pixel_thermal", "scene")),
    *("step", "taps", "glow", "shading", "greens", "black_channels", "dark_level", "curvature"),
    *(f"reference_{name}" for name in ("scale", "shift", "blur", "spread")),
    *("description_scale", "hot_additive", "hot_thermal"),
)
"""What a few far pixels of the means imprint on."""


SPIKES = ("telegraph", "kurtosis", "skewness", "hot_additive", "hot_thermal", "pixel_spread", "light_tails")
DEAD = (
    "pixel_relative_static",
    "pixel_additive_static",
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "reference_scale",
    "description_scale",
    "scene_static",
    "curvature",
    "skewness",
    "kurtosis",
    "light_tails",
    "variance_curve",
)
CORRECTED = (
    "light_tails",
    "kurtosis",
    "pixel_spread",
    "telegraph",
    "lags_any",
    "lags_read",
    "lags_in_camera_denoising",
    "lags_in_camera_denoising_8",
    "lags_crosstalk",
    "skewness",
)
PEAKS = (
    "light_tails",
    "kurtosis",
    "skewness",
    "lags_any",
    "lags_read",
    "lags_in_camera_denoising",
    "pixel_spread",
    "lags_in_camera_denoising_8",
    "dark_level",
    "black_channels",
    "black_level",
    "variance_curve",
)
LAG = (
    "frame_relative",
    "site_relative_redrawn",
    "row_relative_temporal",
    "column_relative_temporal",
    "reference_scale",
    "description_scale",
    "scene_static",
    "variance_curve",
    "skewness",
    "flicker",
    "tile_8_redrawn",
    "tile_16_redrawn",
    "tile_32_redrawn",
    "tile_64_redrawn",
    "frame_additive",
    "raster_slope",
    "row_slope",
    "reference_blur",
    "reference_spread",
    "light_tails",
    "kurtosis",
)
STEP = (
    "variance_curve",
    "saturation",
    "curvature",
    "skewness",
    "reference_scale",
    "description_scale",
    "reference_blur",
    "reference_spread",
    "reference_shift",
    "scene_static",
    "pixel_relative_static",
)
SPACING = ("comb", "coarse", "variance_curve", "skewness", "light_tails")
EXCESS = ("skewness", "kurtosis", "variance_curve")
LATTICE = (
    "lags_in_camera_denoising",
    "lags_in_camera_denoising_8",
    "lags_any",
    "lags_read",
    "lags_demosaicing",
    "lags_crosstalk",
    "pixel_spread",
    "light_tails",
    "kurtosis",
    "corrected",
    "skewness",
    "variance_curve",
    "telegraph",
    "lags_brighter_fatter",
    "reference_blur",
    "reference_spread",
    "column_additive_temporal",
    "peaks",
    "row_additive_temporal",
    "diagonal_redrawn",
    "antidiagonal_redrawn",
    "tile_8_redrawn",
    "wave_redrawn",
    "excess_skewness",
    "comb",
    "raster_slope",
    "scene_static",
    "pixel_relative_static",
    "curvature",
)
MOTION = (
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "reference_scale",
    "scene_static",
    "telegraph",
    "tile_8_redrawn",
    "tile_16_redrawn",
    "tile_32_redrawn",
    "tile_64_redrawn",
    "lag_in_time",
    "kurtosis",
    "row_relative_temporal",
    "column_relative_temporal",
    "row_additive_temporal",
    "flicker",
    "curvature",
    "column_additive_temporal",
    "diagonal_redrawn",
    "antidiagonal_redrawn",
    "raster_slope",
    "row_slope",
    "lags_any",
    "lags_read",
    "lags_in_camera_denoising",
    "lags_in_camera_denoising_8",
    "lags_crosstalk",
    "variance_curve",
    "lags_demosaicing",
    "frame_relative",
    "frame_additive",
    "pixel_spread",
    "wave_redrawn",
    "light_tails",
)
SMEAR = (
    "column_additive_static",
    "column_relative_static",
    "scene_static",
    "reference_scale",
    "reference_shift",
    "reference_blur",
    "reference_spread",
    "description_scale",
    "curvature",
    "pixel_additive_static",
    "pixel_relative_static",
    "row_additive_static",
    "row_relative_static",
)
WARM = (
    "frame_additive",
    "site_redrawn",
    "tile_64_redrawn",
    "tile_32_redrawn",
    "tile_16_redrawn",
    "tile_8_redrawn",
    "row_slope",
    "raster_slope",
    "kurtosis",
    "telegraph",
    "row_parity_redrawn",
    "column_parity_redrawn",
    "diagonal_redrawn",
    "antidiagonal_redrawn",
    "dark_level",
    "pixel_spread",
    "hot_thermal",
    "pixel_thermal_static",
    "row_additive_temporal",
    "column_additive_temporal",
)
HITS = tuple(dict.fromkeys((*SPIKES, *IN_FRAMES, *IN_MEANS)))
NO_RESPONSE = tuple(dict.fromkeys((*DEAD, *IN_MEANS)))
