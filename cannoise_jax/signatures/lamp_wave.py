"""The wave of a lamp far above the noise: its frequency off the grid, each colour's amplitude and phase.

Rows of one site of the mosaic are a constant, which holds the level of the frame, and a sinusoid, new in
every frame: z = A exp(i (phi - late)). The four sites share phi, so that z of a site over z of all is the
site's share of the amplitude and the phase by which it is late.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from scipy import optimize

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.answers import response
from cannoise_jax.signatures.fields import Fields, frame_fields

_REACH = 0.5
"""Of the search for the frequency, cycles in the frame: as far apart as two are told."""
_STEPS = 21
"""Frequencies that are tried before the best is refined."""
_LEAST_POINTS, _WELL_FIXED = 4, 0.15
"""Frames that fix a circle, and the least share of the weakest direction in the fit of it."""


class Lamp(NamedTuple):
    """Frequency (cycles per row), peak as a fraction of the signal, of all pixels by their information, and
    of every site its share of it and the phase (radians) by which it is late. frames: that tell."""

    frequency: float
    amplitude: float
    share: Float[np.ndarray, "4"]
    late: Float[np.ndarray, "4"]
    frames: int


class _Rows(NamedTuple):
    """Of one site in one recording: which rows, root of their information, standardised sums."""

    rows: np.ndarray
    root: Float[np.ndarray, "h"]
    sums: Float[np.ndarray, "n h"]


def lamp_wave(lit: list[Fields], near: float) -> Lamp:
    """The wave of lit recordings whose frequency is `near`."""
    sites = [_rows(field) for field in lit]
    reach = _REACH / lit[0].mean.shape[0]
    grid = np.clip(near + reach * np.linspace(-1, 1, _STEPS), 1e-6, 0.5)
    left = [_left(sites, f) for f in grid]
    best, step = float(grid[int(np.argmin(left))]), 2 * reach / (_STEPS - 1)
    found = optimize.minimize_scalar(
        lambda f: _left(sites, f), bounds=(max(best - step, 1e-6), min(best + step, 0.5)), method="bounded"
    )
    frequency = float(found.x)
    weights = np.array([sum(float(np.sum(one[c].root ** 2)) for one in sites) for c in range(4)])
    weights = weights / weights.sum()
    waves = [np.stack([_wave(s, frequency) for s in one], 1) for one in sites]
    whole = [w @ weights for w in waves]
    product = sum(np.einsum("nc,n->c", w, np.conj(all)) for w, all in zip(waves, whole, strict=True))
    ratio = product / max(sum(float(np.sum(np.abs(all) ** 2)) for all in whole), 1e-30)
    frames = np.array([len(all) for all in whole])
    squares = [_radius(all) ** 2 for all in whole]
    amplitude = float(np.sqrt(np.average(squares, weights=frames)))
    return Lamp(frequency, amplitude, np.abs(ratio), -np.angle(ratio), int(frames.sum()))


def _radius(points: Complex[np.ndarray, "n"]) -> float:
    """Radius of the circle on which the waves of frames of free phase lie, by least squares of the squared
    distances; about zero where they do not fix one.

    Its centre is off zero by what a smooth signal holds of the mean of the waves, where the frame holds few
    periods."""
    square = np.abs(points) ** 2
    about = float(np.mean(square))
    if len(points) >= _LEAST_POINTS and about > 0:
        unit = np.sqrt(about)
        design = np.stack([points.real / unit, points.imag / unit, np.ones(len(points))], 1)
        found, _, _, values = np.linalg.lstsq(design, square / about, rcond=None)
        radius = float(np.sqrt(max(found[2] + (found[0] ** 2 + found[1] ** 2) / 4, 0.0)))
        if values[-1] > _WELL_FIXED * values[0] and 0.5 < radius < 2:
            return radius * float(unit)
    return float(np.sqrt(about))


def _rows(field: Fields) -> list[_Rows]:
    whole = field.contrasts if field.static is None else frame_fields(field)
    r, out = response(field, "signal"), []
    for at in SITES:
        root = np.sqrt(np.maximum(np.sum(r[at].astype(np.float64) ** 2, 1), 1e-30))
        rows = np.arange(field.mean.shape[0])[at[0]]
        out.append(_Rows(rows, root, np.einsum("nij,ij->ni", whole[:, *at], r[at]) / root))
    return out


def _basis(rows: _Rows, frequency: float) -> Float[np.ndarray, "h 3"]:
    turn = 2 * np.pi * frequency * rows.rows
    return np.stack([np.ones(turn.size), np.cos(turn), np.sin(turn)], 1) * rows.root[:, None]


def _left(sites: list[list[_Rows]], frequency: float) -> float:
    """Sum of squares that the wave of this frequency leaves."""
    total = 0.0
    for rows in (rows for one in sites for rows in one):
        q, _ = np.linalg.qr(_basis(rows, frequency))
        total += float(np.sum(rows.sums**2) - np.sum((rows.sums @ q) ** 2))
    return total


def _wave(rows: _Rows, frequency: float) -> Complex[np.ndarray, "n"]:
    """The wave of every frame as A exp(i phase), the sinusoid being A cos(2 pi f i + phase)."""
    fitted = np.linalg.lstsq(_basis(rows, frequency), rows.sums.T, rcond=None)[0]
    return fitted[1] - 1j * fitted[2]
