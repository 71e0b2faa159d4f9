"""What a finding adds to a camera model: a mechanism of some strength, or a point of the grammar."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.coloured import OUTLYING, draw_coloured, spectrum_of
from cannoise_jax.signatures.handed import Addition, Found


def as_map(values: np.ndarray) -> Any:
    """As the chain stores a map: `[1, H, W]`, lines as `[1, H, 1]` or `[1, 1, W]`."""
    values = np.asarray(values, np.float32)
    return jnp.asarray(values.reshape((1,) * (3 - values.ndim) + values.shape))


Beside = Callable[[Found], dict[str, float]]
"""What a finding says of a mechanism beside its strength, by the mechanism's names."""


def NOTHING_BESIDE(found: Found) -> dict[str, float]:
    """Of a mechanism of which strength and pattern say all."""
    return {}


def strength(
    parameter: str,
    *,
    signed: str | None = None,
    unit_map: bool = False,
    by_exposure: bool = False,
    beside: Beside = NOTHING_BESIDE,
) -> Callable[[Found], Addition]:
    """Adds the mechanism with its amplitude as `parameter` and the measured pattern, if there is one, per
    unit of it. signed: parameter of the score that has the amplitude's sign; unit_map: the pattern is per
    unit already; by_exposure: the strength grows with it."""

    def simulate(found: Found) -> Addition:
        score = found.score
        value = score.parameters[signed][0] if signed in score.parameters else score.amplitude
        values = {parameter: value, **beside(found)}
        maps = {}
        if found.pattern is not None:
            maps = {"field": as_map(found.pattern / (1.0 if unit_map else max(value, 1e-12)))}
        return Addition(values, maps, found.by_exposure(parameter) if by_exposure else None)

    return simulate


def placed(
    point: Point | Callable[[Found], Point],
    *,
    unit_map: bool = False,
    by_exposure: bool = False,
    beside: Beside = NOTHING_BESIDE,
) -> Callable[[Found], Addition]:
    """Adds a finding without a name at a point of the grammar: its amplitude where the point draws its own
    field, else the measured pattern as strength and map of unit rms. unit_map: the pattern is per unit of the
    amplitude; by_exposure: the strength grows with it."""

    def place(found: Found) -> Addition:
        at = point if isinstance(point, Point) else point(found)
        value, maps = float(found.score.amplitude), {}
        if found.pattern is not None:
            shown = found.pattern * value if unit_map else found.pattern
            if at.over == "pixel":
                shown = np.broadcast_to(shown, found.size)
            value = float(np.sqrt(np.mean(np.asarray(shown) ** 2))) or 1.0
            maps = {"field": jnp.asarray(np.asarray(shown / value)[None], jnp.float32)}
        values = {amplitude_name(at): value, **beside(found)}
        if at.time == "telegraph":
            values["rate"] = 0.5
        return Addition(values, maps, found.by_exposure(amplitude_name(at)) if by_exposure else None, at)

    return place


def draw(
    score: np.ndarray, information: np.ndarray, variance: float, rng: np.random.Generator
) -> Float[np.ndarray, "..."]:
    """A draw of a pattern of this variance from what is known of it: its estimate, shrunk, and the doubt that
    is left drawn anew."""
    mean, doubt = posterior(score, information, variance)
    return mean + np.sqrt(doubt) * rng.standard_normal(np.shape(score))


_SHARED = 4.0
"""Standard errors from which on pixels of a cell count as alike."""


def draw_pixels(
    score: Float[np.ndarray, "h w"],
    information: Float[np.ndarray, "h w"],
    variance: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w"]:
    """As `draw`, of a map of pixels. Neighbours may be alike or unlike all over, or those of one cell of
    2 x 2 alone, as pixels are that share a photodiode's lens, a transistor or an amplifier: the doubt is
    drawn as alike as they are."""
    out = draw(score, information, variance, rng)
    h, w = (n // 2 * 2 for n in score.shape)
    if not variance > 0:
        return out
    coloured = _coloured(out, score, information, variance, rng)
    if coloured is not None:
        return coloured

    def cells(values: np.ndarray) -> np.ndarray:
        return values[:h, :w].reshape(h // 2, 2, w // 2, 2).transpose(0, 2, 1, 3).reshape(-1, 4)

    u, i = cells(np.asarray(score, np.float64)), cells(np.asarray(information, np.float64))
    alike = likeness(u, i, variance)
    if np.array_equal(alike, np.eye(4)):
        return out
    known = np.linalg.inv(variance * alike) + i[:, :, None] * np.eye(4)
    doubt = np.linalg.inv(known)
    drawn = np.einsum("nkl,nl->nk", doubt, u)
    drawn += np.einsum("nkl,nl->nk", np.linalg.cholesky(doubt), rng.standard_normal(u.shape))
    out[:h, :w] = drawn.reshape(h // 2, w // 2, 2, 2).transpose(0, 2, 1, 3).reshape(h, w)
    return out


def _coloured(
    white: Float[np.ndarray, "h w"],
    score: Float[np.ndarray, "h w"],
    information: Float[np.ndarray, "h w"],
    variance: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "h w"] | None:
    """The draw with neighbours as alike as they are all over; pixels far out, and those of which little is
    known, as in the white one. None where they are not alike."""
    typical = float(median(information))
    if not typical > 0:
        return None
    noise, known = 1 / typical, information > 0.25 * typical
    estimate = np.where(known, score / np.maximum(information, 1e-30), 0.0)
    limit = OUTLYING * np.sqrt(variance + noise)
    inside = known & (np.abs(estimate) < limit)
    estimate = np.where(inside, estimate, 0.0)
    power = spectrum_of(estimate, noise, variance)
    if power is None:
        return None
    return np.where(inside, draw_coloured(estimate, noise, power, rng), white)


def likeness(
    score: Float[np.ndarray, "n 4"], information: Float[np.ndarray, "n 4"], variance: float
) -> Float[np.ndarray, "4 4"]:
    """Correlation of the pattern's values at the four sites of a cell, those that stand out of chance."""
    mean = posterior(score, information, variance)[0]
    limit = OUTLYING * np.sqrt(variance)
    mean = np.clip(mean, -limit, limit)
    share = variance * information / (1 + variance * information)
    out = np.eye(4)
    for a in range(4):
        for b in range(a):
            product, expected = mean[:, a] * mean[:, b], variance * share[:, a] * share[:, b]
            error = float(np.sqrt(np.sum(product**2)))
            if expected.sum() > 0 and abs(product.sum()) > _SHARED * error:
                out[a, b] = out[b, a] = product.sum() / expected.sum()
    values, vectors = np.linalg.eigh(out)
    return (vectors * np.clip(values, 0.02, None)) @ vectors.T if values[0] < 0.02 else out


def posterior(
    score: np.ndarray, information: np.ndarray, variance: float
) -> tuple[Float[np.ndarray, "..."], Float[np.ndarray, "..."]]:
    """Mean and variance of a pattern of normal values of this variance, given scores and information."""
    doubt = variance / (1 + variance * information)
    return doubt * score, doubt
