"""Structures that no mechanism of the package explains, at places of the grammar where cameras may have them.

What is found here is reported as unknown, with its place.
"""

from __future__ import annotations

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.signature import Signature

TILES = ("tile_8", "tile_16", "tile_32", "tile_64", "diagonal", "antidiagonal")
SITES = ("site", "row_parity", "column_parity")
"""What stays per site of the mosaic is the black level's."""
_CUT = (*looks.AREAS, *looks.THERMAL_LINES, "diagonal_frozen", "antidiagonal_frozen")
"""What a smooth pattern would be cut into."""
_FOLDED = (*looks.LINES, *looks.TURNS, *looks.WAVES, *looks.MAPS, *_CUT)
"""What a pattern that repeats every few rows and columns would be cut into."""

_ALWAYS: tuple[Signature, ...] = (
    *(
        looks.lines.redrawn(axis, "signal", name=f"{axis}_relative_temporal", covers=looks.LIGHT_LEVELS)
        for axis in ("row", "column")
    ),
    looks.line_maps.frozen("row", "signal", name="row_relative_static", covers=looks.LIGHT_LEVELS),
    *(
        looks.groups.shared(f"{layout}_{time}", layout, time, covers=looks.DARK_LEVELS)
        for layout in (*TILES, *SITES)
        for time in ("redrawn", "frozen")
        if time == "redrawn" or layout in TILES
    ),
    # A lamp that drifts in colour.
    looks.groups.shared("site_relative_redrawn", "site", "redrawn", scaling="signal", covers=looks.SCALES),
    # A scene whose rows follow their own light by another factor than the pixels within them.
    looks.smear.streaked(name="row_light", covers=looks.SCALES),
    # A glow, a leak of light or a lamp that swells and fades: the same places in every frame.
    looks.modulated.swelling(name="modulated_additive", scaling="additive", covers=looks.COVERS_NOTHING),
    looks.modulated.swelling(name="modulated_relative", scaling="signal", covers=looks.COVERS_NOTHING),
    # Light that leaks into darks, and gradients of any shape.
    looks.smooth_maps.staying(name="smooth_additive", scaling="additive", covers=looks.GLOW, before=_CUT),
    # Converters, multiplexers and corrections that work through small tiles.
    looks.repeats.staying(name="repeating", covers=looks.DARK_LEVELS, before=_FOLDED),
    looks.moved_tiles.moving(
        name="repeating_redrawn",
        covers=looks.DARK_LEVELS,
        before=(*imprints.WAVES, *imprints.IN_FRAMES, *_FOLDED, "repeating"),
    ),  # fmt: skip
    # A start that the first frames still show, an image that lags, offsets that wander.
    looks.in_time.kept(name="kept_in_time", covered_by=("warm",), covers=looks.COVERS_NOTHING),
    # Half covered to find the focus, under another filter, or damaged.
    looks.other_response.other(
        name="other_response", covers=looks.COVERS_NOTHING, lifted_by=imprints.NO_RESPONSE
    ),
    looks.covariance.any_lag("white", name="lags_any", covers=imprints.BLENDS),
    looks.covariance.any_lag("read", name="lags_read", covers=imprints.BLENDS),
    looks.shape.tails(name="light_tails", heavy=False, covers=looks.NOISY),
    looks.shape.skewed(name="skewness"),
)
_GROWING = looks.if_exposures_differ(
    *(
        looks.line_maps.frozen(axis, "exposure", name=f"{axis}_thermal_static", covers=looks.COVERS_NOTHING)
        for axis in ("row", "column")
    ),
    looks.smooth_maps.staying(name="smooth_thermal", scaling="exposure", covers=looks.GLOW, before=_CUT),
    looks.modulated.swelling(name="modulated_thermal", scaling="exposure", covers=looks.COVERS_NOTHING),
)


def signatures(recorded: Recorded) -> tuple[Signature, ...]:
    """Those that the recordings can be searched for."""
    return (
        *_ALWAYS,
        *_GROWING(recorded),
        looks.curve.bent(recorded, name=looks.BENT, covers=(looks.BENT,)),
        *looks.site_light.apart(recorded, name="sites_apart", covers=looks.COVERS_NOTHING),
    )
