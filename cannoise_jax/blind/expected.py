"""What a right answer says of each effect: the family of its signature, where it shows, how it behaves.

Families are the catalogue's signature spaces. Axes are those that reports use in `where` and in the card of
an unknown structure; several are right where a pattern can be seen either way.
"""

from __future__ import annotations

from typing import NamedTuple


class Expected(NamedTuple):
    """family: mean, variance, covariance or shape; axes of `where`; of the card: axes, times, scalings."""

    family: str
    axes: frozenset[str]
    card_axes: frozenset[str]
    time: str
    scales: frozenset[str]


def _of(family: str, axes: str, time: str, scales: str, card_axes: str = "") -> Expected:
    return Expected(
        family,
        frozenset(axes.split()),
        frozenset((card_axes or axes).split()),
        time,
        frozenset(scales.split()),
    )


EXPECTED: dict[str, Expected] = {
    "prnu": _of("mean", "pixel", "frozen", "signal"),
    "dsnu": _of("mean", "pixel", "frozen", "additive"),
    "column_gain": _of("mean", "column", "frozen", "signal"),
    "nonlinearity": _of("mean", "signal", "frozen", "signal"),
    "crosstalk": _of("covariance", "pixel", "redrawn", "signal"),
    "amp_glow": _of("mean", "edge block", "frozen", "exposure", "edge block pixel"),
    "hot_pixels": _of("mean", "pixel", "frozen", "exposure additive"),
    "heavy_tails": _of("shape", "pixel", "redrawn", "additive"),
    "pixel_read_noise_map": _of("variance", "pixel", "frozen redrawn", "additive"),
    "row_noise": _of("covariance", "row", "redrawn", "additive"),
    "column_noise": _of("covariance", "column", "redrawn", "additive"),
    "row_fpn": _of("mean", "row", "frozen", "additive"),
    "column_fpn": _of("mean", "column", "frozen", "additive"),
    "pink_noise": _of("covariance", "frequency pixel", "redrawn", "additive", "pixel raster frequency"),
    "row_pink_noise": _of("covariance", "row frequency", "redrawn", "additive"),
    "banding": _of("covariance", "frequency", "redrawn", "additive", "frequency raster row pixel"),
    "offset_drift": _of("mean", "frame", "redrawn", "additive"),
    "amplifier_mismatch": _of(
        "mean", "edge block column", "frozen", "additive", "amplifier edge block column"
    ),
    "green_imbalance": _of("mean", "channel", "frozen", "signal"),
    "in_camera_denoising": _of("covariance", "pixel", "redrawn", "additive signal"),
    "rts": _of("variance", "pixel", "telegraph redrawn", "additive"),
    "dark_current": _of("mean", "frame signal channel", "frozen", "exposure"),
    "channel_offset": _of("mean", "channel", "frozen", "additive"),
    "flicker": _of("covariance", "frequency row", "redrawn", "signal"),
    "illumination_drift": _of("mean", "frame", "redrawn", "signal"),
    "lens_shading": _of("mean", "pixel block edge", "frozen", "signal"),
    # Of no listed family:
    "tile_noise": _of("covariance", "block", "redrawn", "additive"),
    "row_gain_noise": _of("covariance", "row", "redrawn", "signal"),
    "diagonal_noise": _of("covariance", "diagonal pixel frequency", "redrawn", "additive"),
    "parity_jitter": _of("covariance", "column channel frequency", "redrawn", "additive"),
    "column_breathing": _of("covariance", "column", "redrawn", "signal"),
}


def card_right(mechanism: str, card: dict) -> dict[str, bool]:
    """Which parts of an unknown structure's card are right: axis, behaviour in time, scaling."""
    axes = card.get("axes") or {}
    told = EXPECTED[mechanism]
    words = set(str(axes.get("varies_over", "")).replace("_", " ").split())
    return {
        "axis": bool(words & told.card_axes),
        "time": str(axes.get("time", "")) in told.time.split(),
        "scaling": bool(set(str(axes.get("scales", "")).split()) & told.scales),
    }


def place_right(where: dict, mechanism: str, facts: dict) -> dict[str, bool]:
    """Which parts of a finding's `where` are right: axis, period (within 5 %), first column (within 2)."""
    out = {"axis": where.get("axis") in EXPECTED[mechanism].axes}
    period = where.get("period_px")
    if facts.get("period_px") and period:
        out["period"] = abs(period / facts["period_px"] - 1) < 0.05
    if facts.get("columns") and where.get("axis") == "column" and where.get("index"):
        out["place"] = abs(where["index"][0] - facts["columns"][0]) <= 2
    return out
