"""The smooth part of images: products of few cosines of rows and of columns, however pixels are weighed."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg

DEGREE = 8
"""Half-periods over the frame, of rows and columns together, up to which a structure is followed."""
SMALLEST = 32
"""Rows and columns from which on these are smooth."""


def _orders() -> Int[np.ndarray, "2 k"]:
    both = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    # The whole frame first, then what rows or columns have alone: what comes later is told beside it.
    return np.array(sorted(both, key=lambda at: (min(at) > 0, max(at) > 0))).T


ORDERS = _orders()
"""Half-periods down and across of every cosine; the first is the frame as a whole."""
OF_LINES = int(np.sum(ORDERS.min(0) == 0)) - 1
"""How many of the others are alike all along rows, or all along columns; they come first."""


@lru_cache(maxsize=8)
def _cosines(size: int, orders: int) -> Float[np.ndarray, "n o"]:
    at = (np.arange(size) + 0.5) / size
    return np.cos(np.pi * np.outer(at, np.arange(orders)))


def cosine_sums(values: Float[np.ndarray, "n h w"]) -> Float[np.ndarray, "n k"]:
    """Sums of images over their pixels, each times every cosine."""
    down, across = (_cosines(n, DEGREE + 1).astype(values.dtype) for n in values.shape[1:])
    return (down.T @ (values @ across))[:, ORDERS[0], ORDERS[1]].astype(np.float64)


def cosine_products(weights: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "k k"]:
    """Weighted sums over the pixels of the products of two cosines."""
    down, across = (_cosines(n, 2 * DEGREE + 1) for n in weights.shape)
    squares = down.T @ (weights.astype(np.float64) @ across)
    out = np.zeros((ORDERS.shape[1], ORDERS.shape[1]))
    for a in (-1, 1):  # a product of two cosines is half the sum of two
        for b in (-1, 1):
            rows, columns = (np.abs(o[:, None] + s * o) for o, s in zip(ORDERS, (a, b), strict=True))
            out += squares[rows, columns] / 4
    return out


def beside_level(
    sums: Float[np.ndarray, "n k"], products: Float[np.ndarray, "k k"]
) -> tuple[Float[np.ndarray, "n l"], Float[np.ndarray, "l l"]]:
    """Both without the whole frame's own offset: of all cosines but the first."""
    own = products[0] / products[0, 0]
    return (sums - sums[:, :1] * own)[:, 1:], (products - np.outer(own, products[0]))[1:, 1:]


def whitening(products: Float[np.ndarray, "l l"]) -> Float[np.ndarray, "l l"] | None:
    """What makes sums of this covariance independent, each beside those before it, from the left; None where
    pixels do not tell of all of them."""
    try:
        root = linalg.cholesky(products, lower=True)
    except linalg.LinAlgError:
        return None
    return linalg.solve_triangular(root, np.eye(len(root)), lower=True)


def image_of(cosines: Float[np.ndarray, "l"], size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """The image of so much of every cosine but the first."""
    full = np.zeros((DEGREE + 1, DEGREE + 1))
    full[ORDERS[0, 1:], ORDERS[1, 1:]] = cosines
    down, across = (_cosines(n, DEGREE + 1) for n in size)
    return down @ full @ across.T
