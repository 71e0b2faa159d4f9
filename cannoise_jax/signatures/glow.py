"""Glow of the readout electronics: light that falls off from a corner or an edge, in the darks.

How far it reaches is known only roughly, and with it how much of the light lies where no fall is seen. The
strength is the mean over the places and reaches that the darks leave open, each weighted by its likelihood.
A strong glow shows its form: it is then a sum of falls of several forms, reaches and places, each of which
the darks ask for, and none negative.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy import optimize, special

from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.added import as_map, placed
from cannoise_jax.signatures.answers import as_it_stays
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.least import (
    Law,
    Seen,
    template,
)
from cannoise_jax.signatures.means import minus, project
from cannoise_jax.signatures.score import Score, normal_log_p, sidak
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    COVERS_NOTHING,
    NO_LAW,
    OFFSETS,
    STATIC,
    Addition,
    Axes,
    Found,
    Signature,
)

_REACHES = tuple(0.05 * 2 ** (n / 3) for n in range(10))
"""Lengths of the exponential fall over the longer side of the frame."""
_TRIALS = 24
"""Independent ones among the templates."""
_COST = float(np.log(_TRIALS) + 0.5 * np.log(1e5)) / 2
"""Nats of one of the templates and its strength, 4.5: half of the log of their number beside `KNOWN_SHAPE`,
which is a half as well. The whole log, as the p-value counts them, would be 1.6 more."""
_SHOWS_FORM = 20.0
"""Standard deviations from which a glow that is 5 % of itself off a template would be seen at one."""
_MOST_FALLS = 8
"""Falls of one glow."""
_OPEN = 0.02
"""Posterior weight, against the best, down to which a template may be the glow."""


class Glow(NamedTuple):
    """The template that fits best (rms 1) and its strength at the longest exposure, DN; the longest exposure
    (None where unknown); weights: log posterior weight of every template. formed: whether it is a sum of
    falls, whose form the darks show."""

    template: np.ndarray
    strength: float
    longest: float | None
    weights: np.ndarray
    strengths: np.ndarray
    formed: bool = False


@lru_cache(maxsize=4)
def glow_templates(size: tuple[int, int]) -> tuple[tuple[str, ...], np.ndarray]:
    """Exponential falls from every corner and edge, of several lengths, each of rms 1: names,
    [templates, H W]."""
    names, out = [], []
    for place, distance in _distances(size).items():
        for reach in _REACHES:
            out.append(_unit_fall(np.exp(-distance / (reach * max(size)))))
            names.append(f"{place}, {reach * max(size):.0f} px")
    return tuple(names), np.array(out)


def _distances(size: tuple[int, int]) -> dict[str, np.ndarray]:
    """How far every pixel is from the corners and edges, px."""
    h, w = size
    y, x = np.indices(size)
    return {
        "top left": np.hypot(y, x),
        "top right": np.hypot(y, w - 1 - x),
        "bottom left": np.hypot(h - 1 - y, x),
        "bottom right": np.hypot(h - 1 - y, w - 1 - x),
        "top": y,
        "bottom": h - 1 - y,
        "left": x,
        "right": w - 1 - x,
    }


def _unit_fall(fall: np.ndarray) -> np.ndarray:
    return (fall / np.sqrt(np.mean(fall**2))).ravel().astype(np.float32)


def _formed(fields: tuple[Fields, ...], names: tuple[str, ...], g: np.ndarray, best: int) -> np.ndarray:
    """A glow of the form that the darks show, rms 1: falls of exponential, Gaussian and Lorentzian form from
    the best place and exponential ones from the others, added while each gains more than it costs, all of
    them of positive strength (orthogonal matching pursuit)."""
    size = fields[0].mean.shape
    place = names[best].rsplit(",", 1)[0]
    away = [_distances(size)[place] / (reach * max(size)) for reach in _REACHES]
    falls = [
        *g,
        *(_unit_fall(np.exp(-(d**2) / 2)) for d in away),
        *(_unit_fall(1 / (1 + d**2)) for d in away),
    ]
    every = np.array(falls)
    u, i = _sums_of(fields, every)
    chosen, strengths = [best], np.array([u[best] / i[best]])
    gained = 0.5 * u[best] ** 2 / i[best]
    shared = [_along(fields, every, every[best])]
    while len(chosen) < _MOST_FALLS:
        rest = u - strengths @ np.array(shared)
        rest[chosen] = 0.0
        trial = [*chosen, int(np.argmax(rest / np.sqrt(i)))]
        shared.append(_along(fields, every, every[trial[-1]]))
        gram = np.array(shared)[:, trial]
        root = np.linalg.cholesky(gram + 1e-9 * np.diag(np.diag(gram)))
        fitted = optimize.nnls(root.T, np.linalg.solve(root, u[trial]))[0]
        gain = float(fitted @ u[trial] - 0.5 * fitted @ gram @ fitted)
        if gain - gained < _COST:
            break
        chosen, strengths, gained = trial, fitted, gain
    return _unit_fall(strengths @ every[chosen]).reshape(size)


def _along(fields: tuple[Fields, ...], falls: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Information that falls share with another one, the level of every channel fitted too."""
    dark, longest = _darks(fields)
    size = dark[0].mean.shape
    together, fall = np.zeros(size), other.reshape(size).astype(np.float64)
    for f in dark:
        square = f.weight.astype(np.float64) ** 2
        for at in SITES:
            level = float(np.sum(square[at] * fall[at])) / max(float(square[at].sum()), 1e-30)
            together[at] += f.frames * _scale(f, longest) ** 2 * square[at] * (fall[at] - level)
    # One by one: all of them in double precision would take as much memory as the recordings.
    return np.array([own.astype(np.float64) @ together.ravel() for own in falls])


