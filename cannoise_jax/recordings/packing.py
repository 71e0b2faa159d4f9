"""Bayer mosaics to four half-size planes and back, in numpy and in JAX alike.

Packed channels are R, Gr, Gb, B, where Gr is the green beside red and Gb the green beside blue. Every Bayer
pattern becomes [[R, Gr], [Gb, B]] by flipping the rows or columns within each 2x2 cell, so packing is a
reshape and at most two flips, and is its own kind of inverse. A monochrome sensor packs its four positions
in mosaic order (0,0), (0,1), (1,0), (1,1).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Shaped

from cannoise_jax.recordings.recording import CFA_PATTERNS, PerChannel, in_one_line

PACKED_CHANNELS = ("R", "Gr", "Gb", "B")
SITES = tuple(np.s_[c // 2 :: 2, c % 2 :: 2] for c in range(4))
"""Rows and columns of each position in the 2x2 cells of a mosaic, in the order (0,0), (0,1), (1,0), (1,1)."""

ALL = 4
"""In place of a position: the pixels of all four together, of a sensor without colours."""

# Step of the rows and of the columns inside a cell that turns it into [[R, Gr], [Gb, B]].
_CELL_STEPS = {"RGGB": (1, 1), "GRBG": (1, -1), "GBRG": (-1, 1), "BGGR": (-1, -1), "MONO": (1, 1)}


def site(mosaic: Shaped[Any, "... H W"], channel: int) -> Shaped[Any, "... h w"]:
    """The pixels of one position in the cells of a mosaic, or of `ALL` of them: a view."""
    return mosaic if channel == ALL else mosaic[..., *SITES[channel]]


def green_sites(cfa: str) -> tuple[int, int] | None:
    """Mosaic sites (0 to 3) of the green beside red and of the green beside blue; None without colours.

    Raises ValueError for an unknown CFA.
    """
    _cell_steps(cfa)
    if cfa == "MONO":
        return None
    red = cfa.index("R")
    return red ^ 1, red ^ 2


def pack(mosaic: Shaped[Any, "... H W"], cfa: str) -> Shaped[Any, "... h w 4"]:
    """Mosaic `[..., H, W]` to packed `[..., H/2, W/2, 4]`, channels R, Gr, Gb, B (MONO: the four positions).

    Keeps the values, dtype and kind of array (numpy or JAX).
    Raises ValueError for an unknown CFA or odd sizes, TypeError for what is no array.
    """
    rows, columns = _cell_steps(cfa)
    *lead, height, width = _shape(mosaic, "pack", 2, "a mosaic [..., H, W]")
    if height % 2 or width % 2:
        raise ValueError(
            f"cannot pack {height} x {width} pixels: both sizes must be even; crop one row or column"
        )
    cells = mosaic.reshape(*lead, height // 2, 2, width // 2, 2)[..., ::rows, :, ::columns]
    return cells.swapaxes(-3, -2).reshape(*lead, height // 2, width // 2, 4)


def unpack(packed: Shaped[Any, "... h w 4"], cfa: str) -> Shaped[Any, "... H W"]:
    """The exact inverse of `pack`. Raises ValueError for an unknown CFA, fewer than three axes or a last one
    that is not 4, TypeError for what is no array."""
    rows, columns = _cell_steps(cfa)
    *lead, height, width, channels = _shape(packed, "unpack", 3, "packed pixels [..., H/2, W/2, 4]")
    if channels != 4:
        raise ValueError(f"packed images end in 4 channels, got {channels}")
    cells = packed.reshape(*lead, height, width, 2, 2).swapaxes(-3, -2)[..., ::rows, :, ::columns]
    return cells.reshape(*lead, 2 * height, 2 * width)


def _shape(array: Any, verb: str, least: int, expected: str) -> tuple[int, ...]:
    """The shape of an array of at least so many axes."""
    if not hasattr(array, "shape"):
        raise TypeError(f"cannot {verb} a {type(array).__name__}: expected {expected} as an array")
    if len(array.shape) < least:
        raise ValueError(f"cannot {verb} an array of shape {tuple(array.shape)}: expected {expected}")
    return tuple(array.shape)


def to_packed_order(values: PerChannel | Shaped[Any, "... 4"], cfa: str) -> Shaped[Any, "... 4"]:
    """Per-channel values from mosaic order to packed order R, Gr, Gb, B (a tuple comes back as an array)."""
    rows, columns = _cell_steps(cfa)
    values = np.asarray(values) if isinstance(values, (tuple, list)) else values
    return values.reshape(*values.shape[:-1], 2, 2)[..., ::rows, ::columns].reshape(values.shape)


def to_mosaic_order(values: PerChannel | Shaped[Any, "... 4"], cfa: str) -> Shaped[Any, "... 4"]:
    """Per-channel values from packed order to mosaic order: the same flips undo themselves."""
    return to_packed_order(values, cfa)


def to_shifted_cfa(cfa: str, rows: int, columns: int) -> str:
    """The colour order that starts `rows` and `columns` further into a mosaic; MONO and unknown ones stay."""
    if len(cfa) != 4 or cfa == "MONO":
        return cfa
    return "".join(cfa[2 * ((i + rows) % 2) + (j + columns) % 2] for i in (0, 1) for j in (0, 1))


def _cell_steps(cfa: str) -> tuple[int, int]:
    if not isinstance(cfa, str) or cfa not in _CELL_STEPS:
        raise ValueError(f"unknown CFA {in_one_line(cfa)}: use one of {', '.join(CFA_PATTERNS)}")
    return _CELL_STEPS[cfa]
