"""Whether what a name says is Gaussian noise of a spectrum, alike everywhere, is.

A name for noise of lines or along the scan says three things of the series beside how strong it is: that its
spectrum follows a power law, that it is normal at every scale, and that no frame, and no place in the frame,
is unlike the others. Statistics of its strength, scale by scale, are the same for a step, a train of pulses,
two levels and a wave of changing pitch as for noise of like spectrum, so a name may account for nearly all of
its nats and not be true.

Both tests are of sizes that do not grow with the strength: the share of the variance that lies at other
frequencies, and the excess kurtosis of the series itself, without its noise, in differences of neighbouring
means.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import optimize, stats

from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step, without_all
from cannoise_jax.signatures.fields import Fields, contrast_matrix
from cannoise_jax.signatures.handed import Series

ELSEWHERE = 0.15
"""Share of the variance at other frequencies than a power law and white noise have, beyond chance, from which
on it is another spectrum."""
_CHANCE = 1e-6
"""Probability that a spectrum of that law departs as far."""
UNEVEN, BOUNDED = 2.0, -0.7
"""Excess kurtosis of the series from which on it is no normal noise: of jumps here and there, and of few
levels (two: -2, a wave: -1.5)."""
_SURE = 6.0
"""Standard errors from which on that is no chance, of some ten scales."""
_A_BAND = 2
"""Bands of an octave."""
_FEWEST_BANDS = 6
"""Bands below which nothing is told of a spectrum: a power law beside white noise has three numbers."""
_FEWEST = 16
"""Places along the series, and differences of one frame, from which on it is looked at."""
_EVEN = 0.3
"""Spread of the information over the places, of the mean, up to which modes of a series tell its spectrum."""
_OTHERS = 0.25
"""Change of a band, by what other findings take out of it, of its power beyond the noise, from which on it is
theirs."""
_NEXT_TO_NONE = 0.01
"""Share of the power of a band below which nothing is taken out of it."""
_PARTS = 0.2
"""Share of the variance of differences that must be of the series itself: the kurtosis of its noise counts
sixteen times at most. Of rows of a hundred pixels it is a hundredth of that of a pixel."""
_SHORTEST = 16
"""Pixels along the scan of the means that are looked at, for the same reason."""


class Spectrum(NamedTuple):
    """Of every recording: mean power of its modes by band, white noise of the model: 1; contrasts, mean
    information; and the frequencies: modes of a band, and of every mode its frequency and its band."""

    power: Float[np.ndarray, "r b"]
    contrasts: Float[np.ndarray, "r"]
    information: Float[np.ndarray, "r"]
    modes: Float[np.ndarray, "b"]
    frequency: Float[np.ndarray, "m"]
    first: np.ndarray
    weight: Float[np.ndarray, "m"]


def not_gaussian(steps: tuple[Step, ...], n: int) -> Doubt | None:
    """What speaks against a step that names Gaussian noise of lines or along the scan; None: nothing does, or
    it names none."""
    named = steps[n].named
    if named.mechanism == UNKNOWN:
        return None
    whole = [s for f in steps[0].before if (s := named.signature.series(f, named.score)) is not None]
    if not whole:
        return None
    # Without what was found after it; what stays is in no contrast.
    alone = without_all((s for s in steps[n + 1 :] if not s.named.signature.frozen), steps[n].before)
    series = [s for f in alone if (s := named.signature.series(f, named.score)) is not None]
    axes = named.signature.axes
    along = "px" if axes.varies_over == "raster" else f"{axes.varies_over}s"
    return other_spectrum(series, whole, along) or other_law(series, _frames(alone, named))


def _frames(fields: tuple[Fields, ...], named) -> list[int]:
    """Frames of every recording that has a series."""
    return [f.frames for f in fields if named.signature.series(f, named.score) is not None]


def other_spectrum(series: list[Series], whole: list[Series], along: str = "px") -> Doubt | None:
    """What speaks against a spectrum: that much of the variance lies at other frequencies. whole: the same
    with all that was found in it; where that moves the power, it is not this series' to tell. along: what
    its periods count."""
    one, other = spectrum_of(series), spectrum_of(whole)
    if one is None or other is None or one.power.shape != other.power.shape:
        return None
    weight = one.contrasts[:, None] * one.modes
    before, after = (np.sum(weight * s.power, 0) / weight.sum(0) for s in (other, one))
    if not series[0].level:
        before = before * after[-1] / before[-1]
    noise = 1.0 if series[0].level else float(after[-1])
    own = np.abs(before - after) < np.maximum(_OTHERS * (after - noise), _NEXT_TO_NONE * after)
    if own.sum() < _FEWEST_BANDS:
        return None
    share, nats, where = departure(one, own, series[0].exponent > 0, series[0].level)
    if share < ELSEWHERE or nats < stats.chi2.isf(_CHANCE, own.sum()) / 2:
        return None
    law = "a power law" if series[0].exponent else "white noise"
    what = f"{100 * share:.0f} % of its variance lies at other frequencies than {law} has, most at periods of"
    return Doubt(min(share, 1.0), (f"{what} {where:.3g} {along}",), instead=True)


def spectrum_of(series: list[Series]) -> Spectrum | None:
    """The spectrum of the recordings whose places all tell alike."""
    power, contrasts, information = [], [], []
    for s in series:
        mean = float(np.mean(s.information))
        if s.information.size != series[0].information.size or mean <= 0 or s.information.size < _FEWEST:
            continue
        if np.std(s.information) > _EVEN * mean:
            continue
        x = s.score / np.sqrt(mean)
        own = 1.0 if s.level else max(float(np.mean(np.asarray(x, np.float64) ** 2)), 1e-30)
        modes = np.abs(np.fft.rfft(x - x.mean(1, keepdims=True), axis=1)[:, 1:]) ** 2 / x.shape[1]
        power.append(modes.mean(0) / own)
        contrasts.append(float(len(x)))
        information.append(mean / own)
    if not power:
        return None
    size = series[0].information.size
    weight = np.ones(size // 2)
    weight[-1] -= 0.5 * (size % 2 == 0)  # the last mode of an even number is real
    octaves = np.log2(weight.size) * _A_BAND
    first = np.unique(np.round(2 ** (np.arange(int(octaves) + 1) / _A_BAND)).astype(int)) - 1
    modes = np.add.reduceat(weight, first)
    banded = np.add.reduceat(np.array(power) * weight, first, axis=1) / modes
    frequency = np.arange(1, weight.size + 1) / size
    return Spectrum(banded, np.array(contrasts), np.array(information), modes, frequency, first, weight)


def departure(
    seen: Spectrum, own: Bool[np.ndarray, "b"], coloured: bool, level: bool
) -> tuple[float, float, float]:
    """Share of the variance that lies elsewhere than the likeliest power law beside white noise has it,
    beyond what it does by chance, the nats that this costs, and the period where most is too much. own: bands
    that tell. coloured: whether it is a power law, else it is white; level: whether the noise is known to be
    1, else every recording has its own."""
    mean, weight = seen.power[:, own], (seen.contrasts[:, None] * seen.modes)[:, own]
    told, modes = seen.information[:, None], seen.modes[own]

    def shape(exponent: float) -> np.ndarray:
        values = np.add.reduceat(seen.frequency**-exponent * seen.weight, seen.first) / seen.modes
        return values / np.average(values[own], weights=modes)

    def cost(spectrum: np.ndarray) -> float:
        return float(np.sum(weight * (np.log(spectrum) + mean / spectrum)))

    start = np.maximum(1.0 if level else mean[:, -1:], 1e-9) * np.ones((len(mean), 1))
    rough = max(float(np.sum(weight * (mean - start)) / np.sum(weight * told)), 1e-3 * float(1 / told.max()))

    def law(p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The noise of every recording, and the excess of all bands."""
        noise = start if level else start * np.exp(p[3:, None])
        return noise, np.exp(p[1]) * shape(p[0]) + (np.exp(p[2]) if coloured else 0.0)

    def misfit(p: np.ndarray) -> float:
        noise, excess = law(p)
        return cost(noise + told * excess[own])

    log = np.log(rough)
    bounds = [(0.0, 3.0 if coloured else 0.0), (log - 12, log + 6), (log - 20, log + 3)]
    bounds += [] if level else [(-0.5, 0.5)] * len(mean)
    free = [0.0] * (len(bounds) - 3)
    fits = [
        optimize.minimize(misfit, np.array([a, log, log - 6, *free]), method="L-BFGS-B", bounds=bounds)
        for a in ((0.5, 1.0, 1.5, 2.0) if coloured else (0.0,))
    ]
    best = min(fits, key=lambda f: f.fun)
    noise, everywhere = law(best.x)
    excess = everywhere[own]
    found = excess.copy()
    for _ in range(50):  # Fisher scoring: the likeliest excess of every band by itself
        spectrum = noise + told * found
        slope = np.sum(weight * told * (mean - spectrum) / spectrum**2, 0)
        certain = np.sum(weight * told**2 / spectrum**2, 0)
        found = np.maximum(found + slope / certain, 0.0)
    total = max(float(seen.modes @ everywhere), float(modes @ found), 1e-30)
    # A normal value lies 0.8 standard deviations off on average.
    chance = float(modes @ (0.8 / np.sqrt(certain)))
    share = 0.5 * (float(modes @ np.abs(found - excess)) - chance) / total
    nats = cost(noise + told * excess) - cost(noise + told * found)
    middle = np.add.reduceat(seen.frequency * seen.weight, seen.first) / seen.modes
    return share, nats, float(1 / middle[own][np.argmax(modes * (found - excess))])


