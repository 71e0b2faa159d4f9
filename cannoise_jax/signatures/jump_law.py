"""How many pixels jump between levels, and by how much, where few do, others are noisier and a few were hit.

The noisiest pixels are looked at frame by frame (`two_levels`); of all others counts that they are not among
those. Every pixel is as quiet as most, on two levels or on three, whose distance has a gamma law, normal
noise of any strength, or quiet but for one frame; each kind has a share of its own. What no pixel tells is
how many small jumps go with the large ones: gamma laws of several shapes and means count as far as each is as
likely, and the errors hold what they differ by.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import special, stats

from cannoise_jax.signatures.log_sums import log_sum
from cannoise_jax.signatures.two_levels import high_counts, log_ratio_of_three, log_ratio_of_two

JUMPS = np.concatenate([[0.1, 0.25, 0.42], np.geomspace(0.6, 6.0, 18), np.geomspace(7.7, 60.0, 9)])
"""Distances of two levels that are told apart, standard deviations of the noise."""
NOISY = 0.02
"""Chance of a quiet pixel to be among those that are looked at frame by frame."""
_MEANS = np.concatenate([np.geomspace(0.8, 8.0, 20), np.geomspace(10.0, 30.0, 5)])
_SHAPES = (1.0, 2.0, 4.0, 8.0, 20.0, 80.0)
"""Means and shapes of the gamma law of the distances: from exponential to all of one size."""
_BETWEEN = 0.05
"""Noise of a pixel on levels beside that of most, over the distance: of far levels even a part of the step in
which distances are tried would be too far off."""
_LOUDER = np.geomspace(1.2, 300.0, 24)
"""Variances of noisier pixels over that of most, each as likely as the next."""
_HIT, _HITS = (2.0, 300.0), 12
"""Least and largest deviation of one frame that was hit, standard deviations, and how many are tried."""
_ROUNDS, _DRAWS = 40, 512
"""Rounds in which shares are found, and draws of how many frames are high. From five times as many rounds the
share moved by a hundredth of its error."""
_START, _LEAST = (0.004, 0.001, 0.001, 0.001), 1e-9
"""Shares of the kinds that are not quiet at the start, and the least."""
_TWO, _THREE = 1 / 4, 2 / 3
"""Variance of levels in which a pixel is as often, over the square of their distance."""
_OF_LAW = 0.1
"""Relative error of share and mean jump for how the frames of a trap divide between its levels, which is not
known: half of the time high, any share of it alike, or with a memory, 0.8 to 1.15 of the share came back."""
_UNLIKELY = 1e-3
"""Laws that are less likely than the others by so much are left out."""


class Kinds(NamedTuple):
    """Log-likelihood ratios to quiet noise of the pixels that are looked at: of two and of three levels by
    their distance, of noisier ones and of hit ones; and the log of the chance of a pixel of each kind not to
    be among them, over that of a quiet one."""

    levels: Float[np.ndarray, "2 n k"]
    others: Float[np.ndarray, "2 k"]
    missed: Float[np.ndarray, "2 n"]
    missed_others: Float[np.ndarray, "2"]


class Law(NamedTuple):
    """A law of the jumps: how likely it is, its nats, the chance of each distance, the shares of the kinds,
    quiet ones first, and the error of that of the pixels that jump."""

    likely: float
    nats: float
    weight: Float[np.ndarray, "n"]
    shares: Float[np.ndarray, "5"]
    error: float

    @property
    def share(self) -> float:
        """Of the pixels that jump."""
        return float(self.shares[1] + self.shares[2])

    @property
    def mean(self) -> float:
        """Distance of the levels, standard deviations of the noise."""
        return float(self.weight @ JUMPS)


class Jumping(NamedTuple):
    """Of pixels, the chance that they jump, and if they do their mean distance of levels and the mean
    variance that they have by it, in units of the noise."""

    chance: Float[np.ndarray, "k"]
    jump: Float[np.ndarray, "k"]
    variance: Float[np.ndarray, "k"]


def kinds_of(frames: list[Float[np.ndarray, "t k"]], limit: float) -> Kinds:
    """frames: of each recording, in units of the noise, of the pixels with a sum of squares about their mean
    above the limit."""
    about = [x - x.mean(0) for x in frames]
    squares = sum((np.sum(x**2, 0) for x in about), start=np.zeros(about[0].shape[1]))
    freedom = sum(len(x) - 1 for x in about)

    def of_levels(ratio: Callable[..., np.ndarray], jump: float) -> Float[np.ndarray, "k"]:
        noise = _inside(jump)
        inside = ratio([x / noise for x in about], jump / noise)
        return inside + 0.5 * squares * (1 - 1 / noise**2) - freedom * np.log(noise)

    levels = [[of_levels(ratio, float(j)) for j in JUMPS] for ratio in (log_ratio_of_two, log_ratio_of_three)]
    louder = [-0.5 * freedom * np.log(v) + 0.5 * squares * (1 - 1 / v) for v in _LOUDER]
    noisier = log_sum(np.array(louder)) - np.log(_LOUDER.size)
    missed = _missed(tuple(len(x) for x in about), round(limit, 6))
    return Kinds(np.array(levels), np.array([noisier, _hit(about)]), *missed)


def _inside(jump: float) -> float:
    """Noise of a pixel on levels over that of most."""
    return float(np.hypot(1.0, _BETWEEN * jump))


def _hit(about: list[Float[np.ndarray, "t k"]]) -> Float[np.ndarray, "k"]:
    """Log-likelihood ratio of one frame that is off by anything, evenly in its logarithm."""
    low, high = _HIT
    logs = []
    for x in about:
        left = 1 - 1 / len(x)
        even = 2 * np.maximum(np.abs(x) / left, low) * np.log(high / low)
        logs.append(0.5 * x**2 / left + 0.5 * np.log(2 * np.pi / left) - np.log(even))
    each = np.concatenate(logs)
    return log_sum(each) - np.log(len(each))


@lru_cache(maxsize=64)
def _missed(frames: tuple[int, ...], limit: float) -> tuple[np.ndarray, np.ndarray]:
    """Log chance of a sum of squares below the limit, over that of quiet noise, as `Kinds` has it."""
    freedom = sum(frames) - len(frames)
    rng, apart = np.random.default_rng(0), np.zeros((2, _DRAWS))
    for t in frames:
        high = rng.choice(t + 1, _DRAWS, p=np.exp(high_counts(t)))
        apart[0] += high * (t - high) / t
        at = rng.multinomial(t, [1 / 3] * 3, _DRAWS)
        apart[1] += at[:, 1] + 4 * at[:, 2] - (at[:, 1] + 2 * at[:, 2]) ** 2 / t
    apart = np.maximum(apart, 1e-9)
    noise = [(j, _inside(float(j)) ** 2) for j in JUMPS]
    jumping = np.array([stats.ncx2.cdf(limit / v, freedom, j**2 * apart / v).mean(1) for j, v in noise]).T
    noisier = np.mean(stats.chi2.cdf(limit / _LOUDER, freedom))
    hit = np.mean(stats.ncx2.cdf(limit, freedom, np.geomspace(*_HIT, _HITS) ** 2))
    quiet = np.log(stats.chi2.cdf(limit, freedom))
    of_levels, of_others = (
        np.log(np.maximum(x, 1e-300)) - quiet for x in (jumping, np.array([noisier, hit]))
    )
    return of_levels, of_others


def jump_laws(kinds: Kinds, unseen: int) -> list[Law]:
    """The laws that are likely. unseen: pixels that are not looked at."""
    laws = []
    for shape in _SHAPES:
        for mean in _MEANS:
            weight = JUMPS ** (shape - 1) * np.exp(-shape * JUMPS / mean) * np.gradient(JUMPS)
            laws.append(_law(kinds, weight / weight.sum(), unseen))
    best = max(law.nats for law in laws)
    told = [law._replace(likely=float(np.exp(law.nats - best))) for law in laws]
    told = [law for law in told if law.likely > _UNLIKELY]
    whole = sum(law.likely for law in told)
    return [law._replace(likely=law.likely / whole) for law in told]


def share_and_mean(laws: list[Law], pixels: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Share of the pixels that jump and mean distance of the levels, each with its error."""
    likely, share, error, mean = np.array([(x.likely, x.share, x.error, x.mean) for x in laws]).T
    spread = [np.sqrt(x.weight @ (JUMPS - x.mean) ** 2 / max(x.share * pixels, 1.0)) for x in laws]
    return _middle(likely, share, error), _middle(likely, mean, np.array(spread))


