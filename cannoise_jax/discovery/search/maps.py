"""Frozen maps of accepted findings, told together by what is left once all of them are taken out."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures import joint
from cannoise_jax.signatures.fields import Fields, quoted_at
from cannoise_jax.signatures.handed import Predicted


def patterns(steps: tuple[Step, ...], rng: np.random.Generator) -> list[np.ndarray | None]:
    """A draw of the frozen map of every step, None for one that has none: of maps of independent values all
    together, at the longest exposure where they grow with it, and of others each by itself. Where single
    pixels were found, what they have beyond all others is measured: no map that scales alike adds to it."""
    out: dict[int, np.ndarray | None] = {}
    for fields, places in _together(steps):
        maps = [_map_of(steps[n]) for n in places]
        draws = joint.drawn(fields, maps, _sigmas(steps, fields, places), rng)
        for n, one, values in zip(places, maps, draws, strict=True):
            out[n] = None if values is None else values * quoted_at(fields, one.scaling)
    drawn = [
        out[n] if n in out else s.named.signature.pattern(s.before, s.named.score, rng)
        for n, s in enumerate(steps)
    ]
    of_pixels = {n: one.scaling for n in out if (one := _map_of(steps[n])).axis == "pixel"}
    for single, found in zip(steps, drawn, strict=True):
        signature = single.named.signature
        if found is None or not (signature.single_pixels and signature.frozen):
            continue
        for n, scaling in of_pixels.items():
            values = drawn[n]
            if values is not None and scaling == signature.axes.scales and values.shape == found.shape:
                drawn[n] = np.where(found != 0, 0.0, values)
    for n, scaling in of_pixels.items():
        values = drawn[n]
        if values is not None and scaling == "exposure":
            drawn[n] = values + _levels_of_sites(steps[n].before)
    return drawn


def _levels_of_sites(fields: tuple[Fields, ...]) -> Float[np.ndarray, "h w"]:
    """By how much the level of each site of the mosaic grows beyond that of all up to the longest dark, DN. A
    map is told beside the level of its site in each recording, which is taken out with it."""
    darks = [f for f in fields if f.kind in DARK and f.exposure_s is not None]
    seconds = np.array([float(f.exposure_s or 0.0) for f in darks])
    out = np.zeros(fields[0].mean.shape)
    if len(set(seconds)) < 2:
        return out
    levels = np.array([[median(f.mean[at]) - f.black[c] for c, at in enumerate(SITES)] for f in darks])
    beyond = levels - levels.mean(1, keepdims=True)
    slope = np.polyfit(seconds, beyond, 1, w=np.sqrt([f.frames for f in darks]))[0]
    for c, at in enumerate(SITES):
        out[at] = slope[c] * seconds.max()
    return out


def one_draw(steps: tuple[Step, ...]) -> list[np.ndarray | None]:
    """`patterns`, what the frames leave open always drawn alike."""
    return patterns(steps, np.random.default_rng(0))


def last_draw() -> Callable[[tuple[Step, ...]], list[np.ndarray | None]]:
    """`one_draw`, that of the same several steps not drawn again: models in which one strength is another."""
    last: tuple[tuple[Step, ...], list[np.ndarray | None]] = ((), [])

    def drawn(steps: tuple[Step, ...]) -> list[np.ndarray | None]:
        nonlocal last
        if len(steps) < 2:
            return one_draw(steps)
        if len(steps) != len(last[0]) or any(a is not b for a, b in zip(steps, last[0], strict=True)):
            last = steps, one_draw(steps)
        return last[1]

    return drawn


def predictions(steps: tuple[Step, ...]) -> list[Predicted | None]:
    """What every step predicts for new frames, maps of independent values with the others beside them."""
    out: dict[int, Predicted | None] = {}
    for fields, places in _together(steps):
        maps = [_map_of(steps[n]) for n in places]
        out |= dict(zip(places, joint.predicted(fields, maps, _sigmas(steps, fields, places)), strict=True))
    return [
        out[n] if n in out else s.named.signature.predict(s.before, s.named.score)
        for n, s in enumerate(steps)
    ]


def beside_others(steps: tuple[Step, ...], left: tuple[Fields, ...] = ()) -> tuple[Step, ...]:
    """The steps with the strengths of their maps as the fields tell them with all others in the model. left:
    fields of other frames with all of them taken out."""
    out = list(steps)
    for fields, places in _together(steps):
        maps = [_map_of(steps[n]) for n in places]
        for n, one, told in zip(places, maps, joint.strengths(left or fields, maps), strict=True):
            if told is not None:
                out[n] = steps[n]._replace(named=_at(steps[n].named, one, told, fields))
    return tuple(out)


def _at(named: Named, one: joint.FrozenMap, told: joint.Strength, fields: tuple[Fields, ...]) -> Named:
    """The finding at a strength in the unit of its map."""
    score, unit = named.score, quoted_at(fields, one.scaling)
    sigma, error, shift = (x * unit for x in told)
    name, (_, text, _) = next(iter(score.parameters.items()))
    parameters = {**score.parameters, name: (sigma, text, error)}
    changed = score.replace(amplitude=sigma, error=error, shift=shift, parameters=parameters)
    return named._replace(score=changed)


def _sigmas(steps: tuple[Step, ...], fields: tuple[Fields, ...], places: list[int]) -> list[float]:
    """Strengths in the units of the maps."""
    found = [(_map_of(steps[n]).scaling, steps[n].named.score.amplitude) for n in places]
    return [value / (quoted_at(fields, scaling) or 1.0) for scaling, value in found]


def _together(steps: tuple[Step, ...]) -> list[tuple[tuple[Fields, ...], list[int]]]:
    """The steps that are such maps, with the fields that are left of the search that found them."""
    out: dict[int, tuple[tuple[Fields, ...], list[int]]] = {}
    for n, step in enumerate(steps):
        if step.left and step.named.signature.map_of:
            out.setdefault(id(step.left), (step.left, []))[1].append(n)
    return list(out.values())


def _map_of(step: Step) -> joint.FrozenMap:
    assert step.named.signature.map_of
    return joint.FrozenMap(*step.named.signature.map_of, float(step.named.score.payload))
