"""The law of every pixel of a camera model, its mechanisms taken along the chain, and what pixels share.

Frozen maps, gains and rails enter as they are; a full well cuts the Poisson charge before read noise is
added. Offsets that rows, columns and frames share, and the light of a whole frame, which moves pixels in
proportion to their light, are set apart. Nonlinearity is a straight line at each pixel's mean, with the
variance of the bent charge; of the others the closed form of mean and variance is used, their skewness left
out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.physics.core import fields
from cannoise_jax.physics.core.chain import along_chain, altered_noise, inside, maps_of, seen_at
from cannoise_jax.physics.core.mechanism import Context
from cannoise_jax.physics.core.mosaic_ops import cut_above
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve
from cannoise_jax.physics.likelihood.codes import CodeGrid
from cannoise_jax.physics.likelihood.crossed import stationary_factor

TINY = 1e-6


class Shared(NamedTuple):
    """Offsets that pixels share, DN: factors of rows `[H, K]` and columns `[W, K]`, sigma of a frame, and
    sigma of its light as a fraction, None: it does not vary. terms: the axis ("coloured" where it is not
    white) and sigma of each. lit: what the light alone adds to each pixel, `[1, H, W]`."""

    rows: list[Array]
    columns: list[Array]
    frame: Any
    light: Any
    terms: list[tuple[str, Any]]
    lit: Any = None


class PixelLaw(NamedTuple):
    """The law of every pixel `[H, W]` without what it shares with others. electrons: mean charge; black,
    read_sigma: DN; gain: DN/e-. tukey_lambda: shape of the read noise; poisson_share: 0 Gaussian, 1 Poisson;
    None: as usual. shared: a `Shared`. full_e: charge at which the pixel is full, None: never."""

    electrons: Array
    gain: Array
    black: Array
    read_sigma: Array
    grid: CodeGrid
    shared: Any
    tukey_lambda: Any = None
    poisson_share: Any = None
    full_e: Any = None

    @property
    def charge(self) -> tuple[Array, Array]:
        """Mean and variance of the charge, e- and e-^2."""
        if self.full_e is None:
            return self.electrons, jnp.maximum(self.electrons, 0.0)
        return cut_above(self.electrons, jnp.maximum(self.electrons, TINY), self.full_e)

    @property
    def mean(self) -> Array:
        """Expected value before rounding and clipping, DN."""
        return self.black + self.gain * self.charge[0]

    @property
    def variance(self) -> Array:
        """Variance of a pixel's own noise before rounding, DN^2."""
        return self.gain**2 * self.charge[1] + self.read_sigma**2


