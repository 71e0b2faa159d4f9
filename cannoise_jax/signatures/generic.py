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

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import fft

from cannoise_jax.physics.core.chain import run_chain, to_codes
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import DEFAULT, Settings, context_of, resolve
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score, variance_component
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    CONTRASTS,
    COVERS_NOTHING,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    STATIC,
    Addition,
    Axes,
    Found,
    Many,
    Scales,
    Signature,
)

_FRAMES, _UNITS = 8, 4
"""Frames of each unit of the camera that are drawn, and units. Two mechanisms of the tests near the limit are
seen with .69 to .90 of the log p of four units by two, and with 1.04 to 1.07 of it by eight."""
_TYPICAL = 0.3
"""Root mean square of the effect, in units of the noise, at which its template is taken: below the noise, so
that clipping and rounding stay small. Of an additive effect no value from 0.1 to 1 changes the log p."""
_ENOUGH = 0.5
"""Coefficients that tell the noise, for each that tells the effect: with fewer the noise is that of all.
No value from 0.1 to 2 changes the log p of the two mechanisms."""
_LEAST_NOISE = 0.05
"""Share of the fitted variance that is noise at least. Nor does any from 0.01 to 0.2."""
_SEEN = 0.3
"""Share of its pixels that must be usable for a coefficient to count. Nor does any from 0.1 to 0.6, for
frames without a full pixel."""

Images = Float[np.ndarray, "n h w"]


class Basis(NamedTuple):
    """An orthonormal change of coordinates of images, and the axes over which it mixes pixels."""

    forward: Callable[[Images], Images]
    back: Callable[[Images], Images]
    mixes: tuple[int, ...]

    def level(self, mask: np.ndarray) -> Float[np.ndarray, "h w"]:
        """Variance of every coefficient where unit noise is seen through a mask, to the accuracy of the mean
        over the pixels that it mixes."""
        out = mask.astype(np.float64)
        for axis in self.mixes:
            out = np.broadcast_to(out.mean(axis, keepdims=True), out.shape)
        return out


def _cosines(axes: tuple[int, ...]) -> Basis:
    return Basis(
        lambda x: fft.dctn(x, axes=[a + 1 for a in axes], norm="ortho"),
        lambda x: fft.idctn(x, axes=[a + 1 for a in axes], norm="ortho"),
        axes,
    )


def _waves() -> Basis:
    """Hartley's transform, its own inverse: the basis of what looks alike everywhere."""

    def change(x: Images) -> Images:
        z = fft.fft2(x, norm="ortho")
        return z.real - z.imag

    return Basis(change, change, (0, 1))


def _sheared(sign: int) -> Basis:
    """Cosines along the diagonals, each closed to a ring."""

    def roll(x: Images, by: int) -> Images:
        rows, columns = np.indices(x.shape[1:])
        return x[:, rows, (columns + by * rows) % x.shape[2]]

    def ready(x: Images) -> Images:
        return fft.dct(roll(x, sign), axis=1, norm="ortho")

    return Basis(ready, lambda x: roll(fft.idct(x, axis=1, norm="ortho"), -sign), (0,))


