"""What a point of the grammar does to the pixel statistics, in closed form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.mechanism import Context, Effect, Maps, Values
from cannoise_jax.physics.core.places import NEAR, place

_SHARED = ("row", "column", "frame")
"""Sites whose number all of their pixels share: fields of `Effect`."""


def signal_factor(point, context: Context) -> Any:
    """(signal / white level)^p, by which the strength of a `grammar.Point` follows the signal."""
    if not point.signal:
        return 1.0
    return (jnp.maximum(context.mean_dn, 0.0) / context.span_dn) ** point.signal


def effect_of(point, name: str) -> Callable[[Values, Maps, Context], Effect]:
    """The effect of a `grammar.Point` whose strength is the parameter `name`, in DN.

    Exact in mean, variance and covariances; the third and fourth cumulant are those of the field, without
    what a random light also does to the shot noise.
    """

    def effect(values: Values, maps: Maps, context: Context) -> Effect:
        gain, base = context.gain_dn_per_e, context.mean_dn
        strength = values[name] * signal_factor(point, context)
        # `reach`: DN by which one unit of the field moves the pixel; `own`: variance of what is multiplied.
        if point.combine == "multiply":
            reach = strength * base
        else:
            reach = strength * gain if point.acts_on == "mean" else strength
        own = gain * base * (point.acts_on != "mean")
        if point.acts_on in ("signal", "code"):
            own = own + (gain * context.read_noise_e) ** 2

        def brought(mean, square):
            """Variance that comes with a field of this mean and mean square: shot noise of the charge it
            adds, or the noise that it multiplies."""
            if point.acts_on == "mean":
                return gain * reach * mean
            factor = strength * (point.combine == "multiply")
            return own * (2 * factor * mean + factor**2 * square)

        if point.time == "frozen":
            field = maps["field"][0]
            changed = point.acts_on == "mean" or point.combine == "multiply"
            return Effect(mean=reach * field, variance=brought(field, field**2) if changed else None)
        return _of_time(point, values, maps, context, reach, brought)

    return effect


def _of_time(point, values: Values, maps: Maps, context: Context, reach, brought) -> Effect:
    """Of a field that differs from frame to frame."""
    mean, square, third, fourth = _cumulants(point, values, maps)
    power = reach**2 * square
    changes: dict[str, Any] = {"variance": power + brought(mean, square + mean**2)}
    if point.distribution == "sparse" and point.time not in ("telegraph", "modulated"):
        changes["mean"] = reach * mean
        changes["third"] = reach**3 * third
    if fourth is not None:
        changes["fourth"] = reach**4 * fourth
    if point.over in _SHARED and point.interleave == 1:
        changes[point.over] = power
    if point.time == "modulated":
        lags = fields.map_lags(maps["field"][0], reach**2)
    else:
        lags = _lags(point, values, context, power)
    if lags:
        changes["lags"] = lags
    if point.time == "telegraph":
        changes["temporal"] = {n: power * (1 - 2 * values["rate"]) ** n for n in (1, 2)}
    elif point.time == "drifting":
        changes["temporal"] = {n: power * jnp.exp(-n / values["memory_frames"]) for n in (1, 2)}
    return Effect(**changes)


def _cumulants(point, values: Values, maps: Maps) -> tuple[Any, Any, Any, Any]:
    """Mean, variance, third and fourth cumulant over frames of a unit field; None: zero as of a Gaussian."""
    if point.time == "modulated":
        return 0.0, maps["field"][0] ** 2, None, None
    if point.spectrum == "sinusoid":
        return 0.0, 0.5, None, -0.375
    if point.spectrum == "kernel":
        return 0.0, sum(v**2 for v in point.kernel), None, None
    if point.time == "telegraph":
        level = maps["field"][0]
        return 0.0, level**2, None, -2 * level**4
    if point.distribution == "gaussian":
        return 0.0, 1.0, None, None
    mean: Any
    square: Any
    third: Any
    if point.distribution == "tukey_lambda":
        mean, square, third = 0.0, 1.0, 0.0
        fourth = fields.excess_kurtosis(values["tukey_lambda"])
    else:
        # Raw moments of a share of exponential heights of unit mean square: n! / 2^(n/2) f^(1 - n/2).
        share = jnp.asarray(values["fraction"], jnp.float32)
        mean = fields.numbers_mean("sparse", values)
        three, four = 6 / 2**1.5 / jnp.sqrt(share), 6 / share
        square = 1 - mean**2
        third = three - 3 * mean + 2 * mean**3
        fourth = four - 4 * mean * three - 3 + 12 * mean**2 - 6 * mean**4
    if point.time == "drifting":  # a sum over the frames before, whose weights fall by rho
        rho = jnp.exp(-1 / jnp.asarray(values["memory_frames"], jnp.float32))
        third = third * (1 - rho**2) ** 1.5 / (1 - rho**3)
        fourth = fourth * (1 - rho**2) / (1 + rho**2)
    return mean, square, third, fourth


def _lags(point, values: Values, context: Context, power) -> dict[tuple[int, int], Any]:
    """Covariances at small lags, where `Effect.row`, `column` and `frame` do not tell them."""
    over, size = point.over, context.size
    if point.spectrum == "power_law":
        steps = fields.correlations(values["exponent"], over, size)
        return {fields.lag(over, k, size[1]): power * r for k, r in steps.items()}
    if point.spectrum == "sinusoid" and over == "pixel":
        down, across = values["frequency_y"], values["frequency_x"]
        return {
            (dy, dx): power * jnp.cos(2 * jnp.pi * (down * dy + across * dx)) for dy, dx in (*NEAR, (1, -1))
        }
    if point.spectrum == "sinusoid":
        return {
            fields.lag(over, k, size[1]): power * jnp.cos(2 * jnp.pi * values["frequency"] * k)
            for k in place(over).steps(size[1])
        }
    if point.spectrum == "kernel":
        return {lag: power * r for lag, r in fields.kernel_correlations(point.kernel).items()}
    if not point.plain:
        return fields.group_lags(point, size, power)
    return fields.site_lags(point, size, power)
