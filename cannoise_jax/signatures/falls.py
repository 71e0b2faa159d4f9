"""Falls of light from a corner or an edge, and what the darks say of each: templates, scores, forms."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy import optimize

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.fields import Fields

_REACHES = tuple(0.05 * 2 ** (n / 3) for n in range(10))
"""Lengths of the exponential fall over the longer side of the frame."""

TRIALS = 24
"""Independent ones among the templates."""

COST = float(np.log(TRIALS) + 0.5 * np.log(1e5)) / 2
"""Nats of one of the templates and its strength, 4.5: half of the log of their number beside `KNOWN_SHAPE`,
which is a half as well. The whole log, as the p-value counts them, would be 1.6 more."""

_MOST_FALLS = 8
"""Falls of one glow."""
_LOWEST = 0.005
"""Share of the pixels below what a glow brings to all of them."""


@lru_cache(maxsize=4)
def glow_templates(size: tuple[int, int]) -> tuple[tuple[str, ...], np.ndarray]:
    """Exponential falls from every corner and edge, of several lengths, each of rms 1: names,
    [templates, H W]."""
    names, out = [], []
    for place, distance in _distances(size).items():
        for reach in _REACHES:
            out.append(_unit_fall(np.exp(-distance / (reach * max(size)))))
            names.append(f"{place}, {reach * max(size):.0f} px")
    return tuple(names), np.array(out)


def _distances(size: tuple[int, int]) -> dict[str, np.ndarray]:
    """How far every pixel is from the corners and edges, px."""
    h, w = size
    y, x = np.indices(size)
    return {
        "top left": np.hypot(y, x),
        "top right": np.hypot(y, w - 1 - x),
        "bottom left": np.hypot(h - 1 - y, x),
        "bottom right": np.hypot(h - 1 - y, w - 1 - x),
        "top": y,
        "bottom": h - 1 - y,
        "left": x,
        "right": w - 1 - x,
    }


def _unit_fall(fall: np.ndarray) -> np.ndarray:
    return (fall / np.sqrt(np.mean(fall**2))).ravel().astype(np.float32)


def formed_fall(fields: tuple[Fields, ...], names: tuple[str, ...], g: np.ndarray, best: int) -> np.ndarray:
    """A glow of the form that the darks show, rms 1: falls of exponential, Gaussian and Lorentzian form from
    the best place and exponential ones from the others, added while each gains more than it costs, all of
    them of positive strength (orthogonal matching pursuit)."""
    size = fields[0].mean.shape
    place = names[best].rsplit(",", 1)[0]
    away = [_distances(size)[place] / (reach * max(size)) for reach in _REACHES]
    falls = [
        *g,
        *(_unit_fall(np.exp(-(d**2) / 2)) for d in away),
        *(_unit_fall(1 / (1 + d**2)) for d in away),
    ]
    every = np.array(falls)
    u, i = sums_of(fields, every)
    chosen, strengths = [best], np.array([u[best] / i[best]])
    gained = 0.5 * u[best] ** 2 / i[best]
    shared = [_along(fields, every, every[best])]
    while len(chosen) < _MOST_FALLS:
        rest = u - strengths @ np.array(shared)
        rest[chosen] = 0.0
        trial = [*chosen, int(np.argmax(rest / np.sqrt(i)))]
        shared.append(_along(fields, every, every[trial[-1]]))
        gram = np.array(shared)[:, trial]
        root = np.linalg.cholesky(gram + 1e-9 * np.diag(np.diag(gram)))
        fitted = optimize.nnls(root.T, np.linalg.solve(root, u[trial]))[0]
        gain = float(fitted @ u[trial] - 0.5 * fitted @ gram @ fitted)
        if gain - gained < COST:
            break
        chosen, strengths, gained = trial, fitted, gain
    return above_least((strengths @ every[chosen]).reshape(size))


def above_least(fall: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """A fall of rms 1 above what it brings to all pixels alike: that is told from no dark current, and falls
    that reach far have any amount of it."""
    return _unit_fall(np.maximum(fall - np.quantile(fall, _LOWEST), 0.0)).reshape(fall.shape)


def _along(fields: tuple[Fields, ...], falls: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Information that falls share with another one, the level of every channel fitted too."""
    dark, longest = _darks(fields)
    size = dark[0].mean.shape
    together, fall = np.zeros(size), other.reshape(size).astype(np.float64)
    for f in dark:
        square = f.weight.astype(np.float64) ** 2
        for at in SITES:
            level = float(np.sum(square[at] * fall[at])) / max(float(square[at].sum()), 1e-30)
            together[at] += f.frames * over_longest(f, longest) ** 2 * square[at] * (fall[at] - level)
    # One by one: all of them in double precision would take as much memory as the recordings.
    return np.array([own.astype(np.float64) @ together.ravel() for own in falls])


def _darks(fields: tuple[Fields, ...]) -> tuple[list[Fields], float | None]:
    """The darks, and the longest exposure where all are known."""
    dark = [as_it_stays(f) for f in fields if f.kind in DARK and f.static is not None]
    known = [f.exposure_s for f in dark if f.exposure_s is not None]
    # A bias of no exposure has none of it, and known exposures that are all zero tell of no growth.
    return dark, (max(known) or None) if known and len(known) == len(dark) else None


def sums_of_all(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, float | None] | None:
    """Score and information of every template and the longest exposure; None without darks."""
    dark, longest = _darks(fields)
    return (*sums_of(fields, glow_templates(dark[0].mean.shape)[1]), longest) if dark else None


def sums_of(fields: tuple[Fields, ...], g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of falls, the level of every channel fitted too."""
    dark, longest = _darks(fields)
    size = dark[0].mean.shape
    scale = np.array([over_longest(f, longest) for f in dark])
    frames = np.array([f.frames for f in dark])
    falls, u, i = g.reshape(-1, *size), np.zeros(len(g)), np.zeros(len(g))
    for at in SITES:  # all darks at once, for the falls are many times larger than a dark
        w = np.stack([f.weight[at].ravel() for f in dark], 1).astype(np.float32)
        response = w * np.stack([f.static[at].ravel() for f in dark if f.static is not None], 1)
        total = np.maximum(np.sum(w**2, 0, dtype=np.float64), 1e-30)
        level = np.sum(response, 0, dtype=np.float64) / total
        own = np.ascontiguousarray(falls[:, *at]).reshape(len(g), -1)
        score, along = (own @ x.astype(np.float32) for x in (response, w**2))
        u += (score - along.astype(np.float64) * level) @ (np.sqrt(frames) * scale)
        own *= own
        i += (own @ w**2 - along.astype(np.float64) ** 2 / total) @ (frames * scale**2)
    return u, np.maximum(i, 1e-30)


def over_longest(field: Fields, longest: float | None) -> float:
    """Glow of a dark over that of the longest one: it grows with the exposure."""
    return (field.exposure_s or 0.0) / longest if longest else 1.0
