"""The shot noise of dark charge: where more of it arrives, there is more noise."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.signatures.fields import Fields, channel_index, helmert

_FAR = 6.0
"""Standard deviations from which on what a pixel collects is its own, whatever the others collect."""


_LEAST_EVEN = 0.05
"""Of the noise that does not grow, at least, over what it was taken to be."""
_LOWEST = 0.001
"""Share of the pixels whose charge lies below what is taken as none: single ones are chance."""


def louder(field: Fields, variance: np.ndarray) -> Fields:
    """The field where some noise is known to grow over the frame, DN^2, the rest of it fitted to what the
    frames show: its charge arrives one by one."""
    if not len(field.contrasts):
        return field
    rest, of_charge = _rest(field, variance)
    after = rest + variance
    shot = ((of_charge + variance) / after).astype(np.float32)
    return of_noise(field, _growth(field, after), shot)


def of_noise(field: Fields, root: Float[np.ndarray, "h w"], shot: Float[np.ndarray, "h w"]) -> Fields:
    """The field where the noise is so many times what it was taken to be, with that share of shot noise."""
    static = None if field.static is None else field.static / root
    field = field._replace(
        contrasts=field.contrasts / root, sigma=field.sigma * root, shot=shot, static=static
    )
    return field if static is None else _level_out(field, static)


def _rest(
    field: Fields, variance: np.ndarray, least: float = _LEAST_EVEN
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """What of the noise does not grow, as the frames show it, and what of that is shot noise, DN^2: what is
    known to be uneven as it is, such as that of a glow, and as much of the rest as there is beside it, that
    share of it at least."""
    before = field.sigma.astype(np.float64) ** 2
    of_charge = field.shot * before
    uneven = _beyond_least(field, of_charge)
    even = before - uneven
    each = np.minimum(field.contrasts**2 * before, 25 * (before + variance))
    # Where little of it is known, the rest is told best.
    share = field.usable / (before + variance) ** 2
    told = np.sum(share * (each.mean(0) - variance - uneven)) / np.sum(share * even)
    left = max(float(told), least)
    return uneven + even * left, uneven + (of_charge - uneven) * left


def _beyond_least(field: Fields, of_charge: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The shot noise of a dark beyond that of its quietest pixels, DN^2; none of a lit one, whose light is
    all of it."""
    if field.lit or not field.usable.any():
        return np.zeros_like(of_charge)
    return np.maximum(of_charge - np.quantile(of_charge[field.usable], _LOWEST), 0.0)


def _growth(field: Fields, variance: np.ndarray) -> Float[np.ndarray, "h w"]:
    """Noise of this variance over that of the field."""
    return np.sqrt(variance / field.sigma.astype(np.float64) ** 2).astype(np.float32)


def _level_out(field: Fields, static: np.ndarray) -> Fields:
    """The field with the level of each channel that its static part holds by its weights of now in its mean:
    it was recorded, and its charge with it. Pixels that stand out have no part in it: they would take what
    they collect from all others."""
    weight, channel = field.weight, channel_index(field.mean.shape)
    level = np.zeros(4, np.float32)
    like = np.abs(static) < _FAR * max(robust_std(static[field.usable], 0.0), 1.0)
    for c in range(4):
        at = (channel == c) & like
        level[c] = np.sum(weight[at] * static[at]) / max(float(np.sum(weight[at] ** 2)), 1e-30)
    mean = field.mean + level[channel] / np.float32(np.sqrt(field.frames))
    return field._replace(static=static - weight * level[channel], mean=mean)


def steadied(
    fields: tuple[Fields, ...],
    rate: Float[np.ndarray, "h w"],
    known: Bool[np.ndarray, "h w"],
    error: Float[np.ndarray, "h w"],
) -> tuple[Fields, ...]:
    """The darks with contrasts in units of the noise that each pixel's own charge has, e-/s; only those: of
    what stays the weights are those by which maps were taken out of it. known: pixels whose charge is known.
    error: by how much it is not, which `Answers.doubt` keeps.

    Without it pixels of more dark current than others would be pixels of more read noise, or ones that jump.
    """
    if not known.any():
        return fields
    charge = np.where(known, np.maximum(rate - np.quantile(rate[known], _LOWEST), 0.0), 0.0)

    def own(f: Fields) -> Fields:
        if f.lit or not f.exposure_s or not np.all(f.gain > 0) or not len(f.contrasts):
            return f
        variance = f.gain[channel_index(rate.shape)] ** 2 * charge * f.exposure_s
        # Where single pixels seem to collect far less than none, all others have so much more, and as much
        # less of what does not grow.
        least = _LEAST_EVEN * f.sigma.astype(np.float64) ** 2
        total = np.maximum(_rest(f, variance, -np.inf)[0] + variance, least)
        growth, gain = _growth(f, total), f.gain[channel_index(rate.shape)]
        # The error is larger where the noise is.
        doubt = np.where(known, gain**2 * f.exposure_s * error * growth / total, 0.0)
        answers = f.answers._replace(doubt=doubt.astype(np.float32))
        return f._replace(contrasts=f.contrasts / growth, louder=f.louder * growth, answers=answers)

    return tuple(own(f) for f in fields)


