"""Gains of regions read by amplifiers of their own.

The smooth surface of a flat follows part of any steps. What it leaves is fitted by steps and by all that a
surface may have taken along, cell by cell (Frisch and Waugh 1933: the steps come out as if the surface had
been fitted beside them), and the scatter of the cells about the fit is the noise: sensitivities of pixels,
dust and shadows are in it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache, partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import stays
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.means import minus
from cannoise_jax.signatures.moving_taps import LAYOUTS, Layout, cell_groups
from cannoise_jax.signatures.patterns import pixel_sums
from cannoise_jax.signatures.score import LEAST_LOG_P, Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    STATIC,
    Axes,
    Signature,
)
from cannoise_jax.signatures.taps import of_one_strength, regions_of

DEGREE = 16
"""Total degree of the surface that may have been taken out of a flat, at most (`frames.smooth`)."""
CELLS: Layout = (48, 48)
"""Every layout is a union of these cells, which leave many degrees of freedom beside such a surface."""
_SHARP = 1.3
"""How much more steps explain than the same ones a cell aside. What is left of a step beside a surface of
this degree lies within two cells of it; patterns that are no steps know no such place."""
_LAYOUTS = sorted(LAYOUTS, key=lambda layout: layout[0] * layout[1])
_PENALTY = 0.5 * float(np.log(1e3))
"""Nats that a gain must gain."""
_POINT = Point("readout", "signal", "block", "frozen", "multiply")


class Gains(NamedTuple):
    """Gains of the regions [along rows, along columns] less one, mean 0, and the coefficients [k, k] of what
    a surface took of them, negative."""

    levels: np.ndarray
    surface: np.ndarray

    def image(self, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """The gain of every pixel less one."""
        return self.levels[regions_of(size, self.levels.shape)]

    def left(self, size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
        """What the surface left of it."""
        rows, columns = (np.polynomial.legendre.legvander(_places(n), DEGREE) for n in size)
        return self.image(size) + rows @ self.surface @ columns.T


def _places(count: int) -> np.ndarray:
    """The middles of as many parts of [-1, 1]."""
    return (2 * np.arange(count) + 1) / count - 1


@lru_cache(maxsize=1)
def _terms() -> tuple[np.ndarray, np.ndarray]:
    """Degrees along rows and columns of every term of the surface."""
    rows, columns = np.indices((DEGREE + 1, DEGREE + 1))
    kept = rows + columns <= DEGREE
    return rows[kept], columns[kept]


@lru_cache(maxsize=1)
def _surface() -> Float[np.ndarray, "c k"]:
    """Every term of the surface in every cell."""
    rows, columns = (np.polynomial.legendre.legvander(_places(n), DEGREE) for n in CELLS)
    i, j = _terms()
    return (rows[:, None, i] * columns[None, :, j]).reshape(-1, i.size)


@lru_cache(maxsize=64)
def _regions(layout: Layout, aside: int) -> Float[np.ndarray, "c k"]:
    """Which region every cell is of, with the borders so many cells aside."""
    at = [(np.arange(n) - aside * (k > 1)).clip(0) * k // n for n, k in zip(CELLS, layout, strict=True)]
    number = (at[0][:, None] * layout[1] + at[1]).ravel()
    return (number[:, None] == np.arange(layout[0] * layout[1])).astype(float)


def _steps(layout: Layout, aside: int) -> Float[np.ndarray, "c k"]:
    """The same without the last region, which the surface makes up for."""
    return _regions(layout, aside)[:, :-1]


class _Cells(NamedTuple):
    """Standardised values of every cell and what a surface leaves of them, roots of their information, and an
    orthonormal basis of the standardised surface."""

    values: np.ndarray
    score: np.ndarray
    root: np.ndarray
    basis: np.ndarray

    def beside(self, shapes: Float[np.ndarray, "c k"]) -> Float[np.ndarray, "c k"]:
        """Shapes over the cells, standardised, without the surface."""
        shapes = shapes * self.root[:, None]
        return shapes - self.basis @ (self.basis.T @ shapes)

    def explained(self, shapes: Float[np.ndarray, "c k"]) -> float:
        """Chi-square of shapes beside the surface."""
        q, r = np.linalg.qr(self.beside(shapes))
        known = np.abs(np.diag(r)) > 1e-8 * max(float(np.abs(np.diag(r)).max()), 1e-30)
        return float(np.sum((q[:, known].T @ self.score) ** 2))


def _in_cells(fields: Many) -> _Cells | None:
    sums = pixel_sums(fields, "signal", ("flat",))
    if sums is None or any(n < k for n, k in zip(sums.score.shape, CELLS, strict=True)):
        return None
    groups = cell_groups(sums.score.shape, CELLS)
    # Single pixels far off their own noise are none of a region's.
    power = sums.score**2 / np.maximum(sums.information, 1e-30)
    bulk = float(median(power[sums.information > 0])) / stats.chi2.median(1) if sums.information.any() else 1
    kept = power < 25 * max(bulk, 1.0)
    u, i = (groups.sums(v * kept) for v in (sums.score, sums.information))
    root = np.sqrt(i)
    basis = np.linalg.qr(_surface() * root[:, None])[0]
    values = u / np.maximum(root, 1e-15)
    return _Cells(values, values - basis @ (basis.T @ values), root, basis)


class _Found(NamedTuple):
    """What the steps of a layout explain, chi-square, the scatter about them and its degrees of freedom."""

    layout: Layout
    chi2: float
    noise: float
    freedom: int

    @property
    def number(self) -> int:
        """Free parameters."""
        return self.layout[0] * self.layout[1] - 1

    def evidence(self, noise: float) -> float:
        """Nats against noise of this variance."""
        return 0.5 * self.chi2 / noise - self.number * _PENALTY


def gain_score(fields: Many, *, layout: Layout | None = None) -> Score[Gains] | None:
    """Gains of regions of equal size in the flats, where they are steps beside a surface. The layout is told
    by what it explains, and is as given where the finding is looked for again."""
    cells = _in_cells(fields)
    if cells is None:
        return None
    shown = [one for one in ([layout] if layout else _LAYOUTS) if _shown(cells, one)]
    if not shown:
        return None
    lines = cache(partial(_of_lines, cells))
    best = _found(cells, layout, lines) if layout else None
    for one in () if layout else shown:
        chi2 = cells.explained(_steps(one, 0))
        if best:
            # More regions are held against the scatter about the best of fewer.
            noise, least = best.noise, best.evidence(best.noise)
        else:
            # Their own, which is worked out only where the least that it can be leaves any evidence.
            noise, least = 1.0, 0.0
        if not _Found(one, chi2, noise, 0).evidence(noise) > least:
            continue
        found = _found(cells, one, lines)
        if (best or found.evidence(found.noise) > 0) and _steplike(cells, found):
            best = found
    if best is None:
        error = 1 / float(np.sqrt(np.sum(cells.root**2)))
        return Score(
            log_p=0.0, gain=0.0, penalty=_PENALTY, amplitude=0.0, error=error, shift=error, power=1,
            parameters={}, where={"axis": "block"},
            payload=Gains(np.zeros((1, 1)), np.zeros((DEGREE + 1, DEGREE + 1))),
        )  # fmt: skip
    gains, doubt = _fitted(cells, best.layout)
    error = float(np.sqrt(best.noise * doubt))
    amplitude = float(np.sqrt(max(np.mean(gains.levels**2) - error**2, 0.0)))
    log_p = float(stats.f.logsf(best.chi2 / best.number / best.noise, best.number, best.freedom))
    return Score(
        log_p=float(np.clip(log_p + np.log(len(LAYOUTS)), LEAST_LOG_P, 0.0)),
        gain=0.5 * best.chi2 / best.noise,
        penalty=best.number * _PENALTY + float(np.log(len(LAYOUTS))),
        amplitude=amplitude,
        error=error,
        shift=error,
        power=1,
        parameters={"sigma": (amplitude, "1", error), "regions": (float(best.number + 1), "1", 0.0)},
        where={"axis": "block", "regions": list(best.layout)},
        payload=gains,
    )


def _shown(cells: _Cells, layout: Layout) -> bool:
    """Whether every region has pixels that tell of it."""
    information = cells.root**2 @ _regions(layout, 0)
    return bool(np.all(information > 1e-3 * information.mean()))


def _of_lines(cells: _Cells, layout: Layout) -> tuple[float, int]:
    """What lines of cells explain, chi-square, and how many of them can be told beside a surface."""
    lines = _regions(layout, 0)
    return cells.explained(lines), int(np.linalg.matrix_rank(cells.beside(lines), 1e-6))


def _found(cells: _Cells, layout: Layout, of_lines: Callable[[Layout], tuple[float, int]]) -> _Found:
    """The steps of a layout against the scatter of cells, or of whole lines of them, whichever is more: gains
    of single lines look like those of a few regions."""
    chi2, number = cells.explained(_steps(layout, 0)), layout[0] * layout[1] - 1
    left = [(float(np.sum(cells.score**2)), np.count_nonzero(cells.root) - cells.basis.shape[1])]
    for axis in (0, 1):
        if layout[axis] > 1:
            left.append(of_lines((CELLS[0], layout[1]) if axis == 0 else (layout[0], CELLS[1])))
    told = [(max((v - chi2) / (n - number), 1.0), n - number) for v, n in left if n - number > 2]
    return _Found(layout, chi2, *max(told))


def _steplike(cells: _Cells, found: _Found) -> bool:
    """Whether the steps lie at these borders."""
    return found.chi2 > _SHARP * max(cells.explained(_steps(found.layout, k)) for k in (-1, 1))


def _fitted(cells: _Cells, layout: Layout) -> tuple[Gains, float]:
    """Gains of the regions with what the surface took of them, and the mean variance of one for noise of
    one."""
    steps = _steps(layout, 0)
    beside = cells.beside(steps)
    inverse = np.linalg.pinv(beside.T @ beside)
    found = inverse @ (beside.T @ cells.score)
    # A surface of a lower degree may have taken less of the steps than this one would.
    rest = cells.values - (steps * cells.root[:, None]) @ found
    taken = np.linalg.lstsq(_surface() * cells.root[:, None], rest, rcond=None)[0]
    levels = np.append(found, 0.0)
    mean = levels.mean()
    surface = np.zeros((DEGREE + 1, DEGREE + 1))
    surface[_terms()] = taken
    surface[0, 0] += mean
    centre = np.eye(levels.size)[:, :-1] - 1 / levels.size
    doubt = float(np.trace(centre @ inverse @ centre.T)) / levels.size
    return Gains((levels - mean).reshape(layout), surface), doubt


def _layout(gains: Gains) -> Layout:
    return gains.levels.shape[0], gains.levels.shape[1]


def gain_absorb(fields: Many, score: Score[Gains]) -> Many:
    """Subtracts what the surface left of the gains from every flat, and the gains from what else is lit."""

    def less(f: Fields) -> Fields:
        if f.static is None or not f.lit:
            return f
        payload, size = score.payload, f.mean.shape
        shown = payload.left(size) if f.kind == "flat" else payload.image(size)
        return minus(f, stays(f, "pixel", "signal") * shown)

    return tuple(less(f) for f in fields)


def gains(*, name: str, parameter: str, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """Gains of regions of equal size. parameter: the mechanism's strength. before: signatures of single
    lines, whose patterns hold those of regions."""
    return Signature(
        name=name,
        axes=Axes("readout", "amplifier", "frozen", "signal", "step"),
        reads=STATIC | {"signal"},
        score=gain_score,
        again=lambda fields, found: gain_score(fields, layout=_layout(found.payload)),
        absorb=gain_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=of_one_strength,
        simulate=strength(parameter, unit_map=True),
        place=placed(_POINT, unit_map=True),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        before=lambda score: before if score.gain > 0 else (),
    )
