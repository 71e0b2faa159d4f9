"""The places that the numbers of a mechanism, or a finding, belong to: one record of each, which the grammar
draws by, the proofs cut frames by, and the reports put into words.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, get_args

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Site = Literal["pixel", "row", "column", "block", "channel", "raster", "diagonal", "antidiagonal", "frame"]
"""Places that carry one number each: `Place.sites`."""
PlaceName = Site | Literal["amplifier", "signal", "frequency", "code", "edge"]
Size = tuple[int, int]


def NOT_DRAWN(of: object, size: Size) -> Any:
    """Of a place that carries no numbers of the grammar."""
    raise ValueError("the grammar draws nothing at this place")


def NO_LINE(step: int, width: int) -> Any:
    """Of a place whose numbers do not follow each other."""
    raise ValueError("the numbers of this place follow no line")


class Place(NamedTuple):
    """A kind of place.

    over: words of what varies over it; at: of a finding there. says: what a report states of such a finding.
    within_rows: whether it varies within a row and is not one number of all rows, so that bands of rows tell
    of it apart. whole: whether one number of it reaches over the whole frame.
    sites(size, blocks) -> shape of its numbers in a frame of that size; spread(numbers `[T, sites...]`, size)
    -> in a shape that broadcasts against `[T, H, W]`. lag(step, width) -> pixels (dy, dx) from one number to
    a later one. NOT_DRAWN: the grammar draws none of it; NO_LINE: its numbers follow none. steps(width) ->
    those whose lags are reported. alike: lags (dy, dx) at which pixels may share a number; of whole rows,
    columns and frames effects say that in one number.
    """

    over: str
    at: str
    says: tuple[str, ...] = ()
    within_rows: bool = False
    whole: bool = False
    sites: Callable[[Size, Size], tuple[int, ...]] = NOT_DRAWN
    spread: Callable[[Array, Size], Array] = NOT_DRAWN
    lag: Callable[[int, int], tuple[int, int]] = NO_LINE
    steps: Callable[[int], tuple[int, ...]] = lambda width: (1, 2)
    alike: tuple[tuple[int, int], ...] = ()


NEAR = ((0, 1), (0, 2), (1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2))
"""Lags up to two, right and down."""


def _lines(shape: tuple[int, int]) -> Callable[[Array, Size], Array]:
    return lambda drawn, size: drawn.reshape(drawn.shape[0], *shape)


def _whole(drawn: Float[Array, "t ..."], size: Size) -> Float[Array, "t h w"]:
    return drawn.reshape(drawn.shape[0], *size)


def _diagonals(against: bool) -> Callable[[Array, Size], Array]:
    def spread(drawn: Float[Array, "t n"], size: Size) -> Float[Array, "t h w"]:
        y, x = np.indices(size)
        return drawn[:, y + x if against else y - x + size[1] - 1]

    return spread


def _mosaic(drawn: Float[Array, "t 2 2"], size: Size) -> Float[Array, "t h w"]:
    i, j = (jnp.arange(n) % 2 for n in size)
    return drawn[:, i[:, None], j[None, :]]


def _blocks(drawn: Float[Array, "t m n"], size: Size) -> Float[Array, "t h w"]:
    i, j = (jnp.arange(n) * count // n for n, count in zip(size, drawn.shape[1:], strict=True))
    return drawn[:, i[:, None], j[None, :]]


PLACES: dict[str, Place] = {
    "row": Place(
        "from row to row", "from row to row", ("index",),
        sites=lambda size, blocks: size[:1], spread=_lines((-1, 1)), lag=lambda step, width: (step, 0),
    ),
    "column": Place(
        "from column to column", "from column to column", ("index",),
        sites=lambda size, blocks: size[1:], spread=_lines((1, -1)), lag=lambda step, width: (0, step),
    ),
    "pixel": Place(
        "from pixel to pixel", "pixel by pixel", ("index",), within_rows=True,
        sites=lambda size, blocks: size, spread=_whole,
    ),
    "channel": Place(
        "between sites of the mosaic", "between the four sites of the mosaic", ("channel",),
        within_rows=True, whole=True, sites=lambda size, blocks: (2, 2), spread=_mosaic, alike=NEAR,
    ),
    "block": Place(
        "between regions of the frame", "between regions of the frame", ("bbox",), within_rows=True,
        sites=lambda size, blocks: blocks, spread=_blocks, alike=NEAR,
    ),
    "amplifier": Place("between amplifiers", "between amplifiers", within_rows=True),
    "frame": Place(
        "over whole frames", "from frame to frame", ("index",), whole=True,
        sites=lambda size, blocks: (), spread=_lines((1, 1)),
    ),
    "raster": Place(
        "along the readout", "along the readout",
        sites=lambda size, blocks: (math.prod(size),), spread=_whole, lag=divmod,
        steps=lambda width: (1, 2, width, 2 * width),
    ),
    "diagonal": Place(
        "from diagonal to diagonal", "from diagonal to diagonal",
        sites=lambda size, blocks: (sum(size) - 1,), spread=_diagonals(against=False), alike=NEAR,
    ),
    "antidiagonal": Place(
        "from antidiagonal to antidiagonal", "from antidiagonal to antidiagonal",
        sites=lambda size, blocks: (sum(size) - 1,), spread=_diagonals(against=True),
        alike=((1, -1), (2, -2)),
    ),
    "signal": Place("over the range of signals", "over the range of signals", ("range",), within_rows=True),
    "frequency": Place("by spatial frequency", "at one spatial frequency", ("period_px", "direction")),
    "code": Place("over the stored codes", "in the stored codes", ("period",)),
    "edge": Place("at edges", "at edges", ("edge",), within_rows=True),
}  # fmt: skip
SITES: tuple[Site, ...] = get_args(Site)


def place(name: object) -> Place:
    """The place of a name. Raises ValueError for one that there is not."""
    if name not in PLACES:
        raise ValueError(f"{name!r} is no place that anything varies over: one of {', '.join(PLACES)}")
    return PLACES[str(name)]
