"""Bayer-preserving augmentation: crops at even offsets, and mirrored windows that keep the colour order.

Mirroring a mosaic swaps its columns' colours. A window that starts at an odd column and is then mirrored has
the colour order of the original again (Liu et al. 2019, BayerUnifyAug: flip, then crop one pixel), for every
CFA: the same window in packed form needs one packed column more than it returns.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Shaped

from cannoise_jax.recordings.packing import pack, unpack


def mirror_mosaic(mosaic: Shaped[Any, "... H W"]) -> Shaped[Any, "... H W-2"]:
    """A horizontally mirrored mosaic of the same CFA: one column is lost on each side (even widths)."""
    return mosaic[..., 1:-1][..., ::-1]


def mirror_packed(packed: Shaped[Any, "... h w 4"], cfa: str) -> Shaped[Any, "... h w-1 4"]:
    """`mirror_mosaic` for packed images: channels stay R, Gr, Gb, B; one packed column is lost.

    Which channels lose their first column and which their last depends on where the CFA puts them.
    """
    return pack(mirror_mosaic(unpack(packed, cfa)), cfa)


def crop_packed(
    packed: Shaped[Any, "... h w 4"], top: int, left: int, size: tuple[int, int], mirrored: bool, cfa: str
) -> Shaped[Any, "... a b 4"]:
    """A window of packed `size` at (top, left), as it stands or mirrored with the one-pixel shift.

    A packed offset is an even mosaic offset. A mirrored window uses the columns left to left + size[1],
    inclusive: one more than it returns. Raises ValueError when the window leaves the image.
    """
    height, width = size
    taken = width + 1 if mirrored else width
    if min(top, left) < 0 or top + height > packed.shape[-3] or left + taken > packed.shape[-2]:
        raise ValueError(
            f"window {height} x {taken} at ({top}, {left}) leaves the image {packed.shape[-3:-1]}"
        )
    window = packed[..., top : top + height, left : left + taken, :]
    return mirror_packed(window, cfa) if mirrored else window
