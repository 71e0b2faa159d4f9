"""The expected mean of a recording, and what of it is nobody's fault: light is a nuisance.

A dark has one level per mosaic site, a flat without a reference a smooth surface of as many Legendre products
as the recording itself asks for (lenses darken corners by half, which no low degree follows), a scene or flat
with a reference an offset and a factor per site. Drawn frames are fitted anew by the same family, so that
nothing is compared that light could have made.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.discovery.frames.contrasts import robust_line
from cannoise_jax.physics.robust import OF_MEDIAN, median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.fields import least_squares

_CELL = 8
"""Pixels of a site along the side of a cell: the mean of 64 is known to an eighth of the noise of one."""
_FEWEST = 16
"""Cells along a side, at least: where there are no more, 256 cells bear the 66 terms of degree 10 thrice
over."""
_DEGREES = (2, 4, 6, 8, 10, 12)
"""Even ones, for light falls off alike to both sides."""


@dataclass(frozen=True, eq=False)
class Light:
    """How the mean is fitted: `degree` of a surface (0: a level per site), or a normalised reference."""

    degree: int
    reference: Float[np.ndarray, "h w"] | None = None

    def fit(self, mean: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]) -> np.ndarray:
        """The fitted mean of every pixel, DN."""
        out = np.empty(mean.shape, np.float32)
        for at in SITES:
            if self.reference is not None:
                out[at] = _on_reference(mean[at], self.reference[at], usable[at])
            else:
                out[at] = surface(mean[at], usable[at], self.degree)
        return out

    def residual(
        self, mean: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """The mean minus the fitted one, and the level of every site, DN."""
        fitted = self.fit(mean, usable)
        return mean - fitted, np.array([float(fitted[at].mean()) for at in SITES])


def light_for(r: Recording, mean: np.ndarray, usable: np.ndarray, dark: bool) -> Light | None:
    """How the mean of a recording is modelled; None where it is not known: scenes without a reference, or
    with one made of the camera's own frames."""
    if dark:
        return Light(0)
    if r.clean is not None and r.reference != "burst_mean":
        clean = np.asarray(r.clean, np.float32)
        clean = clean.mean(0) if clean.ndim == 3 else clean
        return Light(0, clean)
    if r.kind == "flat":
        return light_of(mean, usable)
    return None


class Cells(NamedTuple):
    """Means of cells of 8 x 8 pixels of one site (of fewer in small frames), pixels that stand out left
    aside, and their numbers; size: of the site; cell: of a cell, the last ones may be smaller."""

    value: Float[np.ndarray, "a b"]
    weight: Float[np.ndarray, "a b"]
    size: tuple[int, int]
    cell: tuple[int, int]


def light_of(mean: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]) -> Light:
    """The light of a flat: the degree that Akaike's criterion of its cells asks for, and one step more, for
    what a criterion of one flat lets pass shows in several together."""
    best, chosen, fitting = np.inf, 0, 0
    sites = [cells_of(mean[at], usable[at]) for at in SITES]
    for step, degree in enumerate(_DEGREES):
        score = 0.0
        for cells in sites:
            _, rest, count, terms = _fit(cells, degree)
            if count < 3 * terms:
                return Light(_DEGREES[min(chosen + 1, fitting)])
            score += count * np.log(max(rest, 1e-12)) + 2 * terms
        fitting = step
        if score < best - 6:
            best, chosen = score, step
    return Light(_DEGREES[min(chosen + 1, fitting)])


def surface(mean: Float[np.ndarray, "a b"], usable: Bool[np.ndarray, "a b"], degree: int) -> np.ndarray:
    """Surface of Legendre products up to `degree` through the cells of one site; 0: its level."""
    if degree == 0:
        return np.full(mean.shape, _bulk(mean[usable]) if usable.any() else mean.mean(), np.float32)
    table = _fit(cells_of(mean, usable), degree)[0]
    rows, columns = _legendre(mean.shape[0], degree), _legendre(mean.shape[1], degree)
    return (rows.T @ table @ columns).astype(np.float32)


def _fit(cells: Cells, degree: int) -> tuple[np.ndarray, float, int, int]:
    """Coefficients of the products, mean square left over the cells, cells and terms."""
    bases = [_cell_means(_legendre(n, degree), k) for n, k in zip(cells.size, cells.cell, strict=True)]
    pairs = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    basis = np.stack([np.outer(bases[0][i], bases[1][j]).ravel() for i, j in pairs], 1)
    values, root = cells.value.ravel(), np.sqrt(cells.weight.ravel())
    beta = least_squares(basis * root[:, None], values * root)
    rest = values - np.einsum("nk,k->n", basis, beta)
    table = np.zeros((degree + 1, degree + 1))
    for (i, j), b in zip(pairs, beta, strict=True):
        table[i, j] = b
    used = root > 0
    left = float(np.sum(rest[used] ** 2) / max(used.sum() - len(pairs), 1))
    return table, left, int(used.sum()), len(pairs)


def cells_of(mean: Float[np.ndarray, "h w"], usable: Bool[np.ndarray, "h w"]) -> Cells:
    """Cells of one site, to the very edges: beyond its cells a surface of high degree runs away."""
    height, width = (n // max(n // _CELL, min(_FEWEST, n // 2), 1) for n in mean.shape)
    a, b = -(-mean.shape[0] // height), -(-mean.shape[1] // width)
    beyond = [(0, a * height - mean.shape[0]), (0, b * width - mean.shape[1])]

    def cut(values):
        blocks = values.reshape(a, height, b, width)
        return blocks.swapaxes(1, 2).reshape(a, b, -1)

    values, ok = cut(np.pad(mean, beyond, mode="edge")).astype(np.float64), cut(np.pad(usable, beyond))
    centre = median(values, 2, keepdims=True)
    away = np.abs(values - centre)
    # Where most values are one code, the median of what is away from it is zero: then all count.
    spread = OF_MEDIAN * median(away, 2, keepdims=True)
    ok = ok & (away <= np.where(spread > 0, 5 * spread, np.inf))
    weight = ok.sum(2)
    return Cells(np.sum(values * ok, 2) / np.maximum(weight, 1), weight, mean.shape, (height, width))  # type: ignore[arg-type]


def _bulk(values: np.ndarray) -> float:
    """Mean of the values within five robust standard deviations of their median."""
    centre = median(values)
    away = np.abs(values - centre)
    kept = values[away <= max(5 * robust_std(values, centre), 1e-6)]
    return float(kept.mean()) if kept.size > 0.5 * values.size and np.ptp(kept) > 0 else float(values.mean())


@lru_cache(maxsize=32)
def _legendre(side: int, degree: int) -> np.ndarray:
    at = 2 * np.arange(side) / max(side - 1, 1) - 1
    return np.stack([np.polynomial.legendre.legval(at, np.eye(degree + 1)[k]) for k in range(degree + 1)])


def _cell_means(basis: np.ndarray, cell: int) -> np.ndarray:
    """The basis as means of cells of so many pixels sees it."""
    return np.stack([basis[:, k : k + cell].mean(1) for k in range(0, basis.shape[1], cell)], 1)


def _on_reference(mean: np.ndarray, reference: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """A reference at the offset and factor of the mean; an even one, at its level."""
    x, values = reference[usable].astype(np.float64), mean[usable].astype(np.float64)
    if x.size < 16 or np.ptp(x) < 1e-6:
        return np.full(mean.shape, _bulk(values) if values.size else mean.mean(), np.float32)
    offset, slope = robust_line(x, values, np.ones(x.size))
    return (slope * reference + offset).astype(np.float32)
