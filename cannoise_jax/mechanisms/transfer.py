"""Charge that is left behind where a CCD shifts it to its amplifier, and comes out with the pixels read after
it.

Traps under the gates hold a share of every packet that passes and release it into those that follow: a tail
behind whatever is bright, on the side away from the register or the amplifier, longer the more packets pass
before a trap lets go, and stronger the farther a packet was shifted. Shifts of rows and those along the
register have traps, clocks and tails of their own.

The transfer is linear in the charge. Left out is what makes it less than that: traps fill up, so that large
packets, and those that follow others closely, lose a smaller share; a trap holds whole electrons, which adds
noise of its own; and traps of several kinds, whose tails add up. A register whose halves are shifted to
amplifiers at both ends has tails to both sides, of which this has the mean.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.mechanisms import imprints, looks
from cannoise_jax.mechanisms.entry import Entry, Examples
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter, effect_in_dn
from cannoise_jax.physics.core.mosaic_ops import shifted
from cannoise_jax.vocabulary import Term

_LAGS = 3
"""Pixels apart up to which the closed form has what two of them share."""


class _Tail(NamedTuple):
    """A tail along the lines of an array: the share `[n]` that each of them leaves behind, 0 of none, and
    what of that stays from one line to the next."""

    left: jax.Array
    stays: jax.Array


def _tail(values, n: int, sign: int) -> _Tail:
    """Of `n` lines in the order in which they are read; `sign` of the share that has this order."""
    size = jnp.maximum(sign * values["fraction"], 0.0)
    place = np.linspace(-1, 1, n) if n > 1 else np.zeros(1)
    left = jnp.clip(size * (1 + values["growth"] * place), 0.0, 1.0)
    return _Tail(left, jnp.exp(-1 / values["length_px"]))


def _run(x, own, given, stays, held):
    """own_i x_i + s_i along the first axis, where s, `held` at the second line, is what came from those
    before: s_{i+1} = stays s_i + given_i x_i. The first line stays as it is."""

    def step(s, line):
        value, mine, gives = line
        return stays * s + gives * value, mine * value + s

    return jnp.concatenate([x[:1], jax.lax.scan(step, held, (x[1:], own[1:], given[1:]))[1]])


def _charge(x, tail: _Tail):
    """Charge as it comes out; what was read before the first line was as bright as that."""
    return _run(x, 1 - tail.left, tail.left * (1 - tail.stays), tail.stays, tail.left[0] * x[0])


def _variance(mu, tail: _Tail):
    """Variance of independent charges of this variance as they come out."""
    first = tail.left * (1 - tail.stays)
    return _run(mu, (1 - tail.left) ** 2, first**2, tail.stays**2, tail.left[0] ** 2 * mu[0])


def _shared(mu, tail: _Tail, lag: int):
    """Covariance of the charge of every line with that `lag` lines on."""
    first = tail.left * (1 - tail.stays)
    later = tail.stays**lag
    own = (1 - tail.left) * first * tail.stays ** (lag - 1)
    inner = _run(mu, own, first**2 * later, tail.stays**2, later * tail.left[0] ** 2 * mu[0])
    return jnp.concatenate([tail.left[0] * tail.stays ** (lag - 1) * mu[:1], inner[1:]])


def _along(function, x, values, axis: int, *more):
    """A function of lines and tail for both orders of reading: one of them has a tail of none."""
    n = x.shape[axis]
    x = jnp.moveaxis(x, axis, 0)
    x = function(x, _tail(values, n, 1), *more)
    return jnp.moveaxis(function(x[::-1], _tail(values, n, -1), *more)[::-1], 0, axis)


def _transfer(id: str, axis: int, over: str, sentence: str, reference: str) -> Mechanism:
    """Transfer along one axis of `x[T, H, W]`: 1 from row to row, 2 within them."""

    def sample(key, x, values, maps, context):
        return _along(_charge, x, values, axis)

    def effect(values, maps, context):
        mu, gain = jnp.broadcast_to(context.mean_charge(), (1, *context.size)), context.gain_dn_per_e
        n, lags = context.size[axis - 1], {}
        for lag in range(1, min(_LAGS, n - 1) + 1):
            by = (lag, 0) if axis == 1 else (0, lag)
            lines = jnp.moveaxis(mu, axis, 0)
            down = jnp.moveaxis(_shared(lines, _tail(values, n, 1), lag), 0, axis)
            up = jnp.moveaxis(_shared(lines[::-1], _tail(values, n, -1), lag)[::-1], 0, axis)
            lags[by] = (gain * shifted(gain * jnp.ones_like(mu), *by) * (down + shifted(up, *by)))[0]
        variance = _along(_variance, mu, values, axis)
        return effect_in_dn(context, _along(_charge, mu, values, axis) - mu, variance - mu, lags=lags)

    return Mechanism(
        id=id,
        point=Point("pixel", "charge", "pixel", "redrawn", "multiply"),
        parameters=(
            Parameter("fraction", "1", 0.03, -0.45, 0.45, f"share left behind; below 0: it comes out {over}"),
            Parameter("length_px", "px", 2.0, 0.05, 100.0, "pixels over which what comes out falls to 1/e"),
            Parameter("growth", "1", 0.0, 0.0, 1.0, "share at the last pixel read over the mean, less 1"),
        ),
        equation=r"y_i = (1-f_i)\,e_i + (1-r)\,T_i,\quad T_{i+1} = r\,T_i + f_i\,e_i,\quad r = e^{-1/\ell}",
        sentence=sentence,
        reference=reference,
        needs=("dark", "flat"),
        confused_with=("crosstalk", "hot_pixels", "smear"),
        amplitude=lambda values, context: jnp.abs(values["fraction"]),
        sample=sample,
        effect=effect,
    )


PARALLEL_CTI = _transfer(
    "parallel_cti",
    1,
    "above",
    "Not all charge follows when rows are shifted: whatever is bright draws a tail along its column, to "
    "one side.",
    "Massey et al., An improved model of charge transfer inefficiency and correction algorithm for the "
    "Hubble Space Telescope, MNRAS 439, 887 (2014)",
)
SERIAL_CTI = _transfer(
    "serial_cti",
    2,
    "on the left",
    "Not all charge follows along the readout register: whatever is bright draws a tail along its row, to "
    "one side.",
    "Janesick, Scientific Charge-Coupled Devices, SPIE Press 2001, chapter 5",
)


ENTRIES: tuple[Entry, ...] = (
    Entry(
        Term("parallel_cti",
             "Charge that rows leave behind as they are shifted comes out with the rows read after them.",
             None, "sensor", "1", "share of the charge left behind", listed=540),
        PARALLEL_CTI,
        needs="darks with hot pixels or hits of cosmic rays, and flats",
        signatures=looks.always(
            looks.tails.tails(0, name="tail_column", before=imprints.TAILS, covers=looks.COVERS_NOTHING),
        ),
        examples=Examples("lags", shown={"fraction": 0.3}, strong={"fraction": 0.2, "growth": 0.5}),
    ),
    Entry(
        Term("serial_cti",
             "Charge that pixels leave behind along the readout register comes out with the next ones.",
             None, "sensor", "1", "share of the charge left behind", listed=550),
        SERIAL_CTI,
        needs="darks with hot pixels or hits of cosmic rays, and flats",
        signatures=looks.always(
            looks.tails.tails(1, name="tail_row", before=imprints.TAILS, covers=looks.COVERS_NOTHING),
        ),
        examples=Examples("lags", shown={"fraction": 0.3}, strong={"fraction": -0.2, "length_px": 1.0}),
    ),
)  # fmt: skip
