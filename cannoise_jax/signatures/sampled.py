"""What a mechanism of which nothing is known but its sampler looks like in recordings: draws with and without
it, with the same random numbers, and the template that they give."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.chain import run_chain, to_codes
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import DEFAULT, Settings, context_of, resolve
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.signatures.bases import BASES, Basis, Images
from cannoise_jax.signatures.fields import Fields, helmert, native
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.recorded import Recorded

_FRAMES, _UNITS = 8, 4
"""Frames of each unit of the camera that are drawn, and units. Two mechanisms of the tests near the limit are
seen with .69 to .90 of the log p of four units by two, and with 1.04 to 1.07 of it by eight."""
_MOST_UNITS, _MOST_DRAWN, _CERTAIN = 24, 1e8, 0.05
"""Units drawn at most to know the power of an effect, pixels of one recording drawn for it, and its relative
error that is certain enough: of an effect of one number a frame 28 contrasts tell it to 27 %."""
_LEAST_DRAWS = 24
"""Draws of every coefficient: a strong effect is told by the inverse of their mean power, of four of which
the mean is twice too large."""
_TYPICAL = 0.3
"""Root mean square of the effect, in units of the noise, at which its template is taken: below the noise, so
that clipping and rounding stay small. Of an additive effect no value from 0.1 to 1 changes the log p."""


class Template(NamedTuple):
    """Mean power of every coefficient at the strength `at`, in units of the noise and relative to its mean
    over all coefficients; power: that mean, per recording. stays: whether the effect does. unit: what the
    quoted amplitude is per strength. doubt: relative standard error of the power, by the number of draws."""

    basis: Basis
    shape: Float[np.ndarray, "h w"]
    power: dict[int, float]
    stays: bool
    at: float
    unit: float
    doubt: float = 0.0


def strength_of(record: Mechanism) -> Parameter:
    """The parameter that is fitted."""
    wanted = record.scales or record.parameters[0].name
    return next(p for p in record.parameters if p.name == wanted)


def _camera(field: Fields, recorded: Recorded, seed: int = 0) -> tuple[SensorModel, Any, Settings]:
    """A camera with the noise of one recording, what it sees there, and how it is set."""
    field = native(field)
    sigma2 = field.sigma.astype(np.float64) ** 2
    gain = max(float(np.mean(field.gain)), 1e-6)
    read = float(np.sqrt(median(sigma2 * (1 - field.shot)))) / gain
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
    return np.asarray(with_it - without, np.float64) * native(field).weight


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
    images = [_drawn(record, strength, f, recorded, stays, range(_UNITS)) for f in fields]
    drawn = {f.number: max(float(np.mean(a * b)), 0.0) for f, (a, b) in zip(fields, images, strict=True)}
    if not any(drawn.values()):
        return None
    best, basis = -1.0, BASES[0]
    whole = sum(len(a) * drawn[f.number] for f, (a, _) in zip(fields, images, strict=True))
    for tried in BASES:
        halves = [
            2 * sum(np.sum(tried.forward(a[part]) * tried.forward(b[part]), 0) for a, b in images) / whole
            for part in (slice(0, None, 2), slice(1, None, 2))
        ]
        first, second = (np.maximum(0.1 * h, 0.0) for h in halves)
        gain = float(np.sum((1 + second) * first / (1 + first) - np.log1p(first)))
        if gain > best:
            best, basis = gain, tried
    every = {
        f.number: _enough(record, strength, f, recorded, pair, stays=stays, basis=basis)
        for f, pair in zip(fields, images, strict=True)
    }
    power = {number: max(float(np.mean(p)), 0.0) for number, (p, _) in every.items()}
    whole = sum(len(p) * power[number] for number, (p, _) in every.items())
    shape = np.maximum(sum(products for _, products in every.values()) / max(whole, 1e-30), 0.0)
    # Its amplitude is quoted where it shows most.
    shown = max(fields, key=lambda f: power[f.number])
    context = context_of(*_camera(shown, recorded))
    quoted = record.amplitude({**record.defaults(), fitted.name: strength}, context)
    unit = float(np.mean(np.asarray(quoted))) / strength
    return Template(basis, shape, power, stays, strength, unit, _error(every[shown.number][0]))


def _error(powers: Float[np.ndarray, "n"]) -> float:
    """Relative standard error of the mean of powers."""
    mean = float(np.mean(powers))
    return float(np.std(powers)) / np.sqrt(len(powers)) / mean if mean > 0 else float("inf")


def _enough(
    record: Mechanism,
    strength: float,
    field: Fields,
    recorded: Recorded,
    pair: tuple[Images, Images],
    *,
    stays: bool,
    basis: Basis,
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "h w"]]:
    """Powers of draws of an effect, and the sum of the powers of their coefficients: of those at hand, and of
    so many more that their means are certain."""
    most = min(_MOST_UNITS, int(_MOST_DRAWN / (_FRAMES * field.mean.size)))
    powers, products, units = np.zeros(0), np.zeros(field.mean.shape), _UNITS
    while True:
        powers = np.append(powers, np.mean(pair[0] * pair[1], (1, 2)))
        products += np.sum(basis.forward(pair[0]) * basis.forward(pair[1]), 0)
        certain = len(powers) >= _LEAST_DRAWS and not _CERTAIN < _error(powers) < np.inf
        if certain or units >= most:
            return powers, products
        further = range(units, min(2 * units, most))
        pair, units = _drawn(record, strength, field, recorded, stays, further), further.stop


def _drawn(
    record: Mechanism, strength: float, field: Fields, recorded: Recorded, stays: bool, units: range
) -> tuple[Images, Images]:
    """Draws of an effect whose products have the mean of its power: contrasts between frames with themselves;
    of what stays the means of two halves of the frames, which the noise that comes with it does not share,
    less the level of each colour, which is fitted."""
    drawn = [effect(record, strength, field, recorded, seed) for seed in units]
    if not stays:
        matrix = helmert(_FRAMES)
        moving = np.concatenate([np.einsum("nt,tij->nij", matrix, d) for d in drawn])
        return moving, moving
    halves = [np.array([d[part].mean(0) for d in drawn]) for part in (slice(0, None, 2), slice(1, None, 2))]
    for half in halves:
        for at in SITES:
            half[:, *at] -= half[:, *at].mean((1, 2), keepdims=True)
    return halves[0], halves[1]


def answer(record: Mechanism, strength: float, field: Fields, recorded: Recorded) -> Float[np.ndarray, "h w"]:
    """What the mean of a recording answers, in units of the noise of a frame, to a unit of what a mechanism
    adds at the setting of its strength."""
    base, clean, settings = _camera(field, recorded)
    own = strength_of(record).name
    model = base.with_mechanism(record, **{own: strength})  # type: ignore[arg-type]
    factor = float(np.mean(np.asarray(resolve(model, context_of(model, clean, settings))[0][own]))) / strength
    if record.point.combine == "multiply":
        return factor * field.relative
    field = native(field)
    return factor * field.weight * (np.mean(field.gain) if record.acts_on in ("mean", "charge") else 1.0)
