"""Glow of the readout electronics: light that falls off from a corner or an edge, in the darks.

How far it reaches is known only roughly, and with it how much of the light lies where no fall is seen. The
strength is the mean over the places and reaches that the darks leave open, each weighted by its likelihood.
A strong glow shows its form: it is then a sum of falls of several forms, reaches and places, each of which
the darks ask for, and none negative.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage, special

from cannoise_jax.physics.robust import OF_MEDIAN, local_median, median
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.charge_noise import louder
from cannoise_jax.signatures.even_glow import grows, smooth
from cannoise_jax.signatures.falls import (
    COST,
    TRIALS,
    above_least,
    formed_fall,
    glow_templates,
    over_longest,
    sums_of,
    sums_of_all,
)
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.heat import less_levels, levels_around
from cannoise_jax.signatures.least import Law, Seen, template
from cannoise_jax.signatures.means import minus, project
from cannoise_jax.signatures.patterns import pixel_sums
from cannoise_jax.signatures.rare import spread_of
from cannoise_jax.signatures.score import Score, normal_log_p, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_LAW,
    OFFSETS,
    STATIC,
    Axes,
    Signature,
)

_SHOWS_FORM = 20.0
"""Standard deviations from which a glow that is 5 % of itself off a template would be seen at one."""
_BEFORE_MAPS = 8.0
"""Standard deviations of a glow, of the levels of pixels as they scatter, from which on it is judged before
maps of pixels, which hold it as well. Independent levels look like none of it."""
_MOSTLY = 0.8
"""And the share of how levels differ from place to place that it explains."""
_SIDES = (8, 4)
"""Of what is around a pixel, pixels of its site of the mosaic: the second follows light that falls steeply.
"""
_OPEN = 0.02
"""Posterior weight, against the best, down to which a template may be the glow."""


class Glow(NamedTuple):
    """The template that fits best (rms 1) and its strength at the longest exposure, DN; the longest exposure
    (None where unknown); weights: log posterior weight of every template. formed: whether it is a sum of
    falls, whose form the darks show. stands_out: from whatever levels the pixels have."""

    template: np.ndarray
    strength: float
    longest: float | None
    weights: np.ndarray
    strengths: np.ndarray
    formed: bool = False
    stands_out: bool = False


def _weights(u: np.ndarray, i: np.ndarray) -> np.ndarray:
    """Log-likelihood of every template of positive strength, over that of none."""
    return 0.5 * np.maximum(u, 0.0) ** 2 / i


def _strength(u: np.ndarray, i: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Mean strength over the templates and its standard error."""
    share = special.softmax(weights)
    mean = float(share @ (u / i))
    return mean, float(np.sqrt(share @ (1 / i + (u / i - mean) ** 2)))


_NEAR, _ALONE = 5, 6.0
"""Pixels of a site, a side, about one, and standard deviations from their median from which on it stands
alone: a glow is where its neighbours are too."""


def _like_neighbours(fields: tuple[Fields, ...]) -> tuple[Fields, ...]:
    """The fields with pixels that stand alone in the darks at the level of those about them: a few hot ones
    would tilt a fall over the whole frame."""

    def one(f: Fields) -> Fields:
        if f.static is None or f.lit:
            return f
        static = np.array(f.static)
        for at in SITES:
            about = local_median(static[at], _NEAR)
            away = np.abs(static[at] - about)
            # Where a glow is steep all of them are far from their median.
            spread = np.maximum(OF_MEDIAN * local_median(away, _NEAR), 1.0)
            static[at] = np.where(away > _ALONE * spread, about, static[at])
        return f._replace(static=static)

    return tuple(one(f) for f in fields)


