"""How far a mean is off its reference where the reference is wrong, and scenes left aside."""

from __future__ import annotations

import numpy as np

from cannoise_jax.signatures import covariance
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.means import project
from cannoise_jax.signatures.score import Score

_NEAR = (*((dy, dx) for dy in (-2, 0, 2) for dx in (-2, 0, 2) if dy or dx), (-1, 0), (1, 0), (0, -1), (0, 1))
"""Neighbours of the same colour, and the nearest of the others."""


def near_filter(fields: Many, score: Score, rng: np.random.Generator) -> dict[int, np.ndarray]:
    """What a reference that is shifted, soft or sharp is off by, DN: the mean of each scene is a filter of
    the reference that reaches no further than the next pixel of the colour, fitted by least squares. (How a
    camera or a program interpolates is not known: a derivative alone leaves a good part of a true shift.)"""
    out = {}
    for f in fields:
        if f.kind != "scene" or f.static is None or f.clean is None:
            continue
        p = np.pad(f.clean.astype(np.float64), 2, mode="reflect")
        h, w = f.clean.shape
        taps = [p[2 + dy : 2 + dy + h, 2 + dx : 2 + dx + w] - f.clean for dy, dx in _NEAR]
        t = np.array([project(f, tap).ravel() for tap in taps]) * np.sqrt(f.frames)
        beta = np.linalg.lstsq(
            np.einsum("kn,ln->kl", t, t),
            np.einsum("kn,n->k", t, f.static.ravel().astype(np.float64)),
            rcond=1e-9,
        )[0]
        out[f.number] = np.einsum("k,kij->ij", beta, np.array(taps))
    return out


def white_error(fields: Many, score: Score, rng: np.random.Generator) -> dict[int, np.ndarray]:
    """What a noisy reference is off by, DN: white noise of the strength found."""
    return {
        f.number: score.amplitude * rng.standard_normal(f.mean.shape)
        for f in fields
        if f.kind == "scene" and f.static is not None
    }


def drop_scenes(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """A scene whose reference is wrong says nothing static."""
    return tuple(f._replace(static=None) if f.kind == "scene" else f for f in fields)


def drop_blurred(fields: Many, score: Score, template: covariance.Template, law: str) -> Many:
    """Drops the scenes' static fields and whitens the correlation that a blur inside the camera leaves."""
    left = covariance.Correlated(tuple(template.lags), law)
    return covariance.absorb(drop_scenes(fields, score), score.replace(payload=left))
