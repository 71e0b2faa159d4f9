"""Parameters of any mechanism by simulated moments: simulate, compare summary statistics, adjust, repeat.

For mechanisms without a likelihood or an estimator of their own. The statistics cover the five places where a
mechanism can show: mean field, variance field, covariances, shape, and stored codes. Simulations reuse the
same random numbers at every parameter (McFadden, Econometrica 57, 995, 1989), so that the difference between
two parameters is not noise; errors come from a parametric bootstrap through the linearised fit.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key
from scipy import stats

from cannoise_jax.physics.core.mechanism import Parameter
from cannoise_jax.physics.core.registry import mechanism
from cannoise_jax.physics.core.sensor import DEFAULT, SensorModel, Settings
from cannoise_jax.physics.core.settings import baseline_at
from cannoise_jax.physics.transfer.estimate import Estimate

_LAGS = ((0, 1), (1, 0), (1, 1), (0, 2), (2, 0), (2, 2))
_LEVELS = 6
_FAR = 6.0
_TAILS = (3.0, 5.0, 12.0, 40.0)
_STEP = 0.15
_LEAST_SLOPE = 1e-2
"""Of all statistics together, in their standard deviations per unit of the line: below, nothing is known."""
_STARTS = (0.1, 0.3, 1.0, 3.0, 10.0)


def summary_statistics(
    frames: Float[Array, "t h w"],
    mean: Float[Array, "h w"],
    sigma: Float[Array, "h w"],
    of_level: Float[Array, "h w l"],
    rails: tuple[float, float] = (0.0, 65535.0),
) -> Float[Array, "s"]:
    """What a set of frames looks like beside a baseline of expected values `mean` and noise `sigma`, DN.

    z = (frames - mean) / sigma, beyond 6 as its logarithm; of_level: see `level_weights`. In this order: mean
    and log-spread of z at six light levels; means of the four mosaic sites and of a 4 x 4 grid of blocks;
    covariances of z within a frame at six lags and to the next frame; log-variances of row, column and frame
    means, of the time average, and of how frame means change over one and four frames; moments and log-rates
    of the tails of z; shares of codes at the rails; shares equal to the same-colour neighbour, and per light
    level to the next frame. Fixed patterns count by their strength only, so that another unit of the same
    camera has the same expectation.
    """
    z = (jnp.asarray(frames, jnp.float32) - mean) / sigma
    h, w = z.shape[1:]
    # Rare values far out must not outweigh all others, but how far they are has to count.
    core = jnp.sign(z) * (jnp.minimum(jnp.abs(z), _FAR) + jnp.log1p(jnp.maximum(jnp.abs(z) - _FAR, 0.0)))
    level_mean = jnp.einsum("thw,hwl->l", core, of_level) / z.shape[0]
    level_square = jnp.einsum("thw,hwl->l", core**2, of_level) / z.shape[0]
    sites = jnp.stack([core[:, i // 2 :: 2, i % 2 :: 2].mean() for i in range(4)])
    tall, wide = h // 4 * 4, w // 4 * 4
    blocks = core[:, :tall, :wide].reshape(-1, 4, tall // 4, 4, wide // 4).mean((0, 2, 4)).ravel()
    lags = jnp.stack(
        [jnp.mean(core[:, dy:, dx:] * core[:, : h - dy, : w - dx]) for dy, dx in _LAGS]
        + [jnp.mean(core[1:] * core[:-1]) if len(z) > 1 else jnp.zeros(())]
        + [jnp.mean(core[:, 2:] * core[:, :-2] ** 2), jnp.mean(core[:, :, 2:] * core[:, :, :-2] ** 2)]
    )
    average = core.mean(0)
    spreads = [core.mean(2), core.mean(1), core.mean((1, 2)), average, average.mean(0), average.mean(1)]
    whole = core.mean((1, 2))
    steps = [jnp.mean((whole[k:] - whole[:-k]) ** 2) if len(z) > k else jnp.ones(()) for k in (1, 4)]
    shared = jnp.log(jnp.stack([*(jnp.var(s) for s in spreads), *steps]) + 1e-6)
    shape = jnp.stack([jnp.mean(core**3), jnp.log(jnp.mean(core**4)), jnp.mean(jnp.tanh(z) * jnp.abs(core))])
    tails = [jnp.mean(side * z > x) for side in (1, -1) for x in _TAILS]
    equal = jnp.stack(
        [jnp.mean(frames[:, :, 2:] == frames[:, :, :-2]), jnp.mean(frames[:, 2:] == frames[:, :-2])]
    )
    again = (frames[1:] == frames[:-1]).astype(jnp.float32).mean(0) if len(z) > 1 else jnp.zeros((h, w))
    stays = jnp.log(jnp.einsum("hw,hwl->l", again, of_level) + 1 / z.size)
    clipped = jnp.stack([jnp.mean(frames <= rails[0]), jnp.mean(frames >= rails[1])])
    rates = jnp.log(jnp.concatenate([jnp.stack(tails), clipped]) + 1 / z.size)
    return jnp.concatenate(
        [level_mean, jnp.log(level_square), sites, blocks, lags, shared, shape, rates, equal, stays]
    )


def level_weights(mean: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w l"]:
    """Weights that average over each of six equally large groups of pixels, from dark to bright."""
    rank = np.argsort(np.argsort(np.asarray(mean).ravel(), kind="stable")).reshape(mean.shape)
    group = rank * _LEVELS // mean.size
    return np.eye(_LEVELS, dtype=np.float32)[group] * np.float32(_LEVELS / mean.size)


class MomentsFit(NamedTuple):
    """Estimates by parameter name with bootstrap errors; the misfit is a chi-square per statistic beyond
    them.

    A parameter that no statistic depends on has an infinite error and its whole range as interval. misfit:
    near 1 where the simulator explains the statistics. converged: the last step was below a third of the
    error, and no parameter ended at a bound.
    """

    estimates: Mapping[str, Estimate]
    misfit: float
    converged: bool


def to_line(value, p: Parameter):
    """A parameter on the whole real line, by its transform."""
    if p.transform == "log":
        return np.log(max(value, 1e-30))
    share = np.clip(value, 1e-9, 1 - 1e-9)
    return np.log(share / (1 - share)) if p.transform == "logit" else value / _unit(p)


def from_line(x, p: Parameter):
    """Inverse of `to_line`, kept inside the parameter's bounds."""
    value = {"log": jnp.exp, "logit": jax.nn.sigmoid}.get(p.transform, lambda v: v * _unit(p))(x)
    return jnp.clip(value, p.low, p.high)