_LEAST = 0.1
"""Least variance that pixels of less charge than the mean keep."""


def own_charge(fields: tuple[Fields, ...]) -> Float[np.ndarray, "h w"] | None:
    """What pixels collect beyond the mean of all, e-/s, as far as they differ by more than noise; None
    without darks of two exposures. Fixed offsets of a pixel are fitted beside it, and are none, nor is what
    the noise was brought in units of, see `steadied`."""
    told = _told_of_charge(fields)
    if told is None:
        return None
    top, information, seen = told
    z, share = _standing(top, information, seen)
    for f in fields:
        seen = seen & ~np.asarray(f.answers.steadied)
    return np.where(seen, share * z / np.sqrt(np.maximum(information, 1e-30)), 0.0)


def _standing(
    top: Float[np.ndarray, "h w"], information: Float[np.ndarray, "h w"], seen: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Charges of pixels in standard errors, and what share of each is no noise."""
    z = np.where(seen, top / np.sqrt(np.maximum(information, 1e-30)), 0.0)
    spread = robust_std(z[seen], 0) ** 2
    chance = _FAR * np.sqrt(np.pi / np.count_nonzero(seen))
    share = max(1 - 1 / spread, 0.0) if spread > 1 + chance else 0.0
    # None collects far less than the others, who are about the mean: one that seems to jumps between levels.
    return z, np.where(z > _FAR * max(np.sqrt(spread), 1.0), 1.0, share)


def error_of_charge(fields: tuple[Fields, ...]) -> Float[np.ndarray, "h w"]:
    """Standard error of `own_charge`, by the noise that all pixels are taken to have, e-/s; zero where
    nothing tells."""
    told = _told_of_charge(fields)
    if told is None:
        return np.zeros(fields[0].mean.shape)
    top, information, seen = told
    share = _standing(top, information, seen)[1]
    return np.where(seen, np.sqrt(share / np.maximum(information, 1e-30)), 0.0)


def _told_of_charge(
    fields: tuple[Fields, ...],
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]] | None:
    """Score and information of every pixel's charge per second beside its offset, and where there is any."""
    darks = [f for f in fields if not f.lit and f.static is not None and f.exposure_s is not None]
    top: np.ndarray | float = 0.0
    information: np.ndarray | float = 0.0
    for group in {f.group for f in darks if np.all(f.gain > 0)}:
        own = [f for f in darks if f.group == group]
        if len({f.exposure_s for f in own}) < 2:
            continue
        gain = own[0].gain[channel_index(own[0].mean.shape)]
        root = [np.sqrt(f.frames) * gain * f.weight for f in own]
        weight = [r.astype(np.float64) ** 2 for r in root]
        seconds = [float(f.exposure_s or 0.0) for f in own]
        mean = sum(w * t for w, t in zip(weight, seconds, strict=True)) / np.maximum(sum(weight), 1e-30)
        for f, r, w, t in zip(own, root, weight, seconds, strict=True):
            top = top + (t - mean) * r * f.static
            information = information + (t - mean) ** 2 * w
    if not np.ndim(information):
        return None
    seen = np.asarray(information) > 1e-6 * np.max(information)
    return (np.asarray(top), np.asarray(information), seen) if seen.any() else None


_FEWEST_FRAMES = 3
"""Frames of a dark whose median one hit does not move."""


def by_medians(fields: tuple[Fields, ...], at: Bool[np.ndarray, "h w"]) -> tuple[Fields, ...] | None:
    """The darks with the median of their frames in place of the mean at some pixels: a hit in one frame is no
    charge of all. None where a dark has too few frames for one."""
    darks = [f for f in fields if not f.lit and f.static is not None and f.exposure_s]
    if not darks or min(f.frames for f in darks) < _FEWEST_FRAMES:
        return None

    def one(f: Fields) -> Fields:
        if f.lit or f.static is None or not f.exposure_s or not len(f.contrasts):
            return f
        root = np.float32(np.sqrt(f.frames))
        inner = helmert(f.frames).T.astype(np.float32) @ f.contrasts[: f.frames - 1, at]
        static = np.array(f.static)
        static[at] += root * median(inner, 0)
        return f._replace(static=static)

    return tuple(one(f) for f in fields)


def by_charge(field: Fields, rate: Float[np.ndarray, "h w"] | None) -> Float[np.ndarray, "h w"]:
    """Variance of the noise with the shot noise of such charge over that without."""
    if rate is None or field.lit or not field.exposure_s:
        return np.ones(field.mean.shape)
    gain = field.gain[channel_index(rate.shape)]
    more = gain**2 * rate * field.exposure_s * field.weight.astype(np.float64) ** 2
    return np.maximum(1 + more, _LEAST)