def _blocks(side: int) -> Basis:
    """Cosines within square blocks; what does not fill one is left as it is."""

    def each(x: Images, change) -> Images:
        n, h, w = x.shape
        a, b = h // side * side, w // side * side
        inner = x[:, :a, :b].reshape(n, a // side, side, b // side, side)
        out = x.copy()
        out[:, :a, :b] = change(inner, axes=(2, 4), norm="ortho").reshape(n, a, b)
        return out

    return Basis(lambda x: each(x, fft.dctn), lambda x: each(x, fft.idctn), ())


BASES: tuple[Basis, ...] = (
    Basis(lambda x: x, lambda x: x, ()),
    _cosines((1,)),
    _cosines((0,)),
    _cosines((0, 1)),
    _waves(),
    _sheared(1),
    _sheared(-1),
    _blocks(8),
    _blocks(16),
    _blocks(32),
)


class Template(NamedTuple):
    """Mean power of every coefficient at the strength `at`, in units of the noise and relative to its mean
    over all coefficients; power: that mean, per recording. stays: whether the effect does. unit: what the
    quoted amplitude is per strength."""

    basis: Basis
    shape: Float[np.ndarray, "h w"]
    power: dict[int, float]
    stays: bool
    at: float
    unit: float


def strength_of(record: Mechanism) -> Parameter:
    """The parameter that is fitted."""
    wanted = record.scales or record.parameters[0].name
    return next(p for p in record.parameters if p.name == wanted)


def _camera(field: Fields, recorded: Recorded, seed: int = 0) -> tuple[SensorModel, Any, Settings]:
    """A camera with the noise of one recording, what it sees there, and how it is set."""
    sigma2 = field.sigma.astype(np.float64) ** 2
    gain = max(float(np.mean(field.gain)), 1e-6)
    read = float(np.sqrt(np.median(sigma2 * (1 - field.shot)))) / gain
    black = float(np.mean(field.black))
    seconds = field.exposure_s if field.exposure_s is not None else DEFAULT.exposure_s
    iso = next((b.iso for b in recorded.baselines[field.group : field.group + 1]), None) or DEFAULT.iso
    settings = Settings(iso, seconds, None, _FRAMES)
    base = SensorModel.poisson_gaussian(
        gain, max(read, 1e-6), black, black + recorded.span, iso=iso, code_step=recorded.step
    )
    base = dataclasses.replace(base, unit_key=jax.random.key(seed))
    clean = jnp.asarray(np.clip(field.signal / recorded.span, 0, 1), jnp.float32)[None]
    return base, clean, settings


def effect(record: Mechanism, strength: float, field: Fields, recorded: Recorded, seed: int) -> Images:
    """Change that a mechanism makes to frames of one unit, in units of the noise of a recording's pixels."""
    base, clean, settings = _camera(field, recorded, seed)
    values: dict[str, Any] = {strength_of(record).name: strength}
    both = (base, base.with_mechanism(record, **values))
    without, with_it = (_values(m, clean, settings, seed) for m in both)
    if not np.isfinite(with_it).all():
        raise BadInput(f"{record.id}: its sampler draws values that are not finite, at {values}: mend it")
    return np.asarray(with_it - without, np.float64) * field.weight


def _values(model: SensorModel, clean, settings: Settings, seed: int) -> np.ndarray:
    """Values in DN before they are rounded, or after where a mechanism changes the codes."""
    context = context_of(model, clean, settings)
    values, key = resolve(model, context), jax.random.key(seed + 1)
    y, step = run_chain(model, key, context, values, _FRAMES)
    if any(f.record.acts_on == "code" for f in model.mechanisms):
        y = to_codes(model, key, y, step, context, values)
    return np.asarray(y, np.float64)


def learned(record: Mechanism, fields: Many, recorded: Recorded) -> Template | None:
    """The template of a mechanism at the settings of some recordings; None where none of them shows it."""
    fitted = strength_of(record)
    # A mechanism that is off by default has a strength, too.
    strength = record.defaults()[fitted.name] or min(fitted.high, 1.0)
    least = max(float(np.sqrt(np.mean(effect(record, strength, f, recorded, 0) ** 2))) for f in fields)
    if not least > 0:
        return None
    strength = float(min(strength * _TYPICAL / least, fitted.high))
    stays = record.point.time == "frozen"
    images = [_drawn(record, strength, f, recorded, stays) for f in fields]
    power = {f.number: max(float(np.mean(a * b)), 0.0) for f, (a, b) in zip(fields, images, strict=True)}
    if not any(power.values()):
        return None
    best, chosen = -1.0, (BASES[0], np.ones(fields[0].mean.shape))
    whole = sum(len(a) * power[f.number] for f, (a, _) in zip(fields, images, strict=True))
    for basis in BASES:
        halves = [
            2 * sum(np.sum(basis.forward(a[part]) * basis.forward(b[part]), 0) for a, b in images) / whole
            for part in (slice(0, None, 2), slice(1, None, 2))
        ]
        first, second = (np.maximum(0.1 * h, 0.0) for h in halves)
        gain = float(np.sum((1 + second) * first / (1 + first) - np.log1p(first)))
        if gain > best:
            best, chosen = gain, (basis, np.maximum((halves[0] + halves[1]) / 2, 0.0))
    # Its amplitude is quoted where it shows most.
    shown = max(fields, key=lambda f: power[f.number])
    context = context_of(*_camera(shown, recorded))
    quoted = record.amplitude({**record.defaults(), fitted.name: strength}, context)
    return Template(*chosen, power, stays, strength, float(np.mean(np.asarray(quoted))) / strength)


def _drawn(
    record: Mechanism, strength: float, field: Fields, recorded: Recorded, stays: bool
) -> tuple[Images, Images]:
    """Draws of an effect whose products have the mean of its power: contrasts between frames with themselves;
    of what stays the means of two halves of the frames, which the noise that comes with it does not share,
    less the level of each colour, which is fitted."""
    drawn = [effect(record, strength, field, recorded, seed) for seed in range(_UNITS)]
    if not stays:
        matrix = helmert(_FRAMES)
        moving = np.concatenate([np.einsum("nt,tij->nij", matrix, d) for d in drawn])
        return moving, moving
    halves = [np.array([d[part].mean(0) for d in drawn]) for part in (slice(0, None, 2), slice(1, None, 2))]
    for half in halves:
        for at in SITES:
            half[:, *at] -= half[:, *at].mean((1, 2), keepdims=True)
    return halves[0], halves[1]


def by_sampling(
    record: Mechanism, *, name: str, known: dict[tuple, Template | None], simulated: bool
) -> Callable[[Recorded], tuple[Signature, ...]]:
    """The signature of a mechanism by its sampler. known: templates by what they were learned at, for all
    splits of one run. simulated: whether it is the camera's, so that a camera model holds it."""
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

        def simulate(found: Found) -> Addition:
            return Addition({fitted.name: found.score.parameters[fitted.name][0]}, record=record)

        return (
            Signature(
                name=name,
                axes=Axes(point.stage, point.over, point.time, scales, "by its sampler"),
                reads=CONTRASTS | STATIC,
                score=score,
                absorb=absorb,
                covers=COVERS_NOTHING,
                predict=NO_LAW,
                pattern=NO_PATTERN,
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
        quoted = seen.unit
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