def pixel_law(model: SensorModel, clean: Float[np.ndarray, "h w"], settings: Settings) -> PixelLaw:
    """The law of a clean mosaic's pixels at a setting. Raises ValueError for a mechanism without
    likelihood."""
    context = context_of(model, jnp.asarray(clean, jnp.float32)[None], settings)
    values = resolve(model, context)
    noise = altered_noise(model, context, values)
    inner = inside(context, noise)
    gain = noise.gain_dn_per_e
    electrons = jnp.broadcast_to(context.mean_dn / gain, (1, *context.size))
    # Of n electrons, cut at `full`: the charge is lost + kept * n, the value start + gain * scale * charge.
    lost, kept, full = jnp.zeros(()), jnp.ones(()), None
    start, scale, read = context.black_level, jnp.ones(()), noise.read_noise_e * gain
    extra: Any = 0.0  # variance beside that of the n electrons, DN^2
    low: Any = 0.0
    high: Any = context.white_level
    shared = Shared([], [], 0.0, None, [])
    for i in along_chain(model):
        fitted = model.mechanisms[i]
        record = fitted.record
        if record.baseline is not None:
            continue
        if record.likelihood == "none" or record.sample is None:
            raise ValueError(f"{fitted.mechanism} has no likelihood: use the composite score")
        at = inner if record.acts_on in ("mean", "charge") else context
        maps = maps_of(model, i, values[i], at)

        def sample(x, record=record, value=values[i], maps=maps, at=at):
            return record.sample(jax.random.key(0), x, value, maps, at)

        if fitted.mechanism == "black_clipping":
            low = context.black_level + values[i]["level_dn"]
        elif fitted.mechanism == "saturation":
            cut = (values[i]["full_well_e"] - lost) / kept
            full = cut if full is None else jnp.minimum(full, cut)
            free = jax.scipy.special.ndtr((full - electrons) / jnp.sqrt(jnp.maximum(electrons, TINY)))
            extra, shared = extra * free**2, _lit(shared, lambda lit, free=free: lit * free)
        elif record.likelihood == "exact" and record.acts_on == "mean":
            before = electrons
            electrons = sample(before)
            shared = _lit(shared, lambda lit, s=sample, x=before, y=electrons: s(x + lit) - y)
            extra = extra * jnp.square(sample(before + 1) - electrons)
        elif record.likelihood == "exact" and record.acts_on == "charge":
            zero = sample(jnp.zeros_like(electrons))
            slope = sample(jnp.ones_like(electrons)) - zero
            lost, kept, extra = lost * slope + zero, kept * slope, extra * slope**2
            shared = _lit(shared, lambda lit, slope=slope: lit * slope)
        elif record.likelihood == "exact":
            # Affine in what it acts on, given the maps: two levels tell all.
            level = jnp.broadcast_to(context.black_level, electrons.shape)
            zero = sample(level)
            slope = sample(level + 1) - zero
            if fitted.mechanism == "bookkeeping":  # laid over the rails as well
                low, high = (sample(v + 0 * level) for v in (low, high))
            start = context.black_level + (start - context.black_level) * slope + (zero - level)
            scale, read, extra = scale * slope, read * jnp.abs(slope), extra * slope**2
            shared = _stretched(shared, jnp.mean(slope))
        else:
            shared, changed = _shared(fitted, record, values[i], context, inner, shared)
            if changed:
                if shared.light is not None and shared.lit is None:
                    shared = shared._replace(lit=electrons)
                continue
            if record.effect is None:
                raise ValueError(f"{fitted.mechanism} has no closed form: use the composite score")
            held = electrons if full is None else jnp.minimum(electrons, full)
            signal = gain * (lost + kept * held)
            if record.acts_on not in ("mean", "charge"):
                signal = start + scale * signal - context.black_level
            effect = record.effect(values[i], maps, seen_at(inner, signal))
            mean = 0.0 if effect.mean is None else effect.mean
            variance = 0.0 if effect.variance is None else effect.variance
            if record.acts_on == "mean":
                electrons, extra = electrons + mean / gain, extra + variance - gain * mean
            elif record.acts_on == "charge" and effect.mean is not None:
                shot = gain * jnp.maximum(signal, TINY)
                slope = jnp.sqrt(jnp.maximum(1 + variance / shot, TINY))
                lost = (signal + mean - slope * signal) / gain + slope * lost
                kept, extra = kept * slope, extra * slope**2
                shared = _lit(shared, lambda lit, slope=slope: lit * slope)
            else:
                start, extra = start + mean, extra + variance
    shared = _lit(shared, lambda lit: gain * scale * lit)
    black, gain = start + gain * scale * lost, gain * scale * kept
    read = jnp.sqrt(jnp.maximum(read**2 + extra, TINY))
    step = jnp.where(noise.code_step > 0, noise.code_step, 1.0)
    # Analogue values below the cut are stored as the code nearest to it.
    highest = jnp.minimum(jnp.round(high / step) * step, context.white_level)
    grid = CodeGrid(step, jnp.maximum(jnp.round(low / step) * step, 0.0), highest)

    def image(v) -> Array:
        return jnp.broadcast_to(v, (1, *context.size))[0]

    return PixelLaw(
        image(electrons), image(gain), image(black), image(read), CodeGrid(*(image(v) for v in grid)),
        shared, noise.tukey_lambda, noise.poisson_share, None if full is None else image(full),
    )  # fmt: skip


def _lit(shared: Shared, change) -> Shared:
    """With the light that each pixel has changed, if it varies."""
    return shared if shared.lit is None else shared._replace(lit=change(shared.lit))


def _stretched(shared: Shared, factor) -> Shared:
    """With the offsets multiplied by a factor; the light is not an offset."""
    return shared._replace(
        rows=[factor * v for v in shared.rows],
        columns=[factor * v for v in shared.columns],
        frame=factor * shared.frame,
        terms=[(name, jnp.abs(factor) * v) for name, v in shared.terms],
    )


def _shared(fitted, record, values, context: Context, inner: Context, shared: Shared) -> tuple[Shared, bool]:
    """The shared terms with those of one more mechanism, and whether it has any."""
    point, size = record.point, context.size
    if point.time != "redrawn" or point.distribution != "gaussian" or point.over not in _SHARED_OVER:
        return shared, False
    sigma = jnp.mean(values[record.scales])  # it may scale with the gains of the channels
    if point.combine == "multiply" and point.over != "whole":
        return shared, False
    if point.combine == "multiply":
        return shared._replace(light=sigma if shared.light is None else jnp.hypot(shared.light, sigma)), True
    if point.acts_on == "mean":
        sigma = sigma * jnp.mean(inner.gain_dn_per_e)
    if point.over == "whole":
        terms = [*shared.terms, ("frame", sigma)]
        return shared._replace(frame=jnp.hypot(shared.frame, sigma), terms=terms), True
    count = size[0] if point.over == "row" else size[1]
    if point.spectrum == "power_law":
        factor = sigma * stationary_factor(fields.power_law_correlation(jnp.mean(values["exponent"]), count))
    elif point.group > 1:
        group = fields.group_of(point, size)
        factor = sigma * jnp.asarray(group[:, None] == np.arange(group[-1] + 1), jnp.float32)
    else:
        factor = sigma * jnp.eye(count)
    lone = point.spectrum == "white" and point.group == 1
    terms = [*shared.terms, (point.over if lone else "coloured", sigma)]
    if point.over == "row":
        return shared._replace(rows=[*shared.rows, factor], terms=terms), True
    return shared._replace(columns=[*shared.columns, factor], terms=terms), True


_SHARED_OVER = ("row", "column", "whole")
