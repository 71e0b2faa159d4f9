"""Correlation between neighbouring pixels of the unpacked mosaic: charge sharing, filtering, lag in time."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import fft

from cannoise_jax.physics.core.grammar import Point, amplitude_name
from cannoise_jax.signatures.added import strength
from cannoise_jax.signatures.fields import Fields, map_contrasts
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.lag_sums import DARK_TOO, LAGS, REACH, lag_sums, pair_weight
from cannoise_jax.signatures.least import Law, Least, Seen, pooled
from cannoise_jax.signatures.score import Score, normal_log_p, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    Axes,
    Scales,
    Signature,
)

Lag = tuple[int, int]


_LEAST_POWER = 0.05
"""Power, of that of white noise, that a spectrum with measured correlations is taken to have at least."""


class Template(NamedTuple):
    """Correlation at each lag per unit of an amplitude, to first order, times the template's weight, and the
    amplitude of a fitted first-order one: a blend with so many neighbours, or a share given to these."""

    lags: dict[Lag, float]
    blend: int = 0

    def amplitude(self, first_order: float) -> float:
        """The amplitude whose correlation this is to first order."""
        if self.blend:
            return _blend_weight(first_order, self.blend)
        return first_order

    def error(self, first_order: float, error: float) -> float:
        """That of the amplitude, of this one to first order; where more correlation is no larger amplitude it
        stays as it is."""
        low, high = max(first_order - error, 0.0), max(first_order, 0.0) + error
        slope = (self.amplitude(high) - self.amplitude(low)) / (high - low)
        return error * (slope or 1.0)


GIVEN = Template({(0, 1): 0.5, (1, 0): 0.5}, blend=4)
"""A share of the charge that goes to the four neighbours."""
REPELLED = Template({(0, 1): 0.25, (1, 0): 0.25})
"""What a pixel loses of its variance is the covariance with its four neighbours."""
BLENDED_4 = Template({(0, 2): 0.5, (2, 0): 0.5}, blend=4)
BLENDED_8 = Template({(0, 2): 0.25, (2, 0): 0.25, (2, 2): 0.25, (2, -2): 0.25}, blend=8)
"""A blend with the four, or eight, neighbours of the same colour."""
INTERPOLATED = Template({(0, 1): 1.0, (1, 0): 1.0, (1, 1): 0.5, (1, -1): 0.5})
"""Pixels that are means of their neighbours."""


class Correlated(NamedTuple):
    """What is whitened: correlations at these lags, and at others where they show, in a share of the
    noise."""

    lags: tuple[Lag, ...]
    law: str


def template_score(fields: tuple[Fields, ...], *, law: str, template: Template) -> Score[Correlated] | None:
    """Correlation at the lags of one template, in its proportions."""
    score, information = lag_sums(fields, law)
    if not information.max() > 0:
        return None
    t = np.array([template.lags.get(lag, 0.0) for lag in LAGS])
    i = float(np.sum(t**2 * information))
    if i <= 0:
        return None
    u = float(np.sum(t * score))
    z = u / np.sqrt(i)
    scale, unit = (1e-4, "1/e-") if law == "charge" else (1.0, "1")
    amplitude = scale * max(template.amplitude(u / i), 0.0)
    first = float(1 / np.sqrt(i))
    error = scale * template.error(u / i, first)
    gain = 0.5 * z**2 if z > 0 else 0.0
    return Score(
        log_p=normal_log_p(z, 1),
        gain=gain,
        penalty=float(0.5 * np.log(information.max())),
        amplitude=amplitude,
        error=error,
        shift=scale * first,
        power=1,
        parameters={"fraction": (amplitude, unit, error)},
        where={"axis": "pixel", "lags": [list(lag) for lag in template.lags]},
        payload=Correlated(tuple(template.lags), law),
    )


def _blend_weight(first_order: float, neighbours: int) -> float:
    """Blend weight w from rho = 2 w (1 - w) / n / ((1 - w)^2 + w^2 / n) per neighbour lag, template
    weight 2/n."""
    if first_order <= 0:
        return 0.0
    grid = np.linspace(0, 0.9, 1801)
    rho = grid * (1 - grid) / ((1 - grid) ** 2 + grid**2 / neighbours)
    rho[np.argmax(rho) :] = rho.max()
    return float(np.interp(first_order, rho[: np.argmax(rho) + 1], grid[: np.argmax(rho) + 1]))


def any_score(fields: tuple[Fields, ...], *, law: str) -> Score[Correlated] | None:
    """The largest correlation at any lag, of either sign, in all of the noise or in the read noise."""
    score, information = lag_sums(fields, law)
    if not information.max() > 0:
        return None
    z = score / np.sqrt(np.maximum(information, 1e-30))
    k = int(np.argmax(np.where(information > 0, np.abs(z), -1.0)))
    rho = score / np.maximum(information, 1e-30)
    log_p = sidak(normal_log_p(float(z[k])), len(LAGS))
    strong = np.abs(z) > 3.5
    gain = _likelihood_gain(np.where(strong, rho, 0.0), float(information.max()))
    penalty = float(strong.sum() * (0.5 * np.log(information.max()) + np.log(len(LAGS)) / 2))
    where = {
        "axis": "pixel",
        "lags": [list(LAGS[i]) for i in np.flatnonzero(strong)],
        "correlations": [float(rho[i]) for i in np.flatnonzero(strong)],
    }
    error = float(1 / np.sqrt(information[k]))
    return Score(
        log_p=log_p,
        gain=gain,
        penalty=penalty,
        amplitude=float(abs(rho[k])),
        error=error,
        shift=error,
        power=1,
        parameters={"correlation": (float(rho[k]), "1", error)},
        where=where,
        payload=Correlated((), law),
    )


def _likelihood_gain(correlations: np.ndarray, pairs: float) -> float:
    """Log-likelihood that noise with these correlations at `LAGS` gains over white noise (Whittle's
    likelihood at its expectation): n/2 <S - 1 - log S> over the frequencies.

    To first order half the sum of the squared z-values. Far from it those count what one wave does to many
    lags as so many effects. Correlations that end at the last lag and leave less than no power somewhere are
    tapered (Bartlett's window), which leaves none below zero.
    """
    spectrum = 1 + _spectrum(LAGS, correlations)
    if spectrum.min() < _LEAST_POWER:
        taper = [(1 - abs(dy) / REACH) * (1 - abs(dx) / REACH) for dy, dx in LAGS]
        spectrum = np.maximum(1 + _spectrum(LAGS, correlations * np.array(taper)), _LEAST_POWER)
    return 0.5 * pairs * float(np.mean(spectrum - 1 - np.log(spectrum)))


def _spectrum(lags, correlations, side: int = 32) -> Float[np.ndarray, "side side"]:
    """What correlations at these lags (dy, dx) add to the power of white noise, over the frequencies."""
    covariance = np.zeros((side, side))
    for (dy, dx), value in zip(lags, correlations, strict=True):
        covariance[dy % side, dx % side] = covariance[-dy % side, -dx % side] = value
    return np.real(np.fft.fft2(covariance))


def absorb(fields: tuple[Fields, ...], score: Score[Correlated]) -> tuple[Fields, ...]:
    """Whitens the fields by the inverse square root of the measured spectrum of neighbour correlations."""
    law = score.payload.law
    u, i = lag_sums(fields, law)
    rho = u / np.maximum(i, 1e-30)
    used = np.abs(u) > 2.0 * np.sqrt(np.maximum(i, 1e-30))
    used |= np.array([lag in score.payload.lags for lag in LAGS])
    rho = np.where(used, rho, 0.0)
    return tuple(_whiten(f, rho, law) if f.lit or law in DARK_TOO else f for f in fields)


def _whiten(field: Fields, rho: np.ndarray, law: str) -> Fields:
    g = pair_weight(field, law)
    h, w = field.mean.shape
    # The filter is exact where the weight is the same everywhere: it is taken in units of that of most pairs.
    unit = float(np.sum(g.astype(np.float64) ** 4)) / max(float(np.sum(g.astype(np.float64) ** 2)), 1e-30)
    if not unit > 0:
        return field
    g, rho = g / np.float32(np.sqrt(unit)), rho * unit
    kernel = np.zeros((h, w))
    for (dy, dx), value in zip(LAGS, rho, strict=True):
        kernel[dy % h, dx % w] += value
        kernel[-dy % h, -dx % w] += value
    spectrum = np.real(fft.rfft2(kernel))
    filt = 1 / np.sqrt(np.maximum(1 + spectrum, _LEAST_POWER)) - 1

    def function(x: np.ndarray) -> np.ndarray:
        change = np.stack([fft.irfft2(fft.rfft2(v * g) * filt, (h, w)) for v in x]) if len(x) else x
        return (x + g * change).astype(np.float32)

    out = map_contrasts(field, function)
    if field.static is None:
        return out
    return out._replace(static=None if field.kind == "scene" else out.static)


_READS = frozenset({"contrasts", "usable"})


def neighbours(
    law: Literal["shot", "charge", "white"],
    template: Template,
    *,
    name: str,
    parameter: str,
    least: Least = NO_CLOSED_FORM,
    covers: tuple[str, ...],
    lifted_by: tuple[str, ...] = (),
) -> Signature:
    """Correlation at the lags of one template, in its proportions. law: of the share of the noise
    that correlates."""
    scales: dict[str, Scales] = {"shot": "signal", "charge": "signal squared", "white": "all noise"}
    return Signature(
        name=name,
        axes=Axes("digital" if law == "white" else "pixel", "pixel", "redrawn", scales[law], "neighbours"),
        reads=_READS if law == "white" else _READS | {"shot", "signal"},
        score=partial(template_score, law=law, template=template),
        absorb=absorb,
        covers=covers,
        lifted_by=lifted_by,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=strength(parameter),
        place=NO_PLACE,
        detectable=BY_SHIFT,
        least=least,
    )


def shared_charge(sets: tuple[Seen, ...]) -> Law:
    """A quarter of the share of charge given away goes to each neighbour and takes its shot noise along, so
    that two of them have the covariance a (S_i + S_j) / 4."""

    def of(s: Seen) -> float:
        charge = np.divide(s.shot, s.weight, out=np.zeros_like(s.weight), where=s.weight > 0)
        total = 0.0
        for v, w in ((charge, s.weight), (charge.T, s.weight.T)):
            total += float(np.sum((v[1:] + v[:-1]) ** 2 * w[1:] * w[:-1]))
        return total / 16

    return pooled(s.fresh * of(s) for s in sets)


def blended(sets: tuple[Seen, ...]) -> Law:
    """Every pixel tells by itself of a blend with its neighbours."""
    return pooled(s.fresh * np.sum(s.weight > 0) / 2 for s in sets)


def neighbour_kernel(lags, correlations, reach: int = 4) -> tuple[tuple[float, ...], float]:
    """The filter, of norm 1, that gives white noise these correlations at these lags (dy, dx) when it is a
    part of the noise, and that share of the variance: the least that leaves no frequency with less than
    nothing."""
    spectrum = _spectrum(lags, correlations)
    share = float(np.clip(-spectrum.min(), 1e-6, 0.9))
    root = np.real(np.fft.ifft2(np.sqrt(np.maximum(spectrum + share, 0))))
    window = np.roll(root, (reach, reach), (0, 1))[: 2 * reach + 1, : 2 * reach + 1]
    return tuple((window / np.linalg.norm(window)).round(6).ravel().tolist()), share


def any_lag(law: Literal["white", "read"], *, name: str, covers: tuple[str, ...]) -> Signature:
    """The largest correlation with any neighbour, of all noise or of the read noise alone. covers: templates
    of the noise of darks too, which have nothing left to see but what was taken out badly."""

    def place(found: Found) -> Addition:
        kernel, share = neighbour_kernel(found.score.where["lags"], found.score.where["correlations"])
        point = Point("readout", "signal", "pixel", "redrawn", spectrum="kernel", kernel=kernel)
        return Addition({amplitude_name(point): float(np.sqrt(share) * found.read_dn)}, point=point)

    return Signature(
        name=name,
        axes=Axes("readout", "pixel", "redrawn", "all noise" if law == "white" else "additive", "neighbours"),
        reads=_READS if law == "white" else _READS | {"shot"},
        score=partial(any_score, law=law),
        absorb=absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        simulate=NOT_SIMULATED,
        place=place,
        detectable=BY_SHIFT,
        least=NO_CLOSED_FORM,
    )