def _unit(p: Parameter) -> float:
    return abs(p.default) or 1.0


def fit_moments(
    simulate: Callable[[Key[Array, ""], Float[Array, "p"]], Float[Array, "s"]],
    observed: Float[np.ndarray, "s"],
    parameters: tuple[Parameter, ...],
    key: Key[Array, ""],
    *,
    simulations: int = 8,
    bootstrap: int = 40,
    steps: int = 8,
) -> MomentsFit:
    """Parameters at which the mean of simulated statistics meets the observed ones, by Gauss-Newton.

    simulate(key, x) -> statistics of one simulated set of the observed size; x: parameters on the line
      (`from_line`). Started at the best of 0.1 to 10 times the typical values. Statistics are weighted by
      their
      own variance over `bootstrap` simulations; the error includes that of the `simulations` averaged.
    """
    base_key, spread_key = jax.random.split(key)
    common = jax.random.split(base_key, simulations)
    batch = jax.jit(lambda keys, x: jax.lax.map(lambda k: simulate(k, x), keys))

    def moments(x) -> np.ndarray:
        return np.asarray(batch(common, jnp.asarray(x, jnp.float32)), np.float64).mean(0)

    def spread(x) -> np.ndarray:  # in batches of the same shape, so that one compiled function serves all
        rounds = -(-bootstrap // simulations)
        keys = jax.random.split(spread_key, (rounds, simulations))
        point = jnp.asarray(x, jnp.float32)
        return np.concatenate([np.asarray(batch(k, point), np.float64) for k in keys])[:bootstrap]

    middle = np.array([to_line(p.default, p) for p in parameters], np.float64)
    starts = [middle]
    for k, p in enumerate(parameters):
        for s in _STARTS:
            moved = middle.copy()
            moved[k] = to_line(float(np.clip(s * p.default, p.low, p.high)), p)
            starts.append(moved)
    scale = _scale(spread(middle))
    misses = [float(np.sum(np.minimum(np.abs((moments(x) - observed) / scale), 30) ** 2)) for x in starts]
    x = starts[int(np.argmin(misses))]
    scale = _scale(spread(x))

    def residual(x):
        return (observed - moments(x)) / scale

    def jacobian(x):
        shifts = _STEP * np.eye(len(x))
        return np.stack([(moments(x + s) - moments(x - s)) / (2 * _STEP * scale) for s in shifts], 1)

    def descend(x, steps: int):
        left = residual(x)
        for _ in range(steps):
            move = np.clip(np.linalg.lstsq(jacobian(x), left, rcond=1e-4)[0], -1.5, 1.5)
            for shrink in (1.0, 0.5, 0.25, 0.1):
                tried = residual(x + shrink * move)
                if tried @ tried < left @ left:
                    x, left = x + shrink * move, tried
                    break
            else:
                break
            if np.max(np.abs(move)) < 1e-3:
                break
        return x

    x = descend(x, steps)
    scale = _scale(spread(x))
    x = descend(x, 2)  # with the weights that belong to the end, not to the start
    draws = spread(x)
    left, slope = residual(x), jacobian(x)
    solve = np.linalg.pinv(slope, rcond=1e-4)
    shifted = ((draws - draws.mean(0)) / scale) @ solve.T * np.sqrt(1 + 1 / simulations)
    error = np.where(np.linalg.norm(slope, axis=0) > _LEAST_SLOPE, shifted.std(0, ddof=1), np.inf)
    estimates = {p.name: _estimate(x[k], error[k], bootstrap, p) for k, p in enumerate(parameters)}
    at_bound = any(not p.low < e.value < p.high for p, e in zip(parameters, estimates.values(), strict=True))
    settled = bool(np.all(np.abs(solve @ left) < 0.3 * error + 1e-3))
    misfit = float(left @ left / (1 + 1 / simulations) / max(int(np.isfinite(scale).sum()) - len(x), 1))
    return MomentsFit(estimates, misfit, settled and not at_bound)


def _scale(draws: Float[np.ndarray, "n s"]) -> Float[np.ndarray, "s"]:
    """Spread of each statistic; infinite where it is the same in all draws, as the share of values that never
    occur: a single count elsewhere would outweigh all others."""
    spread = draws.std(0)
    return np.where(spread > 1e-5, spread, np.inf)


def _estimate(x: float, error: float, bootstrap: int, p: Parameter) -> Estimate:
    if not np.isfinite(error):
        return Estimate(float(from_line(x, p)), np.inf, (p.low, p.high))
    half = float(stats.t.ppf(0.95, bootstrap - 1)) * error
    low, value, high = (float(from_line(v, p)) for v in (x - half, x, x + half))
    return Estimate(value, float(from_line(x + error, p) - from_line(x - error, p)) / 2, (low, high))


def fit_mechanism(
    id: str,
    model: SensorModel,
    frames: Float[np.ndarray, "t h w"],
    clean: Float[np.ndarray, "h w"],
    key: Key[Array, ""],
    settings: Settings = DEFAULT,
    **options,
) -> MomentsFit:
    """Parameters of one mechanism on top of a sensor model, from frames of a known clean mosaic.

    frames: DN, all of one setting; clean: normalised. The model is the camera without the mechanism; other
    units of it are drawn for every simulation. options: of `fit_moments`. Raises ValueError for an unknown
    id.

    What one setting cannot tell: the ISO at which a dual gain switches, whose error is infinite; the memory
    of a temperature drift, unless the frames are many times as many; step and exponent of lossy compression
    one by one, on light of one level. The errors are those of a linearised fit: of a drift with a memory of
    2 frames (2 K, 200 e-/s) they were too small by 1.4 at 256 frames and by 4 at 32 frames, where most fits
    do not settle (`converged`).
    """
    parameters = mechanism(id).parameters
    settings = dataclasses.replace(settings, frames=len(frames))
    mosaic = jnp.asarray(clean, jnp.float32)
    level = model.expected(mosaic, settings)
    summarise = partial(
        summary_statistics,
        mean=level,
        sigma=_baseline_sigma(model, level, settings),
        of_level=jnp.asarray(level_weights(np.asarray(level))),
        rails=(0.0, float(np.asarray(model.white_level))),
    )

    def simulate(key, x):
        unit, draw = jax.random.split(key)
        values = {p.name: from_line(x[k], p) for k, p in enumerate(parameters)}
        camera = dataclasses.replace(model.with_mechanism(id, **values), unit_key=unit)
        return summarise(camera.sample(draw, mosaic, settings).astype(jnp.float32))

    observed = np.asarray(summarise(jnp.asarray(np.asarray(frames), jnp.float32)), np.float64)
    return fit_moments(simulate, observed, parameters, key, **options)


def _baseline_sigma(model: SensorModel, level: Array, settings: Settings) -> Array:
    """Noise of the Poisson-Gaussian baseline with its rounding at every pixel, DN."""
    h, w = level.shape
    rows, columns = np.arange(h)[:, None] % 2, np.arange(w)[None, :] % 2
    gain, read, black = (
        jnp.asarray(v).reshape(2, 2)[rows, columns]
        for v in (*baseline_at(model, settings.iso), model.black_level)
    )
    step = jnp.maximum(jnp.asarray(model.code_step), 1.0)
    return jnp.sqrt(gain * jnp.maximum(level - black, 0.0) + (gain * read) ** 2 + step**2 / 12)
