"""How the mean answers to light: the two greens, fall-off to the corners."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.recordings.recording import mosaic_map
from cannoise_jax.signatures.added import placed, strength
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.least import (
    Law,
    Seen,
    template,
)
from cannoise_jax.signatures.means import minus, project
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import (
    ONE_PARAMETER,
    Score,
    normal_log_p,
)
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    STATIC,
    Axes,
    Signature,
    unchanged,
)


def green_score(fields: tuple[Fields, ...], *, greens: tuple[int, int] | None) -> Score[float] | None:
    """Relative difference of the two green channels."""
    if greens is None:
        return None
    a, b = greens
    u = i = 0.0
    for f in fields:
        if f.static is None or not f.lit or not f.usable.any():
            continue
        channel = channel_index(f.mean.shape)
        level, variance = [], []
        for c in (a, b):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            if f.kind == "scene":
                assert f.clean is not None
                x = f.clean[chosen] - np.average(f.clean[chosen], weights=weight)
                slope = np.sum(weight * x * f.mean[chosen]) / np.sum(weight * x**2)
                level.append(slope)
                variance.append(1 / np.sum(weight * x**2) / f.frames / slope**2)
            else:
                # Both greens at the sites of the second, equally blurred: neither a gradient nor a curvature
                # of the light must look like a contrast.
                level_map = (_diagonal(f.mean) if c == a else _blurred(f.mean))[2:-2, 2:-2]
                signal = float(np.mean(level_map[(channel == b)[2:-2, 2:-2]]) - f.black[c])
                dark = np.mean([np.median(g.sigma) ** 2 for g in fields if not g.lit] or [0.0])
                count = sum(g.frames for g in fields if not g.lit) * chosen.sum() or np.inf
                level.append(signal)
                variance.append(
                    (float(np.mean(f.sigma[chosen] ** 2)) / chosen.sum() / f.frames + dark / count)
                    / max(signal, 1e-6) ** 2
                )
        if min(level) <= 0:
            continue
        v = sum(variance)
        u += np.log(level[0] / level[1]) / v
        i += 1 / v
    if i == 0:
        return None
    z = u / np.sqrt(i)
    amplitude, error = abs(u / i) / 2, 0.5 / np.sqrt(i)
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=amplitude,
        error=error,
        shift=error,
        power=1,
        parameters={"relative_difference": (u / i, "1", 2 * error)},
        where={"axis": "channel", "channel": "Gr-Gb"},
        payload=u / i,
    )


def _diagonal(image: np.ndarray) -> np.ndarray:
    """Mean of the four diagonal neighbours, which are of the other green; wrong at the border."""
    p = np.pad(image.astype(np.float64), 1, mode="edge")
    return (p[:-2, :-2] + p[2:, 2:] + p[:-2, 2:] + p[2:, :-2]) / 4


def _blurred(image: np.ndarray) -> np.ndarray:
    """Mean of each pixel and of its neighbours of the same green, which has the second moments of
    `_diagonal`; wrong at the border."""
    p = np.pad(image.astype(np.float64), 2, mode="edge")
    around = (p[:-4, 2:-2] + p[4:, 2:-2] + p[2:-2, :-4] + p[2:-2, 4:]) / 4
    return (p[2:-2, 2:-2] + around) / 2


def fall_off(size: tuple[int, int]) -> np.ndarray:
    """Square of the distance to the centre over that of the corners."""
    h, w = size
    y, x = np.indices((h, w))
    return ((y - (h - 1) / 2) ** 2 + (x - (w - 1) / 2) ** 2) / (((h - 1) / 2) ** 2 + ((w - 1) / 2) ** 2)


def shading_score(fields: tuple[Fields, ...], *, span: float) -> Score[tuple[float, float]] | None:
    """Fall-off towards the corners of flats and scenes whose light is known."""
    u = i = 0.0
    for f in fields:
        if not f.lit or f.clean is None or f.static is None:
            continue
        fall = fall_off(f.mean.shape)
        if f.kind == "scene":
            t = project(f, -fall * f.clean * span / f.unit)
            u += float(np.sum(f.static * t)) * np.sqrt(f.frames)
            i += float(np.sum(t**2)) * f.frames
            continue
        channel = channel_index(f.mean.shape)
        for c in range(4):
            chosen = (channel == c) & f.usable
            weight = f.weight[chosen].astype(np.float64) ** 2
            light = f.clean[chosen].astype(np.float64)
            mean = f.mean[chosen] - f.black[c]
            if weight.sum() == 0 or light.mean() <= 0:
                continue
            scale = np.sum(weight * light * mean) / np.sum(weight * light**2)
            t = -light * scale * (fall[chosen] - np.average(fall[chosen], weights=weight * light**2))
            u += f.frames * np.sum(weight * t * (mean - scale * light))
            i += f.frames * np.sum(weight * t**2)
    if i == 0:
        return None
    z, amplitude, error = u / np.sqrt(i), u / i, float(1 / np.sqrt(i))
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=abs(amplitude),
        error=error,
        shift=error,
        power=1,
        parameters={"corner_loss": (float(amplitude), "1", error)},
        where={"axis": "block", "bbox": None},
        payload=(float(amplitude), span),
    )


def shading_absorb(fields: tuple[Fields, ...], score: Score[tuple[float, float]]) -> tuple[Fields, ...]:
    """Takes the fall-off out of the scenes; the smooth mean of a flat holds it already."""
    value, span = score.payload
    return tuple(
        minus(f, project(f, -fall_off(f.mean.shape) * f.clean * span / f.unit * value))
        if f.kind == "scene" and f.static is not None and f.clean is not None
        else f
        for f in fields
    )


def two_greens(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """A difference between the two greens."""
    sites = recorded.greens

    def pattern(fields: Many, score: Score, rng: np.random.Generator) -> np.ndarray | None:
        if sites is None:
            return None
        cell = np.zeros(4)
        low, high = sorted(sites)
        cell[low], cell[high] = np.sign(score.payload), -np.sign(score.payload)
        return mosaic_map(cell, fields[0].mean.shape)

    def least(sets: tuple[Seen, ...]) -> Law | None:
        if sites is None:
            return None
        sign = np.array([(n == sites[0]) - 1.0 * (n == sites[-1]) for n in range(4)])
        return template(sets, lambda s: s.signal * sign[channel_index(s.weight.shape)])

    return Signature(
        name=name,
        axes=Axes("photons", "channel", "frozen", "signal", "contrast"),
        reads=STATIC | {"mean"},
        score=partial(green_score, greens=sites),
        absorb=unchanged,
        covers=covers,
        predict=NO_LAW,
        pattern=pattern,
        simulate=strength(parameter, unit_map=True),
        place=placed(Point("photons", "mean", "channel", "frozen", "multiply"), unit_map=True),
        detectable=BY_SHIFT,
        least=least,
    )


def shaded(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """Fall-off towards the corners, where the light is known."""
    return Signature(
        name=name,
        axes=Axes("photons", "block", "frozen", "signal", "fall-off"),
        reads=STATIC | {"mean"},
        score=partial(shading_score, span=recorded.span),
        absorb=shading_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter, signed="corner_loss"),
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=lambda sets: template(sets, lambda s: s.signal * fall_off(s.weight.shape)),
    )
