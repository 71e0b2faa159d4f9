"""Pixels that jump between two levels (random telegraph signals), from repeated darks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy import optimize, special

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.dark_pixels import fit_errors, hessian
from cannoise_jax.physics.transfer.estimate import Z90, Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimators.pick import (
    darkest,
    odd_by_charge,
    repeated_darks,
    steady_pixels,
)
from cannoise_jax.physics.transfer.fit import median_quotient, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quiet import coarse
from cannoise_jax.physics.transfer.regions import uneven_noise
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site

_LOUD = 2.0
"""Standard deviations of the quiet pixels' noise above which a pixel may jump."""
_MAY_BE_LOUD = 1.3
"""The same above which a pixel bears on the strength of jumps: of sixteen frames of Gaussian noise one in
twenty has as much, of sixty hardly any."""
_MOST_VALUES = 600_000
"""Pixels times frames whose likelihood is maximized, in each of some hundred steps."""
_NOISIER = np.geomspace(1.4, 20.0, 12)
"""Noise of pixels that are only noisier, in units of the quiet ones': any of these, with equal chances."""
_HEIGHTS = np.geomspace(0.4, 2.5, 9)
"""Jumps of single pixels over the typical one: any of these, with equal chances."""
_CHANCES = 4000
"""Pixels drawn to tell how much the variances of such jumps differ by chance: to two percent."""
_LEAST_NATS = 12.0
"""Log likelihood that jumps have to gain over pixels that are only noisier: see `dark_pixels`."""
_UNSURE = float(np.log(2))
"""Standard error of the logarithm of a jump beyond which its size is not known: a factor of two."""
_NOT_TOLD = NotMeasurable("jumps of so many pixels are not told from unlike noise: record more darks")


