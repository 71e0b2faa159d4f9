"""The signature of a mechanism of which nothing is known but its sampler.

Frames are drawn with and without it, with the same random numbers: what is left of their difference, in units
of the noise of the recordings, is the effect alone. Its mean power in an orthonormal basis is the template:
of noise alone every coefficient has the power 1, with the effect 1 + v c. The basis is the one, of a few, in
which draws that took no part in the template stand out most: that is chosen before any recording is seen, so
that no search has to be paid for. From there on it is a variance component like any other, with its exact
null law.

The strength alone is fitted; all other parameters are taken to have their typical values. Effects that are
new in every frame are looked for in differences between frames, those that stay in the mean of the frames.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Addition, Found, Many
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.sampled import Template, answer, learned, strength_of
from cannoise_jax.signatures.score import Score, variance_component
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PLACE,
    NOT_SIMULATED,
    STATIC,
    Axes,
    Scales,
    Signature,
)

BY_ITS_SAMPLER = "by its sampler"
"""The law of one number of such a mechanism: none in closed form."""
_ENOUGH = 0.5
"""Coefficients that tell the noise, for each that tells the effect: with fewer the noise is that of all.
No value from 0.1 to 2 changes the log p of two mechanisms of the tests."""
_LEAST_NOISE = 0.05
"""Share of the fitted variance that is noise at least. Nor does any from 0.01 to 0.2."""
_SEEN = 0.3
"""Share of its pixels that must be usable for a coefficient to count. Nor does any from 0.1 to 0.6, for
frames without a full pixel."""

MapsOf = Callable[[Float[np.ndarray, "h w"], Mapping[str, float]], Mapping[str, Any]]
"""From what a mechanism adds, as it was recorded, and its parameters to the maps that make it do so."""


def by_sampling(
    record: Mechanism,
    *,
    name: str,
    known: dict[tuple, Template | None],
    simulated: bool,
    maps_of: MapsOf | None = None,
) -> Callable[[Recorded], tuple[Signature, ...]]:
    """The signature of a mechanism by its sampler. known: templates by what they were learned at, for all
    splits of one run. simulated: whether it is the camera's, so that a camera model holds it. maps_of: keeps
    the pattern that was recorded."""
    point, fitted = record.point, strength_of(record)
    thermal = record.scaling.exposure or fitted.unit.endswith("/s")
    scales: Scales = "signal" if point.combine == "multiply" else "exposure" if thermal else "additive"

    def signatures(recorded: Recorded) -> tuple[Signature, ...]:
        def template(fields: Many) -> Template | None:
            key = tuple((f.number, f.kind, f.exposure_s, f.mean.shape) for f in fields)
            numbers = {f.number for f in fields}
            same = (t for t in known.values() if t is not None and numbers <= set(t.power))
            found = next((t for t in same if t.shape.shape == fields[0].mean.shape), None)
            if found is None and key not in known:
                known[key] = learned(record, fields, recorded)
            return found or known[key]

        def score(fields: Many) -> Score[float] | None:
            seen = template(fields)
            sums = None if seen is None else _powers(fields, seen)
            return None if seen is None or sums is None else _scored(seen, *sums)

        def absorb(fields: Many, found: Score[float]) -> Many:
            seen = template(fields)
            return fields if seen is None else _whitened(fields, seen, found.payload)

        def pattern(fields: Many, found: Score[float], rng: np.random.Generator) -> np.ndarray | None:
            seen = template(fields)
            if maps_of is None or seen is None or not seen.stays:
                return None
            acts = {f.number: answer(record, seen.at, f, recorded) for f in fields}
            return _pattern(fields, seen, found.payload, acts, rng)

        def simulate(found: Found) -> Addition:
            values = {fitted.name: found.score.parameters[fitted.name][0]}
            maps: Mapping[str, Any] = {}
            if maps_of is not None and found.pattern is not None:
                maps = maps_of(found.pattern, {**record.defaults(), **values})
            return Addition(values, {name: as_map(m) for name, m in maps.items()}, record=record)

        return (
            Signature(
                name=name,
                axes=Axes(point.stage, point.over, point.time, scales, BY_ITS_SAMPLER),
                reads=CONTRASTS | STATIC,
                score=score,
                absorb=absorb,
                covers=COVERS_NOTHING,
                predict=NO_LAW,
                pattern=pattern,
                simulate=simulate if simulated else NOT_SIMULATED,
                place=NO_PLACE,
                detectable=BY_SHIFT,
                least=NO_CLOSED_FORM,
                approximate=True,
            ),
        )

    def _scored(seen: Template, power: np.ndarray, information: np.ndarray, dof: np.ndarray) -> Score[float]:
        fit = variance_component(power, information, dof)
        sigma = float(np.sqrt(fit.variance))
        error = fit.error / (2 * sigma) if sigma > 0 else float(np.sqrt(fit.error))
        quoted, error = seen.unit, float(np.hypot(error, 0.5 * min(seen.doubt, 1.0) * sigma))
        return Score(
            log_p=fit.log_p,
            gain=fit.gain,
            penalty=0.5 * float(np.log(max(np.sum(dof), 2.0))),
            amplitude=sigma * quoted,
            error=error * quoted,
            shift=float(np.sqrt(fit.shift)) * quoted,
            power=2,
            parameters={fitted.name: (sigma, fitted.unit, error)},
            where={"axis": point.over},
            payload=fit.variance,
        )

    return signatures


def _images(field: Fields, seen: Template) -> np.ndarray:
    """What of a recording the effect shows in, standardised."""
    if not seen.stays:
        return field.contrasts
    return np.zeros((0, *field.mean.shape)) if field.static is None else field.static[None]


def _powers(fields: Many, seen: Template) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Summed power, information per squared strength and degrees of freedom of the coefficients that the
    effect raises above the mean. The others tell the power of the noise beside it: it was fitted to all."""
    above = seen.shape > 1
    power, information, dof = [], [], []
    for f in fields:
        x, strength = _images(f, seen), seen.power.get(f.number, 0.0)
        if not len(x) or not strength:
            continue
        level = seen.basis.level(f.usable)
        usable = level > _SEEN
        used, others = above & usable, ~above & usable
        summed = np.sum(seen.basis.forward(x) ** 2, 0) / np.maximum(level, _SEEN)
        # The noise of a mean is known from the frames that it was taken of.
        noise, there = 1.0, 0.0 if seen.stays else 1.0
        if not seen.stays and others.sum() > _ENOUGH * used.sum():
            noise = max(float(summed[others].mean()) / len(x), _LEAST_NOISE)
            there = float(seen.shape[others].mean())  # of the effect, beside the noise
        scale = strength * (f.frames if seen.stays else 1.0) / seen.at**2
        power.append(summed[used] / noise)
        information.append((seen.shape[used] - there) * scale / noise)
        dof.append(np.full(int(used.sum()), float(len(x))))
    if not power or not np.sum([p.size for p in power]):
        return None
    return np.concatenate(power), np.concatenate(information), np.concatenate(dof)


