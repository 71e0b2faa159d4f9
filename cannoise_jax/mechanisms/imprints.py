"""Signatures whose statistic an effect moves beside its own, by the effect: where both reject, what they gain
counts for it, so that it is judged before what it imprints. What each effect moves was seen in simulations;
it follows from no rule: each list parts some that read the same and sit at the same place in the grammar."""

from __future__ import annotations

from cannoise_jax.mechanisms.looks import CURVES

_TAILS = ("light_tails", "kurtosis")
_SHAPE = (*_TAILS, "skewness")
_BLINKS = ("pixel_spread", "telegraph")
_HOT = ("hot_additive", "hot_thermal")
_IN_CAMERA = ("lags_in_camera_denoising", "lags_in_camera_denoising_8")
_ANY_LAG = ("lags_any", "lags_read")
BLENDS = (*_IN_CAMERA, "lags_demosaicing")
"""Correlations of the noise of darks as well as of light, by their proportions."""
_LAGS = (*BLENDS, *_ANY_LAG, "lags_crosstalk")

_TILES = ("tile_8", "tile_16", "tile_32", "tile_64")
_DIAGONALS = ("diagonal", "antidiagonal")
_TILES_REDRAWN = tuple(f"{name}_redrawn" for name in _TILES)
_DIAGONALS_REDRAWN = tuple(f"{name}_redrawn" for name in _DIAGONALS)
_SITES_REDRAWN = ("site_redrawn", "row_parity_redrawn", "column_parity_redrawn")
_OFFSETS_OF_LINES = ("row_additive_temporal", "column_additive_temporal")
_FACTORS_OF_LINES = ("row_relative_temporal", "column_relative_temporal")
_SLOPES = ("raster_slope", "row_slope")
ROWS_AND_COLUMNS = (*_OFFSETS_OF_LINES, *_SLOPES)
"""Laws of many frequencies of what whole rows and columns share in each frame."""
_FRAMES = ("frame_additive", "frame_relative")
_LINES_THAT_STAY = tuple(
    f"{axis}_{law}_static" for axis in ("row", "column") for law in ("additive", "relative")
)
_PIXELS_THAT_STAY = ("pixel_additive_static", "pixel_relative_static")
_EDGES = ("reference_shift", "reference_blur", "reference_spread")
_SCENES = (*_EDGES, "reference_scale", "scene_static", "curvature")
_LEVELS = ("black_channels", "dark_level")

IN_FRAMES = (
    *(*_TILES_REDRAWN, *_DIAGONALS_REDRAWN, *_SITES_REDRAWN, "wave_redrawn", "site_relative_redrawn"),
    *(*_OFFSETS_OF_LINES, *_FACTORS_OF_LINES, *_FRAMES, *_SLOPES, "flicker"),
    *(*_LAGS, "lags_brighter_fatter", *CURVES),
)
"""What a few far pixels of single frames imprint on: sums over places and products of neighbours."""
WAVES = (
    *(name for name in IN_FRAMES if not name.startswith(("wave", "flicker"))),
    *(*_SHAPE, *_BLINKS, "warm", "row_turns_temporal", "modulated_additive", "modulated_relative"),
)
"""What a wave of a new phase in every frame imprints on: as `IN_FRAMES`, and the spread of pixels. Not
flicker, which is a wave of the light itself."""
STANDING_OUT = (
    *(f"{name}_frozen" for name in (*_TILES, *_DIAGONALS, "wave")),
    *(*_LINES_THAT_STAY, "row_thermal_static", "column_thermal_static"),
    *(*_PIXELS_THAT_STAY, "pixel_thermal_static", "step", "taps"),
)
"""What a few far pixels of the means of darks imprint on: what areas, lines and pixels share."""
IN_MEANS = (
    *(*STANDING_OUT, *_SCENES, "description_scale"),
    *("glow", "shading", "greens", *_LEVELS, *_HOT),
)
"""What a few far pixels of the means imprint on."""

HITS = (*_SHAPE, *_BLINKS, *IN_FRAMES, *IN_MEANS)
NO_RESPONSE = (*_SHAPE, *CURVES, *IN_MEANS)
CORRECTED = (*_SHAPE, *_BLINKS, *_IN_CAMERA, *_ANY_LAG, "lags_crosstalk")
PEAKS = (*_SHAPE, "pixel_spread", *_IN_CAMERA, *_ANY_LAG, "black_channels", "black_level", *CURVES)
"""What a clamp imprints on. It lowers the levels of all darks by a share of their noise, and makes none rise
with the exposure: the dark level is asked for beside it."""
LAG = (
    *(*_FRAMES, *_FACTORS_OF_LINES, *_SLOPES, *_TILES_REDRAWN, "site_relative_redrawn", "flicker"),
    *("reference_scale", "description_scale", "reference_blur", "reference_spread", "scene_static"),
    *(*_SHAPE, *CURVES),
)
STEP = (*_SCENES, "description_scale", "pixel_relative_static", "saturation", "skewness", *CURVES)
SPACING = ("comb", "coarse", "skewness", "light_tails", *CURVES)
EXCESS = ("skewness", "kurtosis", *CURVES)
LATTICE = (
    *(*_LAGS, "lags_brighter_fatter", *_SHAPE, *_BLINKS, *CURVES),
    *("corrected", "peaks", "excess_skewness", "comb", "raster_slope"),
    *(*_OFFSETS_OF_LINES, *_DIAGONALS_REDRAWN, "tile_8_redrawn", "wave_redrawn"),
    *("reference_blur", "reference_spread", "scene_static", "pixel_relative_static", "curvature"),
)
MOTION = (
    *(*_SCENES, *_LAGS, *_TAILS, *_BLINKS, *CURVES, "lag_in_time", "flicker", *_FRAMES, *_SLOPES),
    *(*_OFFSETS_OF_LINES, *_FACTORS_OF_LINES, *_TILES_REDRAWN, *_DIAGONALS_REDRAWN, "wave_redrawn"),
)
SMEAR = (*_LINES_THAT_STAY, *_PIXELS_THAT_STAY, *_SCENES, "description_scale")
WARM = (
    *("frame_additive", "dark_level", "kurtosis", *_BLINKS, "hot_thermal", "pixel_thermal_static"),
    *(*_SITES_REDRAWN, *_TILES_REDRAWN, *_DIAGONALS_REDRAWN, *_OFFSETS_OF_LINES, *_SLOPES),
)
TAILS = (*(*HITS, *PEAKS, *CORRECTED, "hits", "dead", "corrected", "clocking", *_SCENES),)
