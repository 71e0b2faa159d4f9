"""Regions of equal size read by amplifiers of their own: offsets of quarters, or of several strips.

Two regions with a boundary anywhere are `means.step_score`'s.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.group_sums import area_sums
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.means import less_offsets
from cannoise_jax.signatures.score import Score, chi2_log_sf, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    OFFSETS,
    STATIC,
    Axes,
    Signature,
)

LAYOUTS = ((1, 2), (2, 1), (2, 2), (1, 4), (1, 8), (4, 1))
"""Regions along rows and along columns."""
_AREA = 8
"""Pixels a side of areas whose offsets hold those of regions, and whatever else is shared there."""
_MOSTLY = 0.5
"""Share of what such areas hold, from which on regions that explain it are judged before them."""
_PENALTY = 0.5 * float(np.log(1e3))
"""Nats that an offset of a region must gain."""


class Taps(NamedTuple):
    """Offsets of the regions [along rows, along columns], DN, mean 0, and the share that they are of what
    small areas hold."""

    levels: np.ndarray
    share: float = 0.0

    def image(self, size: tuple[int, int]) -> np.ndarray:
        """The offset of every pixel [H, W], DN."""
        return self.levels[regions_of(size, self.levels.shape)]


def regions_of(size: tuple[int, int], layout: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Region along rows [H, 1] and columns [1, W] of every pixel."""
    rows, columns = (np.arange(n) * k // n for n, k in zip(size, layout, strict=True))
    return rows[:, None], columns[None, :]


def legendre(size: tuple[int, int], layout: tuple[int, int]) -> Float[np.ndarray, "n h w"]:
    """As many smooth shapes as the layout has offsets, a constant first: products of Legendre polynomials."""
    y, x = (np.linspace(-1, 1, n) for n in size)
    along = [np.polynomial.legendre.legvander(v, k - 1) for v, k in zip((y, x), layout, strict=True)]
    return np.einsum("ia,jb->abij", *along).reshape(-1, *size)


@lru_cache(maxsize=8)
def _smooth(size: tuple[int, int], layout: tuple[int, int]) -> np.ndarray:
    """The same without the constant."""
    return legendre(size, layout)[1:].astype(np.float32)


def _explained(score: np.ndarray, information: np.ndarray, shapes: np.ndarray) -> float:
    """Chi-square of known shapes [n, H, W] beside a constant."""
    shapes = np.concatenate([np.ones_like(shapes[:1]), shapes])
    u = np.einsum("nij,ij->n", shapes, score)
    i = np.einsum("nij,mij,ij->nm", shapes, shapes, information, optimize=True)
    return float(u @ np.linalg.pinv(i) @ u - u[0] ** 2 / max(float(i[0, 0]), 1e-30))


def _of_areas(score: np.ndarray, information: np.ndarray) -> float:
    """Chi-square of offsets of small areas beyond chance, at least one."""
    u, i = (area_sums(v, _AREA) for v in (score, information))
    power = np.sum(u**2 / np.maximum(i, 1e-30)) - u.sum() ** 2 / max(float(i.sum()), 1e-30)
    return max(float(power) - np.count_nonzero(i) + 1, 1.0)


def tap_score(fields: tuple[Fields, ...]) -> Score[Taps] | None:
    """Offsets of regions of equal size in the darks, where they explain more than as many smooth shapes."""
    dark = [as_it_stays(f) for f in fields if f.kind in DARK and f.static is not None]
    if not dark:
        return None
    size = dark[0].mean.shape
    score = np.sum([np.sqrt(f.frames) * f.static * f.weight for f in dark], 0).astype(np.float64)
    information = np.sum([f.frames * f.weight.astype(np.float64) ** 2 for f in dark], 0)
    of_areas = _of_areas(score, information)
    best: tuple[float, float, int, Taps] | None = None
    for layout in LAYOUTS:
        at = np.ravel_multi_index(np.broadcast_arrays(*regions_of(size, layout)), layout).ravel()
        number = layout[0] * layout[1]
        u, i = (np.bincount(at, v.ravel(), number) for v in (score, information))
        if not i.min() > 1e-6 * i.sum():
            continue
        levels = u / i - u.sum() / i.sum()
        chi2, dof = float(np.sum(levels**2 * i)), number - 1
        evidence = 0.5 * chi2 - dof * _PENALTY
        if evidence < (best[0] if best else 0.0) or chi2 < _explained(
            score, information, _smooth(size, layout)
        ):
            continue
        best = evidence, chi2, dof, Taps(levels.reshape(layout), (chi2 - dof) / of_areas)
    total = float(information.sum())
    shift = 2 / np.sqrt(max(total, 1e-30))
    if best is None:
        return Score(
            log_p=0.0,
            gain=0.0,
            penalty=_PENALTY,
            amplitude=0.0,
            error=shift,
            shift=shift,
            power=1,
            parameters={},
            where={"axis": "block"},
            payload=Taps(np.zeros((1, 1))),
        )
    _, chi2, dof, taps = best
    # Twice the rms: of two halves it is the step between them.
    amplitude = 2 * float(np.sqrt(max(chi2 - dof, 0.0) / total))
    lines = {1: "column", 0: "row"}
    shape = taps.levels.shape
    axis = next((name for k, name in lines.items() if shape[1 - k] == 1), "block")
    edges = [int(np.ceil(size[k] * n / shape[k])) for k in (0, 1) for n in range(1, shape[k])]
    where = {"axis": axis, "index": edges} if axis != "block" else {"axis": axis, "bbox": [0, 0, *edges]}
    return Score(
        log_p=sidak(chi2_log_sf(chi2, dof), len(LAYOUTS)),
        gain=0.5 * chi2,
        penalty=dof * _PENALTY + float(np.log(len(LAYOUTS))),
        amplitude=amplitude,
        error=shift,
        shift=shift,
        power=1,
        parameters={"step": (amplitude, "DN", shift), "regions": (float(dof + 1), "1", 0.0)},
        where=where,
        payload=taps,
    )


def tap_absorb(fields: tuple[Fields, ...], score: Score[Taps]) -> tuple[Fields, ...]:
    """Subtracts the offsets of the regions from every static field."""
    return less_offsets(fields, score.payload.image(fields[0].mean.shape))


def of_one_strength(fields: Many, score: Score[Any], rng: np.random.Generator) -> np.ndarray:
    """The image of regions at the strength of one."""
    return score.payload.image(fields[0].mean.shape) / max(score.amplitude, 1e-12)


def regions(*, name: str, parameter: str, covers: tuple[str, ...], before: tuple[str, ...]) -> Signature:
    """Offsets of regions of equal size. before: signatures of small areas
    and of pixels, which hold them as well."""
    return Signature(
        name=name,
        axes=Axes("readout", "amplifier", "frozen", "additive", "step"),
        reads=STATIC,
        score=tap_score,
        absorb=tap_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=of_one_strength,
        simulate=strength(parameter, unit_map=True),
        place=placed(OFFSETS, unit_map=True),
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
        before=lambda score: before if score.payload.share > _MOSTLY else (),
    )