def _pattern(
    fields: Many, seen: Template, variance: float, acts: dict[int, np.ndarray], rng: np.random.Generator
) -> Float[np.ndarray, "h w"]:
    """A draw of a pattern that stays, given what all recordings show of it: every coefficient keeps its share
    that is no noise, and the doubt that this leaves is drawn anew. acts: by recording, see `answer`."""
    size = fields[0].mean.shape
    score, information, power = np.zeros(size), np.zeros(size), np.zeros(size)
    for f in fields:
        for x in _images(f, seen):
            answer = np.sqrt(f.frames) * acts[f.number]
            score += answer * x
            information += answer**2
            power += f.frames * seen.power.get(f.number, 0.0) * variance / seen.at**2 * seen.shape
    root = np.sqrt(information)
    told = seen.basis.forward((score / np.maximum(root, 1e-30))[None])[0]
    share = power / (1 + power)
    drawn = seen.basis.back((share * told + np.sqrt(share) * rng.standard_normal(size))[None])[0]
    return np.where(root > 0, drawn / np.maximum(root, 1e-30), 0.0)


def _whitened(fields: Many, seen: Template, variance: float) -> Many:
    """The fields with the power of every coefficient brought back to that of noise."""
    out = []
    for f in fields:
        scale = seen.power.get(f.number, 0.0) * variance / seen.at**2
        if not scale:
            out.append(f)
            continue
        per_frame, per_mean = (np.sqrt(1 + scale * n * seen.shape) for n in (1.0, float(f.frames)))
        if not seen.stays and len(f.contrasts):
            kept = seen.basis.back(seen.basis.forward(f.contrasts) / per_frame)
            f = f._replace(contrasts=(kept * f.usable).astype(np.float32))
        if f.static is not None:
            by = per_mean if seen.stays else per_frame
            kept = seen.basis.back(seen.basis.forward(f.static[None]) / by)[0]
            f = f._replace(static=(kept * f.usable).astype(np.float32))
        out.append(f)
    return tuple(out)
