"""Likelihood that the frames of a pixel lie on levels, over that of the noise that it has without.

Which frames are high, and where the lower level lies, is summed over exactly: of T frames about their mean,
with levels 0 and a jump J apart, those with k of them high have the likelihood ratio

    exp(-J^2 k (T - k) / 2T) e_k(exp(J x_1), ..., exp(J x_T))

to none high, e_k the elementary symmetric polynomial, which is a recursion over frames; a level in between
makes it one of three terms a frame. How many are high has a law of its own in every recording: a trap that
changes seldom stays where it is in one and not in the next.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy import special

from cannoise_jax.signatures.log_sums import log_add, log_sum

EVEN = (2.0, 40.0)
"""Parameters, of which both are alike, of beta laws of the share of the time in the higher level, each as
likely: of traps that differ in it, and of those that are full half of the time."""


def log_ratio_of_two(
    frames: list[Float[np.ndarray, "t k"]], jump: float | Float[np.ndarray, "k"]
) -> Float[np.ndarray, "k"]:
    """Log-likelihood ratio of two levels this far apart, of every pixel. frames: of each recording, and
    jump, in units of the noise."""
    return sum((_two(x - x.mean(0), jump) for x in frames), start=np.zeros(frames[0].shape[1]))


def log_ratio_of_three(frames: list[Float[np.ndarray, "t k"]], jump: float) -> Float[np.ndarray, "k"]:
    """The same of three levels, each as far from the next, in which a pixel is as often."""
    return sum((_three(x - x.mean(0), jump) for x in frames), start=np.zeros(frames[0].shape[1]))


@lru_cache(maxsize=64)
def high_counts(frames: int) -> Float[np.ndarray, "t+1"]:
    """Log chance that so many of the frames of a recording are high."""
    k = np.arange(frames + 1)
    laws = [special.betaln(a + k, a + frames - k) - special.betaln(a, a) for a in EVEN]
    return _log_ways(frames) + special.logsumexp(laws, axis=0) - np.log(len(EVEN))


def _log_ways(frames: int) -> Float[np.ndarray, "t+1"]:
    """Log number of choices of so many of the frames."""
    k = np.arange(frames + 1)
    return special.gammaln(frames + 1) - special.gammaln(k + 1) - special.gammaln(frames - k + 1)


def _two(x: Float[np.ndarray, "t k"], jump: float | Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    number = len(x)
    k = np.arange(number + 1)[:, None]
    polynomial = _log_product(jump * x[:, None], 1)
    counted = (high_counts(number) - _log_ways(number))[:, None]
    each = counted - 0.5 * jump**2 * k * (number - k) / number
    return log_sum(polynomial + each)


def _three(x: Float[np.ndarray, "t k"], jump: float) -> Float[np.ndarray, "k"]:
    number, height = len(x), np.arange(1, 3)[:, None]
    terms = height * jump * x[:, None] - 0.5 * (height * jump) ** 2
    total = np.arange(2 * number + 1)[:, None]
    polynomial = _log_product(terms, 2)
    return log_sum(polynomial + 0.5 * (jump * total) ** 2 / number) - number * np.log(3)


def _log_product(terms: Float[np.ndarray, "t n k"], degree: int) -> Float[np.ndarray, "m k"]:
    """Log coefficients of the product over frames of 1 + sum_n exp(term_n) z^n, n from 1 to the degree."""
    number, _, pixels = terms.shape
    out = np.full((degree * number + 1, pixels), -np.inf)
    out[0] = 0.0
    for t in range(number):
        before = out[: degree * t + 1].copy()
        for n in range(degree):
            more, held = before + terms[t, n], slice(n + 1, degree * t + 1 + n)
            out[degree * t + 1 + n] = more[-1]  # the first of this order
            out[held] = log_add(out[held], more[:-1])
    return out
