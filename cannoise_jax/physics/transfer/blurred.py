"""What noise makes of a density: each value is seen with Gaussian noise, whose variance grows with it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import sparse, special

_REACH = 7.0
"""Standard deviations of the noise beyond which nothing of a cell is seen."""
_LEAST = 0.25
"""Of the variance at the middle, the least that any value has: few electrons have little shot noise, but all
have read noise."""


def blur(
    at: Float[np.ndarray, "n"], edges: Float[np.ndarray, "k"], middle: float, noise: float, shot: float
) -> sparse.csr_matrix:
    """By which masses in cells between `edges`, evenly spread over each, become the density at places `at`.

    noise: standard deviation of a value at the middle. shot: by how much the variance grows per unit.
    """
    low, high = edges[:-1], edges[1:]
    variance = np.maximum(noise**2 + shot * ((low + high) / 2 - middle), _LEAST * noise**2)
    sigma = np.sqrt(variance)
    first = np.searchsorted(at, low - _REACH * sigma)
    last = np.searchsorted(at, high + _REACH * sigma)
    number = last - first
    cell = np.repeat(np.arange(len(low)), number)
    place = np.arange(number.sum()) - np.repeat(np.cumsum(number) - number, number) + first[cell]
    beside = [(at[place] - edge[cell]) / sigma[cell] for edge in (low, high)]
    seen = (special.ndtr(beside[0]) - special.ndtr(beside[1])) / (high - low)[cell]
    return sparse.csr_matrix((seen, (place, cell)), shape=(len(at), len(low)))


def spaced(low: float, high: float, middle: float, unit: float) -> Float[np.ndarray, "k"]:
    """Edges from low to high, a twentieth of a unit apart in the middle and further far from it."""
    first, last = (float(np.arcsinh((end - middle) / unit)) for end in (low, high))
    return middle + unit * np.sinh(np.linspace(first, last, max(int((last - first) / 0.05), 8)))