def _middle(likely: np.ndarray, values: np.ndarray, errors: np.ndarray) -> tuple[float, float]:
    """The middle of values that are so likely, by their logarithms, and its error."""
    middle = float(np.exp(likely @ np.log(values)))
    spread = likely @ (np.log(values / middle) ** 2 + (errors / values) ** 2) + _OF_LAW**2
    return middle, middle * float(np.sqrt(spread))


def jumping_pixels(kinds: Kinds, laws: list[Law]) -> Jumping:
    """What is known of the pixels that are looked at."""
    chance, jump, variance = np.zeros((3, kinds.others.shape[1]))
    for law in laws:
        log_weight = np.log(np.maximum(law.weight, 1e-300))[:, None]
        whole = log_sum(_seen(kinds, law.weight), law.shares)
        for ratio, share, of in zip(kinds.levels, law.shares[1:3], (_TWO, _THREE), strict=True):
            each = law.likely * np.exp(np.log(share) + log_weight + ratio - whole)
            chance += each.sum(0)
            jump += JUMPS @ each
            variance += of * JUMPS**2 @ each
    safe = np.maximum(chance, 1e-30)
    return Jumping(chance, jump / safe, variance / safe)


def _seen(kinds: Kinds, weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "5 k"]:
    """Log-likelihood ratio of every pixel that is looked at, by kind."""
    levels = [log_sum(k, weight) for k in kinds.levels]
    return np.concatenate([np.zeros((1, kinds.others.shape[1])), levels, kinds.others])


def _lost(kinds: Kinds, weight: Float[np.ndarray, "n"]) -> Float[np.ndarray, "5"]:
    """The same of every other pixel."""
    levels = [special.logsumexp(k, b=weight) for k in kinds.missed]
    return np.concatenate([[0.0], levels, kinds.missed_others])


def _law(kinds: Kinds, weight: Float[np.ndarray, "n"], unseen: int) -> Law:
    """The law with the shares of most likelihood."""
    seen, lost = _seen(kinds, weight), np.exp(_lost(kinds, weight))
    looked, top = seen.shape[1], seen.max(0, initial=0.0)
    scaled = np.exp(seen - top)
    share = np.array([1 - sum(_START), *_START])
    for _ in range(_ROUNDS):
        each, under = share[:, None] * scaled, share * lost
        expected = (each / each.sum(0)).sum(1) + unseen * under / under.sum()
        share = np.maximum(expected / (looked + unseen), _LEAST)
    whole, under = share @ scaled, share @ lost
    nats = float(np.sum(np.log(whole) + top) + unseen * np.log(under))
    slope, below = (scaled[1:] - scaled[0]) / whole, (lost[1:] - lost[0]) / under
    information = slope @ slope.T + unseen * np.outer(below, below) + np.diag(1 / share[1:] ** 2)
    error = float(np.sqrt(np.linalg.inv(information)[:2, :2].sum()))
    return Law(1.0, nats, weight, share, error)