def _darks(fields: tuple[Fields, ...]) -> tuple[list[Fields], float | None]:
    """The darks, and the longest exposure where all are known."""
    dark = [as_it_stays(f) for f in fields if f.kind in DARK and f.static is not None]
    known = [f.exposure_s for f in dark if f.exposure_s]
    return dark, max(known) if known and len(known) == len(dark) else None


def _sums(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, float | None] | None:
    """Score and information of every template and the longest exposure; None without darks."""
    dark, longest = _darks(fields)
    return (*_sums_of(fields, glow_templates(dark[0].mean.shape)[1]), longest) if dark else None


def _sums_of(fields: tuple[Fields, ...], g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Score and information of falls, the level of every channel fitted too."""
    dark, longest = _darks(fields)
    size = dark[0].mean.shape
    scale = np.array([_scale(f, longest) for f in dark])
    frames = np.array([f.frames for f in dark])
    falls, u, i = g.reshape(-1, *size), np.zeros(len(g)), np.zeros(len(g))
    for at in SITES:  # all darks at once, for the falls are many times larger than a dark
        w = np.stack([f.weight[at].ravel() for f in dark], 1).astype(np.float32)
        response = w * np.stack([f.static[at].ravel() for f in dark if f.static is not None], 1)
        total = np.maximum(np.sum(w**2, 0, dtype=np.float64), 1e-30)
        level = np.sum(response, 0, dtype=np.float64) / total
        own = np.ascontiguousarray(falls[:, *at]).reshape(len(g), -1)
        score, along = (own @ x.astype(np.float32) for x in (response, w**2))
        u += (score - along.astype(np.float64) * level) @ (np.sqrt(frames) * scale)
        own *= own
        i += (own @ w**2 - along.astype(np.float64) ** 2 / total) @ (frames * scale**2)
    return u, np.maximum(i, 1e-30)


def _scale(field: Fields, longest: float | None) -> float:
    """Glow of a dark over that of the longest one: it grows with the exposure."""
    return (field.exposure_s or 1.0) / longest if longest else 1.0


def _weights(u: np.ndarray, i: np.ndarray) -> np.ndarray:
    """Log-likelihood of every template of positive strength, over that of none."""
    return 0.5 * np.maximum(u, 0.0) ** 2 / i


def _strength(u: np.ndarray, i: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
    """Mean strength over the templates and its standard error."""
    share = special.softmax(weights)
    mean = float(share @ (u / i))
    return mean, float(np.sqrt(share @ (1 / i + (u / i - mean) ** 2)))


def glow_score(fields: tuple[Fields, ...]) -> Score[Glow] | None:
    """Light from a corner or edge in the darks, growing with the exposure where several are known."""
    sums = _sums(fields)
    if sums is None:
        return None
    u, i, longest = sums
    z, size = u / np.sqrt(i), fields[0].mean.shape
    k = int(np.argmax(z))
    amplitude, error = _strength(u, i, _weights(u, i))
    names, g = glow_templates(size)
    template, strength, formed = g[k].reshape(size), float(max(u[k] / i[k], 0.0)), z[k] > _SHOWS_FORM
    if formed:
        template = _formed(fields, names, g, k)
        strength, error = _one(fields, template)
        amplitude = strength
    return Score(
        log_p=sidak(normal_log_p(float(z[k]), 1), _TRIALS),
        gain=0.5 * max(float(z[k]), 0.0) ** 2,
        penalty=_COST,
        amplitude=abs(amplitude),
        error=error,
        shift=float(1 / np.sqrt(i[k])),
        power=1,
        parameters={"glow": (amplitude, "DN", error)},
        where={"axis": "edge", "edge": names[k]},
        payload=Glow(template, strength, longest, _weights(u, i), u / i, bool(formed)),
    )


def _one(fields: tuple[Fields, ...], template: np.ndarray) -> tuple[float, float]:
    """Strength of one glow and its standard error."""
    u, i = _sums_of(fields, template.reshape(1, -1).astype(np.float32))
    return max(float(u[0] / i[0]), 0.0), float(1 / np.sqrt(i[0]))


def glow_again(looked: Score[Glow], second: tuple[Fields, ...]) -> Score[Glow] | None:
    """The strength on other frames; place and reach are known from those that looked as far as both tell."""
    sums = _sums(second)
    if sums is None:
        return None
    u, i, _ = sums
    own = _weights(u, i)
    both = looked.payload.weights + own
    amplitude, error = _strength(u, i, both)
    amplitude, gain = max(amplitude, 0.0), float(own[np.argmax(both)])
    if looked.payload.formed:
        amplitude, error = _one(second, looked.payload.template)
        gain = 0.5 * (amplitude / error) ** 2
    parameters = {"glow": (amplitude, "DN", error)}
    return looked.replace(gain=gain, amplitude=amplitude, error=error, parameters=parameters)


def glow_absorb(fields: tuple[Fields, ...], score: Score[Glow]) -> tuple[Fields, ...]:
    """Subtracts the glow from the darks, in proportion to the exposure."""
    glow = score.payload
    level = _level(fields, glow)
    out = []
    for f in fields:
        if f.static is None or f.lit:
            out.append(f)
            continue
        scale = _scale(f, glow.longest)
        fall = project(as_it_stays(f), glow.template * glow.strength * scale)
        f = minus(f, fall)._replace(mean=f.mean - np.float32(level * scale))
        if glow.formed:
            gain = f.gain[channel_index(f.mean.shape)]
            f = _louder(f, gain * (glow.template - glow.template.min()) * glow.strength * scale)
        out.append(f)
    return tuple(out)


def _louder(field: Fields, variance: np.ndarray) -> Fields:
    """The field where some noise is known to grow over the frame, DN^2, the rest of it fitted to what the
    frames show: its charge arrives one by one."""
    if not len(field.contrasts):
        return field
    before = field.sigma.astype(np.float64) ** 2
    each = np.minimum(field.contrasts**2 * before, 25 * (before + variance))
    # Where little of it is known, the rest is told best.
    share = field.usable / (before + variance) ** 2
    rest = max(float(np.sum(share * (each.mean(0) - variance)) / np.sum(share * before)), 0.05)
    after = rest * before + variance
    root = np.sqrt(after / before).astype(np.float32)
    shot = ((field.shot * rest * before + variance) / after).astype(np.float32)
    static = None if field.static is None else field.static / root
    field = field._replace(
        contrasts=field.contrasts / root,
        sigma=field.sigma * root,
        shot=shot,
        static=static,
    )
    return field if static is None else _level_out(field, static)


def _level_out(field: Fields, static: np.ndarray) -> Fields:
    """The field without the level of each channel that its static part holds by its weights of now."""
    weight, channel = field.weight, channel_index(field.mean.shape)
    level = np.zeros(4, np.float32)
    for c in range(4):
        at = channel == c
        level[c] = np.sum(weight[at] * static[at]) / max(float(np.sum(weight[at] ** 2)), 1e-30)
    return field._replace(static=static - weight * level[channel])


def _level(fields: tuple[Fields, ...], glow: Glow) -> float:
    """Mean of the glow at the longest exposure, DN: of those that the fall leaves open the one that the
    levels of the darks show, so that only what no such glow brings is left for a dark current."""
    g = glow_templates(fields[0].mean.shape)[1]
    possible = glow.weights > glow.weights.max() + np.log(_OPEN)
    means = np.maximum(glow.strengths, 0.0)[possible] * g[possible].mean(1)
    dark = [f for f in fields if f.static is not None and not f.lit]
    scales = np.array([_scale(f, glow.longest) for f in dark])
    if np.ptp(scales) < 0.01 or glow.formed:
        return float(np.mean(glow.template) * glow.strength)
    shown = float(np.polyfit(scales, [float(np.mean(f.mean)) for f in dark], 1)[0])
    return float(np.clip(shown, means.min(), means.max()))


def from_edges(*, name: str, parameter: str) -> Signature:
    """Light that falls off from a corner or an edge of the darks."""

    def simulate(found: Found) -> Addition | None:
        if found.pattern is None:
            return None
        peak = float(found.pattern.max())
        rate = found.score.amplitude * peak / found.gain / found.seconds
        return Addition({parameter: rate}, {"glow": as_map(found.pattern / peak)})

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
        covers=COVERS_NOTHING,
        predict=NO_LAW,
        pattern=lambda fields, score, rng: np.asarray(score.payload.template, np.float64),
        simulate=simulate,
        place=placed(OFFSETS, unit_map=True, by_exposure=True),
        strength=lambda found, looked, held: glow_again(found, held),
        detectable=BY_SHIFT,
        least=least,
    )
