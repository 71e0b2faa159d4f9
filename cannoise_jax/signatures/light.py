"""How the mean answers to light: the two greens, fall-off to the corners."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.robust import median
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
from cannoise_jax.signatures.remembered import remembered
from cannoise_jax.signatures.scatter import scatter
from cannoise_jax.signatures.score import (
    ONE_PARAMETER,
    Score,
    normal_log_p,
    student_log_p,
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


class Greens(NamedTuple):
    """Logarithm of the ratio of the two greens of one recording, its variance by the noise of pixels, by how
    much that grows with the variance of the black level of a pixel, DN^-2, and what every cell of 2 x 2
    pixels adds to the ratio beyond the mean; zero where it adds nothing."""

    value: float
    variance: float
    by_black: float
    cells: Float[np.ndarray, "h w"]


Look = Callable[[Fields], Greens | None]


def _greens(f: Fields, sites: tuple[int, int]) -> Greens | None:
    """Of one recording; None where a green shows no light."""
    channel, rows, columns = channel_index(f.mean.shape), f.mean.shape[0] // 2, f.mean.shape[1] // 2
    a, b = sites
    if f.kind == "scene":
        assert f.clean is not None
        value, variance, cells = 0.0, 0.0, np.zeros((rows, columns))
        for c, sign in ((a, 1.0), (b, -1.0)):
            chosen = (channel == c) & f.usable
            weight = np.where(chosen, f.weight.astype(np.float64) ** 2, 0.0)
            total = max(weight.sum(), 1e-30)
            x = f.clean - float(np.sum(weight * f.clean) / total)
            known = float(np.sum(weight * x**2))
            slope = float(np.sum(weight * x * f.mean) / known) if known > 0 else 0.0
            if slope <= 0:
                return None
            value += sign * np.log(slope)
            variance += 1 / known / f.frames / slope**2
            level = float(np.sum(weight * (f.mean - slope * x)) / total)
            each = sign * weight * x * (f.mean - level - slope * x) / (known * slope)
            cells += each[c // 2 :: 2, c % 2 :: 2][:rows, :columns]
        return Greens(value, variance, 0.0, cells)
    # Both greens at the sites of the second, equally blurred: neither a gradient nor a curvature of the light
    # must look like a contrast.
    inside = (channel == b)[2:-2, 2:-2]
    maps = _diagonal(f.mean)[2:-2, 2:-2] - f.black[a], _blurred(f.mean)[2:-2, 2:-2] - f.black[b]
    levels = [float(np.mean(image[inside])) for image in maps]
    shown = [(channel == c) & f.usable for c in sites]
    if min(levels) <= 0 or not all(chosen.any() for chosen in shown):
        return None
    variance = by_black = 0.0
    for chosen, level in zip(shown, levels, strict=True):
        variance += float(np.mean(f.sigma[chosen] ** 2)) / chosen.sum() / f.frames / level**2
        by_black += 1 / (chosen.sum() * level**2)
    apart = np.zeros(f.mean.shape)
    apart[2:-2, 2:-2] = np.where(inside, maps[0] / levels[0] - maps[1] / levels[1], 0.0) / inside.sum()
    cells = apart[b // 2 :: 2, b % 2 :: 2][:rows, :columns]
    return Greens(np.log(levels[0] / levels[1]), variance, by_black, cells)


def looking_at(sites: tuple[int, int] | None) -> Look:
    """`_greens` at these sites, worked out once for a recording; None: there are none."""
    if sites is None:
        return lambda field: None
    return remembered("mean", "sigma", "usable")(partial(_greens, sites=sites))


def green_score(fields: tuple[Fields, ...], *, look: Look, patterns: bool = False) -> Score[float] | None:
    """Relative difference of the two green channels. look: see `looking_at`. patterns: by the scatter that
    bands of rows and of columns show, which frozen patterns of pixels and lines add to; by the noise of
    pixels alone otherwise."""
    dark = float(np.mean([median(g.sigma) ** 2 for g in fields if not g.lit] or [0.0]))
    count = sum(g.frames for g in fields if not g.lit) or np.inf
    lit = [f for f in fields if f.static is not None and f.lit and f.usable.any()]
    told = [g for f in lit if (g := look(f)) is not None]
    if not told:
        return None
    weight = np.array([1 / (g.variance + dark / count * g.by_black) for g in told])
    weight, variance = weight / weight.sum(), float(1 / weight.sum())
    value, freedom = float(weight @ [g.value for g in told]), np.inf
    if patterns:
        scattered, freedom = scatter(np.tensordot(weight, [g.cells for g in told], 1))
        variance = max(scattered, variance)
    if not variance > 0 or freedom < 1:
        return None
    z = value / np.sqrt(variance)
    error = 0.5 * np.sqrt(variance)
    return Score(
        log_p=student_log_p(z, freedom) if patterns else normal_log_p(z),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=abs(value) / 2,
        error=error,
        shift=error,
        power=1,
        parameters={"relative_difference": (value, "1", 2 * error)},
        where={"axis": "channel", "channel": "Gr-Gb"},
        payload=value,
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


def two_greens(recorded: Recorded, *, names: tuple[str, str], parameter: str) -> tuple[Signature, Signature]:
    """A difference between the two greens, where noise alone scatters them and where patterns do too."""
    sites = recorded.greens
    look = looking_at(sites)

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

    def signature(name: str, patterns: bool) -> Signature:
        return Signature(
            name=name,
            axes=Axes("photons", "channel", "frozen", "signal", "contrast"),
            reads=STATIC | {"mean"},
            score=partial(green_score, look=look, patterns=patterns),
            absorb=unchanged,
            covers=names,
            predict=NO_LAW,
            pattern=pattern,
            simulate=strength(parameter, unit_map=True),
            place=placed(Point("photons", "mean", "channel", "frozen", "multiply"), unit_map=True),
            detectable=BY_SHIFT,
            least=least,
        )

    return signature(names[0], False), signature(names[1], True)


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
