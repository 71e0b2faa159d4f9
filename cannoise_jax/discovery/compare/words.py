"""What the statistics are called in the table: names of lines, and which statistic shows one best."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from cannoise_jax.signatures.bank import MOMENTS, Scale

TEMPORAL, STATIC = "frame to frame", "fixed"
"""What is redrawn in every frame, and what stays."""
MOMENT_UNITS = ("of the variance", "skewness", "excess kurtosis")
OF_PIXELS, HOT, DARK = "fixed pattern of single pixels", "hot pixels", "dark pixels"
NOISIER, LINES_UNLIKE = "pixels noisier than the others", "noise unlike from line to line"
"""Lines that are of one kind of effect."""
_PLAIN = 1e6
"""Numbers from which on are written with an exponent."""
_NOTHING = 1e-4
"""Numbers below which are written as 0, where something else tells them apart."""
_MOST_DIGITS = 6
"""That tell two values apart: as many as the JSON has."""


def short(value: float) -> str:
    """Three digits; an exponent only where the number would be long."""
    return digits(value, 3)


def digits(value: float, count: int, sign: str = "") -> str:
    """So many digits; an exponent only where the number would be long. sign: '+' says that of all numbers."""
    rounded = float(f"{value:.{count}g}")
    if 10**count <= abs(rounded) < _PLAIN:
        return f"{rounded:{sign},.0f}"
    return f"{value:{sign},.{count}g}"


def pair(first: float, second: float) -> tuple[str, str]:
    """Two values of one quantity: three digits, or as many as tell them apart; what is next to nothing is 0
    beside what is not."""
    tiny = max(abs(first), abs(second)) < _NOTHING
    said = [short(v) if tiny or abs(v) >= _NOTHING else "0" for v in (first, second)]
    return _told_apart(said, (first, second))


def ends(low: float, high: float) -> tuple[str, str]:
    """The ends of an interval: three digits, or as many as tell them apart."""
    return _told_apart([short(low), short(high)], (low, high))


def is_wide(low: float | None, high: float | None) -> bool:
    """Whether an interval has a width that its digits can show: where nothing scattered it has none."""
    return low is not None and high is not None and ends(low, high)[0] != ends(low, high)[1]


def _told_apart(said: list[str], values: tuple[float, float]) -> tuple[str, str]:
    count = 4
    while said[0] == said[1] and count <= _MOST_DIGITS:
        said = [digits(v, count) for v in values]
        count += 1
    return (said[0], said[1]) if said[0] != said[1] else (short(values[0]), short(values[1]))


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
        name = "noise" if time != STATIC else "fixed pattern"
        alone = OF_PIXELS if time == STATIC else "noise of a pixel"
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


def tail(limit: float) -> tuple[str, str]:
    """Values beyond so many standard deviations."""
    return "heavy tails", f"values {'below' if limit < 0 else 'above'} {limit:+.1f} sigma"


def unsteady(chance: float, above: bool) -> tuple[str, str]:
    """Pixels whose mean square lies beyond a chance."""
    if above:
        return NOISIER, f"beyond a chance of {chance:g}"
    return "pixels quieter than the others", f"below a chance of {chance:g}"


def jump(limit: float, outlying: bool) -> tuple[str, str]:
    """Values that lie so many standard deviations off, of pixels that are else like the others."""
    what = "pixels that are off in one frame only" if outlying else "heavy tails"
    return what, f"{limit:+g} sigma in one frame"


def levels(index: int) -> tuple[str, str]:
    """Unsteady pixels, by what two levels leave of them."""
    return "how pixels jump", "two levels are enough" if index < 3 else "two levels are not enough"


def standing_out(limit: float) -> tuple[str, str]:
    """Pixels beyond so many standard deviations of the mean of the frames."""
    return HOT if limit > 0 else DARK, f"{abs(limit):g} sigma of the mean and more"


def rails(index: int) -> tuple[str, str]:
    """Pixels at either end of the codes."""
    return "clipped values", ("at code 0", "at the white level")[index]


def code(index: int, modulo: Sequence[int]) -> tuple[str, str]:
    """One residue of the stored codes, counted through all residues of every modulus."""
    for m in modulo:
        if index < m:
            break
        index -= m
    return "unevenly filled codes", f"codes {index} modulo {m}"


def memory(down: int, across: int) -> tuple[str, str]:
    """Products of a frame and the next one, so many rows and columns apart."""
    return "memory of the frame before", f"{down} down, {across:+d} across"


def line_memory(rows: bool, lag: int) -> tuple[str, str]:
    """Products of the lines of a frame and of the next one."""
    what = "rows" if rows else "columns"
    return f"{what} that remember the frame before", f"{lag:+d} {what}"


def line_noise(index: int) -> tuple[str, str]:
    """Noise of the pixels of lines, one line against the others."""
    return LINES_UNLIKE, ("rows", "columns")[index]


def smooth(name: str) -> tuple[str, str]:
    """A smooth part of the fixed map."""
    return "smooth fixed pattern", place(name)


def shared(index: int) -> tuple[str, str]:
    """Fixed maps of two recordings, one against the other."""
    return "fixed pattern shared by recordings", ("pixel by pixel", "row means", "column means")[index]


def frequency(y: float, x: float) -> str:
    """A spatial frequency in words."""
    if x < 1e-9:
        return f"period of {1 / abs(y):.1f} rows" if y else ""
    if abs(y) < 1e-9:
        return f"period of {1 / x:.2f} columns"
    if abs(x - 0.5) < 1e-9:
        return f"period of {1 / abs(y):.1f} rows in odd against even columns"
    return f"period of {1 / (x * x + y * y) ** 0.5:.2f} pixels, slanting"
