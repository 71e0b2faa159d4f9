"""Pixels that have something of one frame in another: a pattern that dies away after a start, an image that
lags, offsets that wander.

Contrasts between the frames of a recording are orthonormal, so noise that is redrawn in every frame makes
them independent, whatever its spectrum over the frame is. The products of two contrasts, summed over the
pixels, then have the mean zero and the variance sum(P^2) / sum(P)^2, by the power P at every frequency of the
plane (Bartlett 1946, J. R. Stat. Soc. Suppl. 8, 27), times what pixels that are not equally loud add.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft

from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.fields import Fields, each_frame, helmert
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.plain import plain
from cannoise_jax.signatures.score import ONE_PARAMETER, Score, chi2_log_sf
from cannoise_jax.signatures.signature import CONTRASTS, Axes, Signature

_FAR = 4.0
"""Standard deviations to which values are brought in: single pixels that jump are no pattern of all."""
_FEWEST = 4
"""Frames of a recording that have products beside a noise of each."""
_WIDER = 1.15
"""Of the variance of a product, by which what is known of it may be too small: waves of random phase and
pixels of unlike noise, before they are found, give 1.05 to 1.2."""
_SQUARES = 3.0
"""Errors of a mean square over those of a mean product, of pixels some of which are far out; 1.4 of normal
noise."""
_LEAST = 0.05
"""Variance that a combination of frames keeps, of what it was."""


class _Products(NamedTuple):
    """Of one dark the mean products of its contrasts `[n, n]` over the mean square beyond what frames of
    unlike noise give, and the standard error of one of two contrasts. mean, square: expectation and half the
    variance of the sum of their squares over that error. after: the mean product of a frame and the next one,
    and its standard error."""

    products: Float[np.ndarray, "n n"]
    error: float
    mean: float
    square: float
    after: tuple[float, float]


def _products(field: Fields) -> _Products | None:
    if field.kind not in DARK or field.frames < _FEWEST or not field.usable.any():
        return None
    matrix = helmert(field.frames)
    among = field._replace(contrasts=field.contrasts[: len(matrix)], before=0)
    limited = [np.clip(x, -_FAR, _FAR) * field.usable for x in each_frame(among, static=False)]
    values = np.einsum("nt,tij->nij", matrix.astype(np.float32), np.stack(limited))
    values = np.stack([bank.without_lines(v) for v in values]) * field.usable
    flat = values.reshape(len(values), -1)
    products = (flat @ flat.T).astype(np.float64)
    level = float(np.trace(products)) / len(products)
    if level <= 0:
        return None
    each = np.mean(flat[:, field.usable.ravel()] ** 2, 0, dtype=np.float64)
    # By so many contrasts alone do the powers of pixels that are equally loud scatter.
    unlike = float(np.mean(each**2)) / float(np.mean(each)) ** 2 / (1 + 2 / len(flat))
    error = float(np.sqrt(_WIDER * _shared_power(values) * max(unlike, 1.0)))
    return _beside_frames(products / level, matrix, error)


def _beside_frames(
    products: Float[np.ndarray, "n n"], matrix: Float[np.ndarray, "n t"], error: float
) -> _Products:
    """The products, one on the diagonal, without what frames that are each of another noise give them: that
    shows in the squares as well, which scatter by more."""
    upper, size = np.triu_indices(len(products), 1), len(products)
    terms = matrix[upper[0]] * matrix[upper[1]]
    fit = np.linalg.pinv(np.vstack([terms, matrix**2 / _SQUARES]))
    # What is left is linear in the products and squares, and so is what a frame has of the next.
    pairs = np.eye(len(terms)) - terms @ fit[:, : len(terms)]
    squares = -terms @ fit[:, len(terms) :] / _SQUARES
    left = pairs @ products[upper] + squares @ np.diag(products)
    next_one = matrix[:, :-1] @ matrix[:, 1:].T / (matrix.shape[1] - 1)
    wanted = (next_one + next_one.T)[upper]
    spread = np.linalg.norm(np.concatenate([wanted @ pairs, np.sqrt(2) * wanted @ squares]))
    out = np.eye(size)
    out[upper] = out.T[upper] = left
    scatter = pairs @ pairs.T + 2 * squares @ squares.T
    after = float(wanted @ left), error * float(spread)
    return _Products(out, error, float(np.trace(scatter)), float(np.sum(scatter**2)), after)


def _shared_power(values: Float[np.ndarray, "n h w"]) -> float:
    """Variance of the mean product of two independent contrasts, over the square of the mean square, by the
    correlations of pixels within one; what those scatter by is taken off."""
    n, h, w = values.shape
    size = tuple(fft.next_fast_len(int(1.5 * k), real=True) for k in (h, w))
    power = np.mean([np.abs(fft.rfft2(v, size)) ** 2 for v in values], axis=0)
    sums = fft.irfft2(power, size)
    down, across = (np.abs(fft.fftfreq(k, 1 / k)) for k in size)
    pairs = np.maximum(h - down, 0)[:, None] * np.maximum(w - across, 0)
    told = pairs >= h * w / 4
    products = np.sum(sums[told] ** 2 / pairs[told]) * (h * w) / sums[0, 0] ** 2 - 1
    chance = (np.count_nonzero(told) - 1) / (h * w) / n
    return (1 + max(float(products) - chance, 0.0)) / (h * w)


def in_time_score(fields: Many) -> Score | None:
    """What frames of a dark have of each other. Amplitude: the root of the variance, over that of a pixel's
    noise, that goes from one to another."""
    chi2 = mean = square = shared = held = 0.0
    shift, after = [], []
    for f in fields:
        found = _products(f)
        if found is None:
            continue
        upper = found.products[np.triu_indices(len(found.products), 1)]
        chi2 += float(np.sum((upper / found.error) ** 2))
        mean, square = mean + found.mean, square + found.square
        shared += float(np.sum(upper**2)) - found.mean * found.error**2
        held += len(found.products)
        shift.append(found.error)
        after.append(found.after)
    if not mean:
        return None
    weight = [1 / max(e, 1e-12) ** 2 for _, e in after]
    value = np.average([v for v, _ in after], weights=weight)
    share = float(np.sqrt(max(2 * shared, 0.0) / held))
    error = float(np.mean(shift)) * np.sqrt(2 * square) / np.sqrt(held)
    return Score(
        # A sum of squares of unlike weights (Satterthwaite 1946, Biometrics Bull. 2, 110).
        log_p=chi2_log_sf(chi2 * mean / square, mean**2 / square),
        gain=max(0.5 * (chi2 - mean), 0.0),
        penalty=ONE_PARAMETER,
        amplitude=float(np.sqrt(share)),
        error=float(error / (2 * np.sqrt(max(share, error)))),
        shift=float(np.sqrt(error)),
        power=2,
        parameters={"next_frame": (float(value), "1", float(sum(weight) ** -0.5))},
        where={"axis": "pixel"},
    )


def in_time_absorb(fields: Many, score: Score) -> Many:
    """The darks with combinations of their contrasts that have nothing of each other."""
    out = []
    for f in fields:
        found = _products(f)
        if found is None:
            out.append(f)
            continue
        values, vectors = np.linalg.eigh(found.products)
        root = vectors @ np.diag(1 / np.sqrt(np.maximum(values, _LEAST))) @ vectors.T
        among = np.einsum("kn,nij->kij", root.astype(np.float32), f.contrasts[: len(root)])
        out.append(f._replace(contrasts=np.concatenate([among, f.contrasts[len(root) :]])))
    return tuple(out)


def _kind(score: Score) -> str:
    """What it looks like."""
    value, _, error = score.parameters["next_frame"]
    if value > 2 * error:
        return "pixels keep something of the frame before"
    return "a pattern of pixels that comes and goes from frame to frame"


def kept(*, name: str, covered_by: tuple[str, ...], covers: tuple[str, ...]) -> Signature:
    """Pixels of darks that have something of one frame in another."""
    return plain(
        name=name,
        axes=Axes("readout", "pixel", "modulated", "additive", "white"),
        reads=CONTRASTS,
        score=in_time_score,
        absorb=in_time_absorb,
        covers=covers,
        covered_by=covered_by,
        kind=_kind,
    )