def glow_score(fields: tuple[Fields, ...]) -> Score[Glow] | None:
    """Light from a corner or edge in the darks, growing with the exposure where several are known."""
    fields = _like_neighbours(fields)
    sums = sums_of_all(fields)
    if sums is None:
        return None
    u, i, longest = sums
    z, size = u / np.sqrt(i), fields[0].mean.shape
    k = int(np.argmax(z))
    amplitude, error = _strength(u, i, _weights(u, i))
    names, g = glow_templates(size)
    gain = 0.5 * max(float(z[k]), 0.0) ** 2
    template, strength, formed = g[k].reshape(size), float(max(u[k] / i[k], 0.0)), z[k] > _SHOWS_FORM
    stands_out = False
    if formed:
        template = formed_fall(fields, names, g, k)
        strength, error = _one(fields, template)
        stands_out = _stands_out(fields, float(z[k]), template)
        # Once maps of pixels were taken out, the levels of areas are theirs as well.
        if stands_out and not any(f.answers.mixed for f in fields):
            template = _free_form(fields, template, strength, longest)
            strength, error = _one(fields, template)
            gain = max(gain, 0.5 * (strength / error) ** 2)
        amplitude = strength
    return Score(
        log_p=sidak(normal_log_p(float(z[k]), 1), TRIALS),
        gain=gain,
        penalty=COST,
        amplitude=abs(amplitude),
        error=error,
        shift=float(1 / np.sqrt(i[k])),
        power=1,
        parameters={"glow": (amplitude, "DN", error)},
        where={"axis": "edge", "edge": names[k]},
        payload=Glow(template, strength, longest, _weights(u, i), u / i, bool(formed), stands_out),
    )


def _stands_out(fields: tuple[Fields, ...], z: float, template: np.ndarray) -> bool:
    """Whether a fall is far above the spread of the levels of pixels beside those around them, and explains
    most of how the levels around them differ; or these are of another form as smooth."""
    sums = pixel_sums(fields, "exposure" if any(f.exposure_s for f in fields) else "additive", DARK)
    if sums is None or not (seen := sums.information > 0).any():
        return False
    around = levels_around(sums)
    single = less_levels(sums, around)
    if z <= _BEFORE_MAPS * spread_of(single.score[seen] / np.sqrt(single.information[seen])):
        return False
    levels, fall = (v - median(v) for v in (around, template))
    share = float(np.sum(levels * fall) ** 2 / max(float(np.sum(levels**2) * np.sum(fall**2)), 1e-30))
    if share > _MOSTLY:
        return True
    form = levels_around(sums, _SIDES[-1])
    return smooth(form) and grows(fields, form)


def _free_form(
    fields: tuple[Fields, ...], template: np.ndarray, strength: float, longest: float | None
) -> np.ndarray:
    """The template with what the levels around every pixel have beside it: no two cameras glow alike."""
    sums = pixel_sums(fields, "exposure" if longest else "additive", DARK)
    if sums is None:
        return template
    rate = template * strength / (longest or 1.0)
    for side in _SIDES:
        left = sums._replace(score=sums.score - sums.information * rate)
        rate = rate + _sites_alike(levels_around(left, side, curved=True))
    return above_least(rate)


def _sites_alike(around: np.ndarray) -> np.ndarray:
    """Levels without what sets the sites of the mosaic apart: that of each was fitted too, and is any."""
    smooth, out = around, np.array(around)
    for axis in (0, 1):  # nothing that alternates is left by this
        smooth = ndimage.correlate1d(smooth, (0.25, 0.5, 0.25), axis, mode="mirror")
    for at in SITES:
        out[at] -= np.mean((around - smooth)[at])
    return out


def _one(fields: tuple[Fields, ...], template: np.ndarray) -> tuple[float, float]:
    """Strength of one glow and its standard error."""
    u, i = sums_of(fields, template.reshape(1, -1).astype(np.float32))
    return max(float(u[0] / i[0]), 0.0), float(1 / np.sqrt(i[0]))


def glow_again(looked: Score[Glow], second: tuple[Fields, ...]) -> Score[Glow] | None:
    """The strength on other frames; place and reach are known from those that looked as far as both tell."""
    second = _like_neighbours(second)
    sums = sums_of_all(second)
    if sums is None:
        return None
    u, i, _ = sums
    own = _weights(u, i)
    both = looked.payload.weights + own
    best = int(np.argmax(both))
    amplitude, error = _strength(u, i, both)
    amplitude, gain, shift = max(amplitude, 0.0), float(own[best]), float(1 / np.sqrt(i[best]))
    if looked.payload.formed:
        amplitude, error = _one(second, looked.payload.template)
        gain, shift = 0.5 * (amplitude / error) ** 2, error
    parameters = {"glow": (amplitude, "DN", error)}
    return looked.replace(gain=gain, amplitude=amplitude, error=error, shift=shift, parameters=parameters)