def other_law(series: list[Series], frames: list[int]) -> Doubt | None:
    """What speaks against normal noise: the kurtosis of differences of neighbouring means at some scale."""
    longest = max((s.information.size for s in series), default=0)
    worst = None
    for exponent in range(int(np.log2(max(longest // _FEWEST, 1))) + 1):
        if not series[0].level and 2**exponent < _SHORTEST:
            continue
        value, most, error = kurtosis(series, frames, 2**exponent)
        # One frame unlike the others is an accident: without the strongest of each recording too.
        sure, least = (min(value, most) / error, UNEVEN) if value > 0 else (-value / error, -BOUNDED)
        told = sure > _SURE and min(abs(value), abs(most)) > least and value * most > 0
        if told and (worst is None or sure > worst[0]):
            worst = sure, value, 2**exponent
    if worst is None:
        return None
    _, value, length = worst
    if value > 0:
        what = "it is strong in few places, not in all alike"
    else:
        what = "it keeps to few levels or one height"
    said = f"{what}: differences of means of {length} have an excess kurtosis of {value:.2g}, noise has none"
    return Doubt(1.0, (said,), instead=True)


def kurtosis(series: list[Series], frames: list[int], length: int) -> tuple[float, float, float]:
    """Excess kurtosis of the series itself in differences of neighbouring means of so many places, the same
    without the strongest frame of every recording, and the standard error of both where it is normal."""
    every = strongest = parts = 0.0
    for s, number in zip(series, frames, strict=True):
        values, noise = _differences(s, number, length)
        if len(values) < 3 or values.shape[1] < _FEWEST // 2:
            continue
        second, fourth = np.mean(values**2, 1), np.mean(values**4, 1)
        variance = float(second.mean())
        signal = variance - float(noise.mean())
        # Of normal values whose noise differs from place to place.
        uneven = 3 * float(np.var(noise))
        if signal < _PARTS * variance:
            continue
        kept = np.argsort(fourth)[:-1]
        # Frames off their own mean: so many are free.
        weight = values.size * (number - 1) / number / 24 / variance**4
        every += weight * signal**2 * (float(fourth.mean()) - 3 * variance**2 - uneven)
        weaker = float(fourth[kept].mean()) - 3 * float(second[kept].mean()) ** 2 - uneven
        strongest += weight * signal**2 * weaker
        parts += weight * signal**4
    if parts <= 0:
        return 0.0, 0.0, np.inf
    return every / parts, strongest / parts, float(1 / np.sqrt(parts))


def _differences(
    s: Series, frames: int, length: int
) -> tuple[Float[np.ndarray, "t j"], Float[np.ndarray, "j"]]:
    """Differences of neighbouring means of every frame, off the mean of all, and the variance that the noise
    of each has."""
    matrix = contrast_matrix(frames)[: len(s.score)].astype(np.float32)
    score = np.einsum("nt,nk->tk", matrix, np.asarray(s.score[: len(matrix)], np.float32))
    score *= np.float32(np.sqrt(frames / (frames - 1)))
    number = s.information.size // (2 * length)
    told = s.information[: 2 * length * number].reshape(number, 2, length).sum(2)
    kept = (told > 0).all(1)
    if not kept.any():
        return np.zeros((len(score), 0)), np.ones(0)
    means = score[:, : 2 * length * number].reshape(len(score), number, 2, length).sum(3, dtype=np.float64)
    means = means[:, kept] / told[kept]
    level = 1.0
    if not s.level:  # by the differences of neighbours, in which slow noise has next to nothing
        rough = np.diff(score, axis=1)
        level = float(np.mean(rough**2) / max(2 * np.mean(s.information), 1e-30))
    return means[:, :, 1] - means[:, :, 0], level * (1 / told[kept]).sum(1)
