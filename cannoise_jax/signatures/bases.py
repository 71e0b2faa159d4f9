"""Orthonormal changes of coordinates of images, in which effects of different shape stand out."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft

Images = Float[np.ndarray, "n h w"]


class Basis(NamedTuple):
    """An orthonormal change of coordinates of images, and the axes over which it mixes pixels."""

    forward: Callable[[Images], Images]
    back: Callable[[Images], Images]
    mixes: tuple[int, ...]

    def level(self, mask: np.ndarray) -> Float[np.ndarray, "h w"]:
        """Variance of every coefficient where unit noise is seen through a mask, to the accuracy of the mean
        over the pixels that it mixes."""
        out = mask.astype(np.float64)
        for axis in self.mixes:
            out = np.broadcast_to(out.mean(axis, keepdims=True), out.shape)
        return out


def _cosines(axes: tuple[int, ...]) -> Basis:
    return Basis(
        lambda x: fft.dctn(x, axes=[a + 1 for a in axes], norm="ortho"),
        lambda x: fft.idctn(x, axes=[a + 1 for a in axes], norm="ortho"),
        axes,
    )


def _waves() -> Basis:
    """Hartley's transform, its own inverse: the basis of what looks alike everywhere."""

    def change(x: Images) -> Images:
        z = fft.fft2(x, norm="ortho")
        return z.real - z.imag

    return Basis(change, change, (0, 1))


def _sheared(sign: int) -> Basis:
    """Cosines along the diagonals, each closed to a ring."""

    def roll(x: Images, by: int) -> Images:
        rows, columns = np.indices(x.shape[1:])
        return x[:, rows, (columns + by * rows) % x.shape[2]]

    def ready(x: Images) -> Images:
        return fft.dct(roll(x, sign), axis=1, norm="ortho")

    return Basis(ready, lambda x: roll(fft.idct(x, axis=1, norm="ortho"), -sign), (0,))


def _blocks(side: int) -> Basis:
    """Cosines within square blocks; what does not fill one is left as it is."""

    def each(x: Images, change) -> Images:
        n, h, w = x.shape
        a, b = h // side * side, w // side * side
        inner = x[:, :a, :b].reshape(n, a // side, side, b // side, side)
        out = x.copy()
        out[:, :a, :b] = change(inner, axes=(2, 4), norm="ortho").reshape(n, a, b)
        return out

    return Basis(lambda x: each(x, fft.dctn), lambda x: each(x, fft.idctn), ())


BASES: tuple[Basis, ...] = (
    Basis(lambda x: x, lambda x: x, ()),
    _cosines((1,)),
    _cosines((0,)),
    _cosines((0, 1)),
    _waves(),
    _sheared(1),
    _sheared(-1),
    _blocks(8),
    _blocks(16),
    _blocks(32),
)