def glow_absorb(fields: tuple[Fields, ...], score: Score[Glow]) -> tuple[Fields, ...]:
    """Subtracts the glow from the darks, in proportion to the exposure."""
    glow = score.payload
    level = _level(fields, glow)
    whole = (glow.template - np.mean(glow.template)) * glow.strength + level
    out = []
    for f in fields:
        if f.static is None or f.lit:
            out.append(f)
            continue
        scale = over_longest(f, glow.longest)
        fall = project(as_it_stays(f), glow.template * glow.strength * scale)
        charged = (f.charged + whole * scale).astype(np.float32)
        f = minus(f, fall)._replace(mean=f.mean - np.float32(level * scale), charged=charged)
        if glow.formed:
            gain = f.gain[channel_index(f.mean.shape)]
            f = louder(f, gain * (glow.template - glow.template.min()) * glow.strength * scale)
        out.append(f)
    return tuple(out)


def _level(fields: tuple[Fields, ...], glow: Glow) -> float:
    """Mean of the glow at the longest exposure, DN: of those that the fall leaves open the one that the
    levels of the darks show, so that only what no such glow brings is left for a dark current."""
    g = glow_templates(fields[0].mean.shape)[1]
    possible = glow.weights > glow.weights.max() + np.log(_OPEN)
    means = np.maximum(glow.strengths, 0.0)[possible] * g[possible].mean(1)
    dark = [f for f in fields if f.static is not None and not f.lit]
    scales = np.array([over_longest(f, glow.longest) for f in dark])
    if np.ptp(scales) < 0.01 or glow.formed:
        return float(np.mean(glow.template) * glow.strength)
    shown = float(np.polyfit(scales, [float(np.mean(f.mean)) for f in dark], 1)[0])
    return float(np.clip(shown, means.min(), means.max()))


def _gain_of(found: Found) -> np.ndarray | float:
    """DN/e- of every pixel. Where the form was measured that of its site of the mosaic, so that what was
    recorded is drawn: else gains that differ by their errors would draw lines through a strong glow."""
    gains = [f.gain for f in found.fields if f.unit == 1]  # strengths hold at the lowest gain
    if not (found.score.payload.stands_out and gains and np.all(gains[0] > 0)):
        return found.gain
    return gains[0][channel_index(found.size)]


def from_edges(
    *,
    name: str,
    parameter: str,
    covers: tuple[str, ...],
    before: tuple[str, ...],
    lifted_by: tuple[str, ...],
) -> Signature:
    """Light that falls off from a corner or an edge of the darks. before: signatures of patterns that hold it
    as well, which are judged once it is gone."""

    def simulate(found: Found) -> Addition | None:
        if found.pattern is None:
            return None
        charge = found.score.amplitude * found.pattern / _gain_of(found)
        peak = float(charge.max())
        return Addition({parameter: peak / found.seconds}, {"glow": as_map(charge / peak)})

    def least(sets: tuple[Seen, ...]) -> Law:
        """From a corner, a fifth of the longer side deep."""
        size = sets[0].weight.shape
        y, x = np.mgrid[: size[0], : size[1]]
        fall = np.exp(-np.hypot(y, x) / (0.2 * max(size)))
        return template(sets, lambda s: fall / np.sqrt(np.mean(fall**2)) * s.exposure)

    return Signature(
        name=name,
        axes=Axes("pixel", "block", "frozen", "exposure", "exponential fall"),
        reads=STATIC,
        score=glow_score,
        absorb=glow_absorb,
        covers=covers,
        predict=NO_LAW,
        pattern=lambda fields, score, rng: np.asarray(score.payload.template, np.float64),
        simulate=simulate,
        place=placed(OFFSETS, unit_map=True, by_exposure=True),
        strength=lambda found, looked, held: glow_again(found, held),
        detectable=BY_SHIFT,
        least=least,
        before=lambda score: before if score.payload.stands_out else (),
        lifted_by=lifted_by,
    )
