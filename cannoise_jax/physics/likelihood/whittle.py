"""Whittle's likelihood: the powers of Fourier modes of Gaussian noise are independent and exponential."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

_ROUNDS = 30
"""Rounds of Fisher scoring at most."""
_NEAR = 1e-13  # relative change of a round that is the last


def whittle(power: Float[np.ndarray, "... n"], dof: Float[np.ndarray, "... n"], spectrum: np.ndarray) -> Any:
    """Log-likelihood of mean powers of `dof` degrees of freedom each (2 for one complex mode) under a
    spectrum, along the last axis, nats; what depends on the data alone is left out (Whittle 1953)."""
    return -0.5 * np.sum(dof * (np.log(spectrum) + power / spectrum), -1)


def white_level(
    power: Float[np.ndarray, "... n"], dof: Float[np.ndarray, "... n"], colour: Float[np.ndarray, "... n"]
) -> Float[np.ndarray, "... 1"]:
    """Most likely white level beside a coloured spectrum, by Fisher scoring from the mean power. Positive."""
    start = np.sum(power * dof, -1, keepdims=True) / np.sum(dof, -1, keepdims=True)
    white = np.broadcast_to(start, (*colour.shape[:-1], 1))
    for _ in range(_ROUNDS):
        spectrum = colour + white
        slope = np.sum(dof * (power - spectrum) / spectrum**2, -1, keepdims=True)
        before = white
        white = np.maximum(white + slope / np.sum(dof / spectrum**2, -1, keepdims=True), 0.05 * white)
        if np.all(np.abs(white - before) <= _NEAR * before):
            break
    return white
