"""What the statistics are called in the table."""

from __future__ import annotations

from collections.abc import Callable

from cannoise_jax.discovery.compare.measure import STANDING, TAILS, UNSTEADY
from cannoise_jax.discovery.compare.view import RESIDUES
from cannoise_jax.signatures.bank import MOMENTS, Scale

MOMENT_UNITS = ("of the variance", "skewness", "excess kurtosis")
PER_FRAME = ("tails", "pixels: one frame only", "one frame only", "rails", "codes")


def structure(band: int, row: Scale, column: Scale, size: tuple[int, int]) -> str | None:
    """What one energy is: rows, parts of rows, columns, blocks, large areas, whole frames."""
    odd_columns, odd_rows = band in (1, 3), band in (2, 3)
    if row.whole and column.whole:
        return "offset of whole frames" if band == 0 else "offsets of the mosaic's sites"
    if column.whole:
        return "rows of odd against even columns" if odd_columns else "rows"
    if row.whole:
        return "columns of odd against even rows" if odd_rows else "columns"
    wide, tall = column.length >= size[1] / 8, row.length >= size[0] / 8
    if wide and tall:
        return "large areas" if band == 0 else "large areas, unlike between the mosaic's sites"
    if wide and row.length <= 8:
        return "parts of rows"
    if tall and column.length <= 8:
        return "parts of columns"
    return "blocks"


def block(row: Scale, column: Scale) -> str:
    """The shape in which an energy is strongest."""
    tall = "whole columns" if row.whole else f"{row.length} rows"
    wide = "whole rows" if column.whole else f"{column.length} columns"
    if row.whole and column.whole:
        return "the frame as a whole"
    return f"strongest by {tall} x {wide}"


def moments(order: int, time: str) -> list[tuple[str, Callable[[int], bool]]]:
    """Lines of the moments of one order, and which places of `bank.MOMENTS` they take in."""
    smooth = len(MOMENTS) - 3
    if order == 0:
        name = "noise" if time != "fixed" else "fixed pattern"
        alone = "fixed pattern of single pixels" if time == "fixed" else "noise of a pixel"
        return [
            (alone, lambda k: k == 0),
            (f"{name} uneven over the frame", lambda k: 0 < k < smooth),
            (f"{name} unlike between the mosaic's sites", lambda k: k >= smooth),
        ]
    return [(("skewness", "heavy tails")[order - 1], lambda k: True)]


def place(name: str) -> str:
    """Where a moment lies, in words."""
    if "," not in name:
        return name
    y, x = name.split(",")
    words = {"1": "a gradient", "2": "centre against edges"}
    parts = [f"{words[k]} {way}" for k, way in ((y, "down"), (x, "across")) if k in words]
    return " and ".join(parts)


def simple(family: str, index: int) -> tuple[str, str]:
    """Name of a count or mean, and what the statistic at this index is."""
    if family == "tails":
        limit = TAILS[index]
        side = "below" if limit < 0 else "above"
        return "heavy tails", f"values {side} {limit:+.1f} sigma"
    if family == "unsteady":
        if index < len(UNSTEADY):
            return "pixels noisier than the others", f"beyond a chance of {UNSTEADY[index]:g}"
        return "pixels quieter than the others", "below a chance of " + ("0.01", "0.001")[
            index - len(UNSTEADY)
        ]
    if family == "one frame only":
        return "pixels that are off in one frame only", "six sigma and more"
    if family == "standing out":
        limit = STANDING[index]
        name = "hot pixels" if limit > 0 else "dark pixels"
        return name, f"{abs(limit):g} sigma of the mean and more"
    if family == "rails":
        return "clipped values", ("at code 0", "at the white level")[index]
    if family == "codes":
        for m in RESIDUES:
            if index < m:
                return "unevenly filled codes", f"codes {index} modulo {m}"
            index -= m
    if family == "products":
        return "memory of the frame before", f"{index // 5} down, {index % 5 - 2:+d} across"
    if family == "smooth maps":
        return "smooth fixed pattern", place(MOMENTS[index + 1])
    if family == "shared with another recording":
        return "fixed pattern shared by recordings", ("pixel by pixel", "row means", "column means")[index]
    return family, ""


def time(family: str) -> str:
    """Whether a family is of what stays or of what is redrawn."""
    fixed = ("fixed", "pixels: standing out", "shared with another recording")
    return "fixed" if family.startswith(fixed) else "frame to frame"


def frequency(y: float, x: float) -> str:
    """A spatial frequency in words."""
    if x < 1e-9:
        return f"period of {1 / abs(y):.1f} rows" if y else ""
    if abs(y) < 1e-9:
        return f"period of {1 / x:.2f} columns"
    if abs(x - 0.5) < 1e-9:
        return f"period of {1 / abs(y):.1f} rows in odd against even columns"
    return f"period of {1 / (x * x + y * y) ** 0.5:.2f} pixels, slanting"