def rts(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """jump_dn, fraction and rate: maximum likelihood of two-state Markov chains in Gaussian noise, mixed with
    quiet pixels and with such whose noise is Gaussian too, but larger. Of the two levels of a pixel one is
    that of its channel, or both lie about it. Warm pixels, whose own charge explains their noise, do not
    count."""
    dark = darkest(statistics)
    if dark is None or dark.recording.count < 8:
        return repeated_darks(statistics, 8, 100)
    if why := uneven_noise(dark) or coarse(dark):
        return NotMeasurable(why)
    series, sigma = standardised(dark)
    series = series[:, ~pixels_in_order(odd_by_charge(dark, None if baseline is None else baseline.gain))]
    spread = series.std(0)
    loud = spread > _LOUD
    if loud.sum() < 10:
        return NotMeasurable("fewer than ten pixels jump visibly: record more darks, or a larger frame")
    jump, share = float(2 * median(spread[loud])), special.logit(min(2 * loud.mean(), 0.4))
    count = series.shape[1]
    series, times = told_by(series, spread)
    noisier = noisier_odds(series)

    def negative(p: np.ndarray) -> float:
        odds = telegraph_odds(series, float(np.exp(p[0])), float(special.expit(p[2])))
        return -_mixed(odds, noisier, float(special.expit(p[1])), float(special.expit(p[3])), times)

    without = optimize.minimize_scalar(
        lambda p: -_mixed(noisier, noisier, 0.0, float(special.expit(p)), times), bounds=(-16.0, 2.0)
    )
    start = np.array([np.log(jump), share, special.logit(0.2), share - 3.0])
    fit = optimize.minimize(
        negative, start, method="Nelder-Mead", options={"xatol": 2e-4, "fatol": 2e-3, "maxfev": 350}
    )
    if without.fun - fit.fun < _LEAST_NATS:
        return NotMeasurable(
            "pixels that are noisier than others do not jump between two levels", answered=True
        )
    # As good as none are noisier where the fit takes all for jumps: then their share has no error.
    few = special.expit(fit.x[3]) < 1 / count
    free = slice(3) if few else slice(4)
    curvature = hessian(
        lambda p: negative(np.concatenate([p, fit.x[len(p) :]])),
        fit.x[free],
        np.array([0.03, 0.05, 0.05, 0.1])[free],
    )
    errors = fit_errors(curvature)
    if errors is None:
        return _NOT_TOLD
    errors = np.asarray(errors) * np.sqrt(times[0])  # the loud pixels that were not taken tell nothing
    if errors[0] > _UNSURE:
        return _NOT_TOLD
    sides = np.array([-Z90, 0.0, Z90])
    jumps = np.exp(fit.x[0] + errors[0] * sides) * sigma
    shares = [special.expit(fit.x[k] + errors[k] * sides) for k in (1, 2)]
    return {
        "jump_dn": Estimate(float(jumps[1]), float(jumps[1] * errors[0]), (float(jumps[0]), float(jumps[2]))),
        **{
            name: Estimate(float(v[1]), float(e * v[1] * (1 - v[1])), (float(v[0]), float(v[2])))
            for name, v, e in zip(("fraction", "rate"), shares, errors[1:3], strict=True)
        },
    }


def lasting(frames: int, rate: float) -> float:
    """Share of the variance of jumps that the mean of so many successive frames keeps."""
    apart = np.abs(np.subtract.outer(np.arange(frames), np.arange(frames)))
    return float(np.mean((1 - 2 * rate) ** apart))


def telegraph_sites(
    dark: FrameStatistics,
    jump_dn: float,
    fraction: float,
    rate: float,
    gain: Float[np.ndarray, "4"] | None = None,
) -> Float[np.ndarray, "H W"]:
    """1 at the pixels that are more likely telegraph signals than quiet, else 0. gain: DN/e-, by which warm
    pixels are told from them."""
    series, sigma = standardised(dark)
    at = _jumping(series, jump_dn / sigma, fraction, rate) & ~pixels_in_order(odd_by_charge(dark, gain))
    return _on_mosaic(at, dark.mean.shape)


def heights(
    dark: FrameStatistics,
    jump_dn: float,
    fraction: float,
    rate: float,
    gain: Float[np.ndarray, "4"] | None = None,
) -> Float[np.ndarray, "H W"]:
    """At telegraph pixels how high their jumps are over `jump_dn`, else 0: the root of their variance over
    what such jumps have. What their variances differ by beyond chance is theirs, as in James and Stein; for
    traps that are mostly empty, or mostly full, the jump of equal times at both levels."""
    series, sigma = standardised(dark)
    at = _jumping(series, jump_dn / sigma, fraction, rate) & ~pixels_in_order(odd_by_charge(dark, gain))
    found = np.zeros(at.shape)
    if at.any():
        found[at] = _heights(series[:, at], jump_dn / sigma / 2, rate)
    return _on_mosaic(found, dark.mean.shape)


def _jumping(
    series: Float[np.ndarray, "T n"], jump: float, fraction: float, rate: float
) -> Bool[np.ndarray, "n"]:
    """Pixels that are more likely telegraph signals than quiet; each of its own jump, any of `_HEIGHTS`."""
    odds, loud = np.full(series.shape[1], -np.inf), series.std(0) > _MAY_BE_LOUD
    each = [telegraph_odds(series[:, loud], h * jump, rate) for h in _HEIGHTS]
    odds[loud] = special.logsumexp(each, axis=0) - np.log(len(_HEIGHTS))
    # Pixels that are only noisier may be as many as those that jump.
    return np.minimum(odds + np.log(fraction) - np.log1p(-fraction), odds - noisier_odds(series)) > 0


def _heights(series: Float[np.ndarray, "T n"], half: float, rate: float) -> Float[np.ndarray, "n"]:
    """Of the jumps of these pixels, over twice `half`."""
    count = len(series)
    expected = half**2 * (1 - lasting(count, rate)) * count / (count - 1)
    own = (series.var(0, ddof=1) - 1) / expected
    rng = np.random.default_rng(0)
    turns = np.where(rng.random((count, _CHANCES)) < rate, -1.0, 1.0)
    drawn = half * np.cumprod(turns, 0) + rng.standard_normal(turns.shape)
    chance = drawn.var(0, ddof=1).var() / expected**2
    share = max(1 - chance / max(float(own.var()), 1e-30), 0.0)
    return np.sqrt(np.maximum(own.mean() + share * (own - own.mean()), 0.0))


def standardised(dark: FrameStatistics) -> tuple[Float[np.ndarray, "T n"], float]:
    """Pixels over frames less their channel's level, in units of the noise of its quiet pixels, and that
    noise, rms over the channels."""
    keep = steady_pixels(dark)
    levels = [float(site(dark.mean, c)[site(keep, c)].mean()) for c in range(4)]
    sigmas = []
    for c in range(4):
        variance = pixel_variance(dark, c)
        middle = float(median(variance)) / median_quotient(dark.dof)
        sigmas.append(float(np.sqrt(min(robust_mean_square(variance, dark.dof)[0], middle))))
    frames = np.concatenate([part.astype(np.float64) for part in chunks(dark.recording.frames)])
    columns = []
    for c in range(4):
        values = site(frames, c) - levels[c]
        # Rows are levelled by their quiet pixels alone, for a jump would move the mean of its row.
        quiet = np.sqrt(pixel_variance(dark, c)) < _LOUD * sigmas[c]
        rows = np.sum(values * quiet, -1) / np.maximum(quiet.sum(-1), 1)
        columns.append((values - (rows - rows.mean(0))[..., None]).reshape(len(frames), -1) / sigmas[c])
    return np.concatenate(columns, 1), float(np.sqrt(np.mean(np.square(sigmas))))


def pixels_in_order(values: Shaped[np.ndarray, "H W"]) -> Shaped[np.ndarray, "n"]:
    """One value a pixel in the order of `standardised`: channel by channel."""
    return np.concatenate([site(values, c).ravel() for c in range(4)])


def _on_mosaic(values: Shaped[np.ndarray, "n"], size: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """Values in the order of `pixels_in_order` at their pixels."""
    out = np.zeros(size)
    for c, part in enumerate(np.split(values, 4)):
        site(out, c)[...] = part.reshape(site(out, c).shape)
    return out


def _mixed(
    odds: Float[np.ndarray, "n"], noisier: Float[np.ndarray, "n"], fraction: float, share: float,
    times: Float[np.ndarray, "n"],
) -> float:  # fmt: skip
    """Log-likelihood of pixels of which `fraction` jump and of the others `share` are noisier, up to a
    constant (each frame's exp(-x^2/2)). odds, noisier: of each pixel against a quiet one, logarithms. times:
    for how many pixels each stands."""
    ordinary = np.logaddexp(np.log1p(-share), np.log(share) + noisier)
    if not fraction:
        return float(times @ ordinary)
    return float(times @ np.logaddexp(np.log1p(-fraction) + ordinary, np.log(fraction) + odds))


def told_by(
    series: Float[np.ndarray, "T n"], spread: Float[np.ndarray, "n"], seed: int = 0
) -> tuple[Float[np.ndarray, "T m"], Float[np.ndarray, "m"]]:
    """At most so many values of pixels that a fit of them takes seconds, and for how many pixels each stands.
    Loud pixels, which tell of jumps, come first. spread: standard deviations over the
    frames, in units of the noise."""
    most = max(_MOST_VALUES // (2 * len(series)), 1)
    rng, taken, times = np.random.default_rng(seed), [], []
    for part in (spread > _MAY_BE_LOUD, spread <= _MAY_BE_LOUD):
        inside = np.flatnonzero(part)
        kept = inside if inside.size <= most else np.sort(rng.choice(inside, most, replace=False))
        taken.append(kept)
        times.append(np.full(kept.size, inside.size / max(kept.size, 1)))
    return series[:, np.concatenate(taken)], np.concatenate(times)


def noisier_odds(series: Float[np.ndarray, "T n"]) -> Float[np.ndarray, "n"]:
    """Log-likelihood of each pixel as one of larger Gaussian noise less that as a quiet one."""
    square = np.sum(series**2, 0)
    each = [0.5 * square * (1 - s**-2) - len(series) * np.log(s) for s in _NOISIER]
    return special.logsumexp(each, axis=0) - np.log(len(_NOISIER))


def telegraph_odds(series: Float[np.ndarray, "T n"], jump: float, rate: float) -> Float[np.ndarray, "n"]:
    """Log-likelihood of each pixel as a telegraph signal less that as a quiet one; forward recursion. Its
    levels lie about that of its channel, or one of them is that and the other above or below, with equal
    chances."""
    half = jump / 2
    placed = [_two_levels(series, middle - half, middle + half, rate) for middle in (-half, 0.0, half)]
    return special.logsumexp(placed, axis=0) - np.log(len(placed))


def _two_levels(series: Float[np.ndarray, "T n"], low: float, high: float, rate: float) -> np.ndarray:
    up, down = np.full(series.shape[1], 0.5), np.full(series.shape[1], 0.5)
    middle, half, loglik = (high + low) / 2, (high - low) / 2, np.zeros(series.shape[1])
    for x in series:
        # exp(m x - m^2 / 2) of either level m, less what both share.
        lean = np.clip(half * (x - middle), -300, 300)
        up, down = up * np.exp(lean), down * np.exp(-lean)
        total = up + down
        loglik += np.log(total) + middle * x - (middle**2 + half**2) / 2
        up, down = up / total, down / total
        up, down = up + rate * (down - up), down + rate * (up - down)
    return loglik
