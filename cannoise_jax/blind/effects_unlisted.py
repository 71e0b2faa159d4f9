"""Effects that no list of sensor mechanisms holds: the tool must say `unknown` and describe them.

Each is no special case of a listed mechanism.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.blind.chain import Context, Effect

SCALES = {
    "tile_noise": "none",
    "row_gain_noise": "signal",
    "diagonal_noise": "none",
    "parity_jitter": "none",
    "column_breathing": "signal",
}
"""What the strength of each scales with."""


def tile_noise(amplitude: float) -> Effect:
    """One offset per 16x16 tile, new in each frame."""

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        height, width = c.size
        tiles = c.rng.standard_normal((c.shot.frames, -(-height // 16), -(-width // 16)))
        return y + amplitude * np.kron(tiles, np.ones((1, 16, 16)))[:, :height, :width]

    return Effect("tile_noise", amplitude, "analog", apply)


def row_gain_noise(amplitude: float) -> Effect:
    """The gain of each row, new in each frame and white from row to row: shows with light only."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        return x * (1 + amplitude * c.rng.standard_normal((c.shot.frames, c.size[0], 1)))

    return Effect("row_gain_noise", amplitude, "photons", apply)


def diagonal_noise(amplitude: float) -> Effect:
    """One offset per diagonal of the array, new in each frame: neither a row's nor a column's."""

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        height, width = c.size
        offsets = c.rng.standard_normal((c.shot.frames, height + width))
        return y + amplitude * offsets[:, np.add.outer(np.arange(height), np.arange(width))]

    return Effect("diagonal_noise", amplitude, "analog", apply)


def parity_jitter(amplitude: float) -> Effect:
    """Even and odd columns of each frame are pushed apart by a new amount."""

    def apply(y: np.ndarray, c: Context) -> np.ndarray:
        sign = np.where(np.arange(c.size[1]) % 2, 1.0, -1.0)
        return y + amplitude * c.rng.standard_normal((c.shot.frames, 1, 1)) * sign

    return Effect("parity_jitter", amplitude, "analog", apply)


def column_breathing(amplitude: float) -> Effect:
    """The gain of each column, new in each frame."""

    def apply(x: np.ndarray, c: Context) -> np.ndarray:
        return x * (1 + amplitude * c.rng.standard_normal((c.shot.frames, 1, c.size[1])))

    return Effect("column_breathing", amplitude, "photons", apply)
