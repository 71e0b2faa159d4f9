"""The KL divergence of noise histograms, exactly as Noise Flow and CA-NoiseGAN measure it, and its floor.

All values of a set are pooled into one histogram of 66 bins: 64 of width 0.2/64 on [-0.1, 0.1] and one beyond
each end. The reference metric keeps only the bins that both histograms occupy and does not renormalise, so it
can be negative and forgives a model that is far too narrow; `kl_smoothed_of_counts` adds one count to every
bin instead (as Noise2NoiseFlow does) and does not forgive. Both are KL(real || fake) in nats.

Two draws of *equal* noise do not give zero: their histograms are finite. `kl_floor` says what they give.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int64

# As one float64 expression, so that counts equal the reference's: the edge "at zero" is +8.3e-17, and an
# exact zero, which clipping makes common, falls into the bin below it.
EDGES = np.concatenate([[-1000.0], np.arange(-0.1, 0.1 + 1e-9, 0.2 / 64), [1000.0]])
BINS = EDGES.size - 1


def histogram(noise: Float[np.ndarray, "..."]) -> Int64[np.ndarray, "66"]:
    """Counts of noise values (normalised units) in the 66 bins; half-open on the right, the last closed.

    Raises ValueError for values that are not finite: no bin holds them, and a model must not gain by them.
    """
    noise = np.asarray(noise)
    wrong = noise.size - np.count_nonzero(np.isfinite(noise))
    if wrong:
        raise ValueError(f"noise: {wrong} of {noise.size} values are not finite")
    return np.histogram(noise, EDGES)[0]


def clipped_noise(
    noise: Float[np.ndarray, "..."], clean: Float[np.ndarray, "..."]
) -> Float[np.ndarray, "..."]:
    """What a recording clipped to [0, 1] shows of the noise: clip(clean + noise, 0, 1) - clean."""
    return np.clip(np.asarray(clean) + np.asarray(noise), 0, 1) - np.asarray(clean)


def kl_divergence(real: Float[np.ndarray, "..."], fake: Float[np.ndarray, "..."]) -> float:
    """KL(real || fake) of two sets of noise values by the reference metric, nats.

    66 bins, natural logarithm, bins that are empty in either set dropped, no renormalisation: may be
    negative, and is zero where no bin is shared.
    """
    return kl_of_counts(histogram(real), histogram(fake))


def kl_floor(
    real: Float[np.ndarray, "..."], fake_count: int | None = None, trials: int = 32, seed: int = 0
) -> float:
    """The KL that a *perfect* model would show at these sample sizes, nats: see `kl_floor_of_counts`."""
    return kl_floor_of_counts(histogram(real), fake_count, trials, seed)


def kl_of_counts(real: Int64[np.ndarray, "66"], fake: Int64[np.ndarray, "66"]) -> float:
    """`kl_divergence` of two histograms."""
    both = (real > 0) & (fake > 0)
    p, q = real[both] / real.sum(), fake[both] / fake.sum()
    return float(np.sum(p * np.log(p / q)))


def kl_smoothed_of_counts(real: Int64[np.ndarray, "66"], fake: Int64[np.ndarray, "66"]) -> float:
    """KL(real || fake) over all 66 bins with one count added to each, (count + 1) / (n + 66), nats; >= 0."""
    p = (real + 1) / (real.sum() + BINS)
    q = (fake + 1) / (fake.sum() + BINS)
    return float(np.sum(p * np.log(p / q)))


def kl_floor_of_counts(
    real: Int64[np.ndarray, "66"], fake_count: int | None = None, trials: int = 32, seed: int = 0
) -> float:
    """Mean KL of two independent histograms drawn from the real one, with its sizes: the finite-sample floor.

    Both sets are finite and both contribute: for n real and m model values in k well occupied bins the mean
    is about (k - 1) / 2 * (1/n + 1/m). That formula ignores thinly occupied and dropped bins, so the mean
    is taken over `trials` multinomial redraws instead, from a fixed `seed`. Values of one image are not
    fully independent (shared rows), so a real floor can lie slightly above this one.
    fake_count: number of model values; default as many as real ones.
    """
    count = int(real.sum())
    rng = np.random.default_rng(seed)
    share = real / count
    first = rng.multinomial(count, share, size=trials)
    second = rng.multinomial(fake_count or count, share, size=trials)
    return float(np.mean([kl_of_counts(a, b) for a, b in zip(first, second, strict=True)]))
