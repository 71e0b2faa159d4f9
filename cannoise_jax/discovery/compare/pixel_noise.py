"""How unlike in noise the pixels of a sensor are, beyond what few frames show by chance.

The variance v of a pixel, over that of the bulk, is taken to follow an inverse gamma law of mean 1 and
variance u (shape a = 2 + 1/u), so that s, the mean square of n contrasts, follows (a - 1)/a F(n, 2a), and v
given s is

    v ~ inverse gamma of shape a + n/2 and scale a - 1 + n s/2

u is the covariance of the mean squares of two halves of the frames, of differences between two frames
that no other difference has: tails of the noise have no part in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.discovery.compare.shapes import SURE
from cannoise_jax.signatures.fields import helmert

_FEWEST = 4
"""Frames from which on their halves are compared."""
_LEAST = 2e-3
"""Variance of the variances below which pixels count as alike: noise of 4 % more or less."""
_ODD = 1e-3
"""Chance from which on a pixel stands out of the others."""
_FALSE = 0.1
"""Share of the pixels told as noisy that may be so by chance."""
_ROUNDS = 4
"""In which pixels that stand out are told anew: where variances scatter by 0.1 the first finds half of it."""
_LOWEST = 0.02
"""Quantile of the variances that stands for the quietest pixels: of thousands the least is one that scatters
most."""


class Uneven(NamedTuple):
    """Variance of the pixels' variances, in units of the bulk's squared, and its standard error."""

    value: float
    error: float


class Variances(NamedTuple):
    """Variance of every pixel over that of the bulk; odd: pixels that stand out; lowest: of the others; kept:
    pixels that would not stand out if all were alike."""

    values: Float[np.ndarray, "h w"]
    odd: Bool[np.ndarray, "h w"]
    lowest: float
    kept: Bool[np.ndarray, "h w"]

    @property
    def beyond(self) -> Float[np.ndarray, "h w"]:
        """What pixels have beyond the quietest."""
        return np.maximum(self.values - self.lowest, 0)

    @property
    def shared(self) -> float:
        """What those that are kept have of that on average."""
        return float(self.beyond[self.kept].mean())


def uneven(contrasts: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"], bulk: float) -> Uneven:
    """How unlike the pixels are, those aside that stand out; 0 of too few frames. contrasts: Helmert's, of
    n + 1 frames."""
    frames = len(contrasts) + 1
    if frames < _FEWEST or not usable.any():
        return Uneven(0.0, 0.0)
    matrix, n = helmert(frames), frames // 2
    pairs = (matrix[:, 1 : 2 * n : 2] - matrix[:, 0 : 2 * n : 2]).T.astype(np.float32) / np.sqrt(
        np.float32(2)
    )
    apart = np.einsum("kn,nij->kij", pairs, contrasts)
    halves = [np.mean(part**2, 0)[usable] / max(bulk, 1e-30) for part in np.array_split(apart, 2)]
    mean, value, error = (halves[0] + halves[1]) / 2, 0.0, 0.0
    for _ in range(_ROUNDS):
        kept = ~stand_out(mean, n, max(value, 0.0))
        first, second = (half[kept] - half[kept].mean() for half in halves)
        product = first * second
        value, error = float(product.mean()), float(product.std()) / np.sqrt(product.size)
    return Uneven(value, error)


def stand_out(ratio: Float[np.ndarray, "*n"], dof: int, spread: float = 0.0) -> Bool[np.ndarray, "*n"]:
    """Pixels noisier than the bulk by more than chance makes them, where pixels are as unlike as that."""
    limit = float(stats.chi2.isf(_ODD, dof)) / dof
    if spread:
        shape = 2 + 1 / spread
        limit = max((shape - 1) / shape * float(stats.f.isf(_ODD, dof, 2 * shape)), limit)
    return ratio > limit


def _noisy(ratio: Float[np.ndarray, "*n"], dof: int, spread: float) -> Bool[np.ndarray, "*n"]:
    """The pixels that `stand_out`, as far as they are more than chance puts there: of pixels that are alike
    one in a thousand does, and would be drawn as noisy as it happened to be (Benjamini and Hochberg)."""
    out = stand_out(ratio, dof, spread)
    shape = 2 + 1 / spread if spread else np.inf
    law = stats.f(dof, 2 * shape, scale=(shape - 1) / shape) if spread else stats.chi2(dof, scale=1 / dof)
    chance = np.sort(law.sf(ratio[out]))
    expected = chance * ratio.size / np.arange(1, chance.size + 1)
    told = np.flatnonzero(expected < _FALSE)
    return out & (law.sf(ratio) <= chance[told[-1]]) if told.size else np.zeros_like(out)


class Spread(NamedTuple):
    """Variance of the pixels' variances, recorded and as the simulator draws it by a law of its own, 0
    where that may be chance; the first is no smaller."""

    value: float
    drawn: float


def compared(recorded: Uneven, simulated: Uneven) -> Spread:
    """How unlike the recorded pixels are, beside the simulated."""
    own = simulated.value if simulated.value > max(SURE * simulated.error, _LEAST) else 0.0
    more, error = recorded.value - simulated.value, np.hypot(recorded.error, simulated.error)
    return Spread(own + (more if more > max(SURE * error, _LEAST) else 0.0), own)


def variances(ratio: Float[np.ndarray, "h w"], dof: int, spread: Spread, seed: int) -> Variances:
    """Variance of every pixel beside what the simulator draws, itself drawn given what its contrasts show;
    one where pixels are no more unlike than simulated ones.

    What simulated pixels are unlike by is no matter of this pixel: it makes the mean square less certain,
    like fewer contrasts. ratio: mean square of the contrasts of every pixel over that of the bulk; dof: their
    number; spread: u.
    """
    odd, kept = _noisy(ratio, dof, spread.value), ~stand_out(ratio, dof)
    more = spread.value - spread.drawn
    if not more > 0:
        return Variances(np.where(odd, ratio, 1.0), odd, 1.0, kept)
    shape, certain = 2 + 1 / more, 2 / (2 / dof + spread.drawn)
    mean = float(ratio[~odd].mean())
    scale = (shape - 1) * mean + certain * ratio / 2
    drawn = scale / np.random.default_rng(seed).gamma(shape + certain / 2, 1.0, ratio.shape)
    values = np.where(odd, ratio, drawn)
    return Variances(values, odd, min(float(np.quantile(values[~odd], _LOWEST)), 1.0), kept)
