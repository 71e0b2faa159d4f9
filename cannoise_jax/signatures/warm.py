"""Frames of a dark that are warmer than others.

Dark current doubles every few kelvin, so a warmer frame is brighter in proportion to the dark current of each
pixel: the contrasts between frames hold the unit's own map of it, times one number a frame. The map is known
from the mean of the frames, of which the contrasts are independent. A pedestal that moves leaves the map
alone, and moves as much in short darks as in long ones, where dark charge moves with the exposure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.core.mechanism import DOUBLING_C
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.group_sums import area_sums
from cannoise_jax.signatures.handed import Addition, Asked, Found
from cannoise_jax.signatures.levels import from_means
from cannoise_jax.signatures.patterns import pixel_sums
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.score import LEAST_LOG_P, Score, chi2_log_sf
from cannoise_jax.signatures.signature import BY_SHIFT, CONTRASTS, ONE_FACTOR, STATIC, Axes, Signature

_FAR, _SURELY = 8.0, 3.0
"""Standard deviations beyond which a value is no part of the noise, and from which on a map shows."""


class Heat(NamedTuple):
    """Map of the dark current, DN per second or per frame, its median taken out, and its unit."""

    field: np.ndarray
    thermal: bool


def dark_map(fields: tuple[Fields, ...]) -> Heat | None:
    """The unit's dark current pixel by pixel as the darks' means show it, shrunk where noise hides it."""
    darks = [f for f in fields if f.kind in DARK and len(f.contrasts)]
    seconds = {f.exposure_s for f in darks}
    thermal = None not in seconds and len(seconds) > 1
    sums = pixel_sums(fields, "exposure" if thermal else "additive", DARK)
    if sums is None:
        return None
    known = sums.information > 0
    if not known.any():
        return None
    estimate = np.where(known, sums.score / np.where(known, sums.information, 1.0), 0.0)
    estimate = estimate - median(estimate[known])
    share, shot = _redrawn(fields, np.where(known, estimate, 0.0), thermal)
    noise = np.where(known, share / np.where(known, sums.information, 1.0), 0.0)
    middle = estimate[known]
    limit = 8 * robust_std(middle, 0)
    mean_noise = float(np.mean(noise[known]))
    variance = max(float(np.mean(np.minimum(middle**2, limit**2))) - mean_noise, 0.0)
    # Warmer frames have more shot noise, and lie nearer to the mean by it: it moves with the temperature too.
    moves = variance > _SURELY * np.sqrt(2 / middle.size) * mean_noise
    told = variance + shot * noise * moves
    # Where the map as a whole does not show, its few far pixels still do.
    far = np.abs(estimate) > 5 * np.sqrt(noise)
    shrunk = np.where(far, estimate, estimate * told / np.maximum(variance + noise, 1e-30))
    return Heat(np.where(known, shrunk, 0.0), thermal) if np.any(shrunk) else None


def _redrawn(
    fields: tuple[Fields, ...], level: Float[np.ndarray, "h w"], thermal: bool
) -> tuple[float, float]:
    """Share of the variance of the darks, as far as they tell of the map, that is left beside offsets of
    frames and this map, and of that the share of shot noise of dark charge. Where the temperature moves, most
    of the variance is no noise of the map."""
    weights, shares, shots = [], [], []
    current = _dark_current(fields)
    for f in (f for f in fields if f.kind in DARK and len(f.contrasts) and f.usable.any()):
        seconds = (f.exposure_s or 0.0) if thermal else 1.0
        left = _less(f, f.contrasts, level * seconds)[:, f.usable]
        share, variance = float(np.mean(left.clip(-_FAR, _FAR) ** 2)), float(median(f.sigma)) ** 2
        weights.append(f.frames * seconds**2 / variance)
        shares.append(share)
        charge = float(np.mean(f.gain)) * current * (f.exposure_s or 0.0)
        shots.append(min(max(charge, 0.0) / max(share * variance, 1e-12), 1.0))
    if not np.any(weights):
        return 1.0, 0.0
    return min(float(np.average(shares, weights=weights)), 1.0), float(np.average(shots, weights=weights))


def _noise(f: Fields) -> Float[np.ndarray, "h w"]:
    """What the contrasts are in units of, DN."""
    return f.sigma * f.louder


def _whole(f: Fields) -> Float[np.ndarray, "h w"]:
    """What an offset of the whole frame is in contrasts, of norm one: less where the noise is more."""
    one = f.usable / _noise(f)
    return one / np.sqrt(max(float(np.sum(one**2)), 1e-30))


def _less(
    f: Fields, contrasts: Float[np.ndarray, "n h w"], level: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "n h w"]:
    """Contrasts without what whole frames share, and without a map, DN."""
    unit = _whole(f)

    def apart(values: Float[np.ndarray, "*n h w"], shape: Float[np.ndarray, "h w"]):
        return values - np.einsum("...ij,ij->...", values, shape)[..., None, None] * shape

    t = apart(f.usable * level / _noise(f), unit)
    power = float(np.sum(t**2))
    c = apart(contrasts, unit)
    return apart(c, t / np.sqrt(power)) if power > 0 else c


def _alike(
    contrasts: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"]
) -> Float[np.ndarray, "n h w"]:
    """Contrasts of one variance, and independent: warmer frames have more shot noise, so that contrasts
    between frames are unlike and correlated, and the error of the map moves with the temperature as well."""
    near = contrasts[:, usable].clip(-_FAR, _FAR)
    values, vectors = np.linalg.eigh(near @ near.T / near.shape[1])
    scale = np.sqrt(np.maximum(values, 1e-6) / max(float(values.mean()), 1e-6))
    return np.einsum("nk,k,mk,mij->nij", vectors, 1 / scale, vectors, contrasts, optimize=True)


def _own(
    contrasts: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"], unit: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "n h w"]:
    """Contrasts without what channels, rows, columns and small areas share, DN: of far pixels no more than
    four standard deviations, or they would spread over their lines. unit: what an offset of all pixels is in
    each, relative to others."""
    weight = usable * unit**2
    near = contrasts.clip(-4, 4) / unit
    shared = np.zeros_like(contrasts)
    channel = channel_index(usable.shape)
    for c in range(4):
        chosen = channel == c
        if weight[chosen].any():
            shared[:, chosen] = np.average(near[:, chosen], axis=1, weights=weight[chosen])[:, None]
    near = (near - shared) * weight
    row = near.sum(2, keepdims=True) / np.maximum(weight.sum(1)[None, :, None], 1e-12)
    column = near.sum(1, keepdims=True) / np.maximum(weight.sum(0)[None, None, :], 1e-12)
    return _without_areas((contrasts - (shared + row + column) * unit) * usable, usable, unit)


_AREA = 8
"""Pixels a side of the areas whose means are no part of the map."""


def _without_areas(
    values: Float[np.ndarray, "*n h w"], usable: Bool[np.ndarray, "h w"], unit: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "*n h w"]:
    """Without the means of small areas. What regions share moves from frame to frame, and what of it is left
    in the mean of a few frames is in the map as well: their products are large by chance. Of far pixels no
    more than of the others, or they would spread over their areas."""
    limit = 4 * max(robust_std(values[..., usable], 0), 1e-12) if usable.any() else 0.0
    weight = (usable * unit**2).astype(np.float32)
    means = area_sums(values.clip(-limit, limit) / unit * weight, _AREA)
    means = means / np.maximum(area_sums(weight, _AREA), 1e-12)
    rows, columns = (np.arange(n) // _AREA for n in usable.shape)
    return (values - means[..., rows[:, None], columns] * unit) * usable


def _template(f: Fields, c: np.ndarray, level: np.ndarray, shot: np.ndarray, usable: np.ndarray):
    """The map in standard deviations, the contrasts beside it, and the weight of every pixel."""
    noise = _noise(f)
    weight, unit = usable / (1 + 1.5 * shot), float(median(noise)) / noise
    template = level / noise
    # An offset of the whole frame is no part of it.
    offset = np.sum(weight * unit * template) / max(float(np.sum(weight * unit**2)), 1e-9)
    template = _without_areas((template - offset * unit) * usable, usable, unit)
    return template, _own(c, usable, unit), weight


_OTHERS = 1e-3
"""Least share of the information that the others have beside one pixel: with none they tell of no change."""


def _by_map(fields: tuple[Fields, ...], heat: Heat):
    """Per contrast of every dark: factor of the map, and its information: without a change, by the scatter of
    single pixels; and beside one, by residuals about what all other pixels tell (HC3, MacKinnon and White,
    J. Econometrics 29, 1985), as a large change is part of the former."""
    values: list[float] = []
    information: list[float] = []
    beside: list[float] = []
    for f in fields:
        if f.kind not in DARK or f.frames < 2 or not len(f.contrasts):
            continue
        seconds = (f.exposure_s or 0.0) if heat.thermal else 1.0
        level = heat.field * seconds
        shot = float(np.mean(f.gain)) * np.maximum(level, 0.0) / _noise(f) ** 2
        c = f.contrasts[: f.frames - 1]
        power = np.mean(c**2, 0)
        template, rest, weight = _template(f, c, level, shot, f.usable)
        i = float(np.sum(weight * template**2))
        if i <= 0:
            continue
        # Telegraph pixels lie where the map is high too; they move as they please.
        factor = np.einsum("nij,ij->n", rest, weight * template) / i
        power = np.mean((rest - factor[:, None, None] * template) ** 2, 0)
        calm = power < (1 + 2 * shot) * stats.chi2.isf(1e-3, len(c)) / len(c)
        template, rest, weight = _template(f, c, level, shot, f.usable & calm)
        # Of pixels that move more than their shot noise does each says less.
        weight = weight / np.maximum(power / (1 + 1.5 * shot), 1.0)
        i = float(np.sum(weight * template**2))
        if i <= 0:
            continue
        # The scatter of single pixels, whatever the shot noise of the hot ones.
        told = rest * (weight * template)
        square, own = (weight * template) ** 2, weight * template**2
        factor = told.sum((1, 2)) / i
        others = (factor[:, None, None] * i - told) / np.maximum(i - own, _OTHERS * i)
        values += list(factor)
        for scatter, kept in ((rest**2, information), ((rest - others * template) ** 2, beside)):
            kept += list(i**2 / np.maximum(np.einsum("nij,ij->n", scatter, square), 1e-30))
    return np.array(values), np.array(information), np.array(beside)


def _offsets(fields: tuple[Fields, ...]):
    """Offset of every contrast of the darks, DN, its variance by pixel noise, and exposure."""
    offsets, doubt, seconds = [], [], []
    for f in fields:
        if f.kind not in DARK or f.frames < 2 or not f.exposure_s or not f.usable.any():
            continue
        sigma = float(median(f.sigma[f.usable]))
        for c in f.contrasts[: f.frames - 1]:
            middle = c[f.usable]
            offsets.append(sigma * float(np.mean(np.clip(middle, -6, 6))))
            doubt.append(sigma**2 * (1 / middle.size + 1 / 400 / min(f.mean.shape)))
            seconds.append(float(f.exposure_s))
    return np.array(offsets), np.array(doubt), np.array(seconds)


def _best(power: np.ndarray, doubt: np.ndarray, unit: np.ndarray) -> tuple[float, float, float]:
    """Largest log likelihood of offsets of variance doubt + a + v unit^2, for v and for a alone, and the rms
    per unit of the first."""

    def log(variance: np.ndarray) -> float:
        return -0.5 * float(np.sum(np.log(variance) + power / variance))

    grid = np.append(0.0, np.geomspace(1e-4, 1e4, 81)) * max(float(np.mean(power)), 1e-12)
    scaled = unit / unit.max()
    thermal = [log(doubt + v * scaled**2) for v in grid]
    additive = [log(doubt + v) for v in grid]
    k = int(np.argmax(thermal))
    # Beside the dark charge the pedestal may move a little.
    both = max(log(doubt + grid[k] * scaled**2 + a) for a in grid[: max(k // 2, 1)])
    return max(thermal[k], both), max(additive), float(np.sqrt(grid[k])) / float(unit.max())


_TWO_WITNESSES = 4.0
"""Nats of the changes of temperature, told by the map or by the offsets: log(2), and 0.5 log(n) of n = 700.
Of tens of frames the second would be 1.7. Six sets without it gained 3.7 on average and 7.6 at most, p =
0.02."""
_MOST = 3.0
"""Relative change of the dark current beyond which no temperature moves it from frame to frame: 27 K."""


def warm_score(fields: tuple[Fields, ...]) -> Score[Heat | None] | None:
    """Dark current that moves from frame to frame: its map in the contrasts between frames, and offsets that
    grow with the exposure. Amplitude: rms change of the temperature, K."""
    heat = dark_map(fields)
    log_p, gain, relative, error = 0.0, 0.0, 0.0, np.inf
    if heat is not None:
        value, information, beside = _by_map(fields, heat)
        if value.size >= 2:
            chi2 = float(np.sum(value**2 * information))
            log_p = chi2_log_sf(chi2, value.size)
            gain = 0.5 * max(chi2 - value.size, 0.0)
            spread = float(np.sum(beside * value**2) - value.size) / float(np.sum(beside))
            relative = float(np.sqrt(max(spread, 0.0)))
            error = float(1 / np.sqrt(np.sum(beside) * np.sqrt(2 / value.size)) / np.sqrt(2))
    offsets, doubt, seconds = _offsets(fields)
    by_offset = 0.0
    if offsets.size >= 4 and np.unique(seconds).size >= 2 and seconds.max() > 3 * seconds.min():
        thermal, additive, rate = _best(offsets**2, doubt, seconds)
        by_offset = max(thermal - additive, 0.0)
        current = _dark_current(fields)
        asked = rate / current if current > 0 else np.inf
        if asked > (_MOST if heat is None else min(relative + 3 * error, _MOST)):
            by_offset = 0.0  # the map would have moved with them
        elif by_offset > 6 and not relative:
            relative, error = asked, asked / np.sqrt(2 * offsets.size)
    # A likelihood ratio of two laws that both fit offsets of frames: its inverse bounds the chance of it.
    by_offset_p = -by_offset if by_offset > 6 else 0.0
    if heat is None and not by_offset:
        return None
    both = min(log_p, by_offset_p) + np.log(2)
    kelvin = DOUBLING_C / np.log(2)
    # Of normal kelvin the charge is log-normal, of such a spread over its mean: no small one where light that
    # leaks in is taken for it.
    spread = float(np.sqrt(np.log1p(relative**2)))
    amplitude = spread * kelvin
    slope = relative / spread / (1 + relative**2) if spread > 0 else 1.0
    shift = float(min(error, 10.0) * kelvin * slope)
    return Score(
        log_p=float(np.clip(both, LEAST_LOG_P, 0.0)),
        gain=gain + by_offset,
        penalty=_TWO_WITNESSES,
        amplitude=amplitude,
        error=shift,
        shift=shift,
        power=2,
        parameters={
            "change": (relative, "1", float(min(error, 10.0))),
            "current": (_dark_current(fields) / max(float(np.mean(fields[0].gain)), 1e-9), "e-/s", 0.0),
        },
        where={"axis": "frame"},
        payload=heat,
    )


def _dark_current(fields: tuple[Fields, ...]) -> float:
    """DN per second by which the mean of the darks grows with the exposure."""
    darks = [f for f in fields if f.kind in DARK and f.exposure_s is not None and f.usable.any()]
    x = np.array([float(f.exposure_s or 0.0) for f in darks])
    y = np.array([float(median(f.mean[f.usable])) for f in darks])
    x = from_means(x, np.array([f.group for f in darks], int), np.ones(x.shape))
    return float(x @ y / (x @ x)) if np.any(x) else 0.0


def without_warmth(fields: tuple[Fields, ...], score: Score[Heat | None]) -> tuple[Fields, ...]:
    """Dark contrasts without the map and, where several exposures say that dark charge moves, without their
    own mean, which that moves as well; all of one variance."""
    heat = score.payload
    out = []
    for f in fields:
        if f.kind in DARK and len(f.contrasts) and f.usable.any():
            seconds = 1.0 if heat is None or not heat.thermal else f.exposure_s or 0.0
            level = np.zeros(f.mean.shape) if heat is None else heat.field * seconds
            c = _less(f, f.contrasts, level)
            if heat is not None:
                c = _alike(c, f.usable)
            if not _moves_offsets(score):
                unit = _whole(f)
                c = c + np.einsum("nij,ij->n", f.contrasts, unit)[:, None, None] * unit
            f = f._replace(contrasts=c.astype(np.float32))
        out.append(f)
    return tuple(out)


def _moves_offsets(score: Score[Heat | None]) -> bool:
    """Whether what whole frames share is known to move with the dark charge."""
    return score.payload is None or score.payload.thermal


def warming(
    *, name: str, offsets: tuple[str, ...], lifted_by: tuple[str, ...], beside: dict[str, dict[str, float]]
) -> Signature:
    """Dark current that is more in one frame than in another. offsets: signatures of what whole frames share.
    beside: as `Addition` has it, for what adds the dark current itself."""

    def values(score: Score) -> dict[str, float]:
        return {"sigma_k": score.amplitude, "e_per_s": max(score.parameters["current"][0], 0.0)}

    def simulate(found: Found) -> Addition:
        return carried(values)(found)._replace(beside=beside)

    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "exposure", ONE_FACTOR),
        reads=CONTRASTS | STATIC | {"mean"},
        score=warm_score,
        absorb=without_warmth,
        simulate=simulate,
        covers=(),
        hides=lambda score: offsets if _moves_offsets(score) else (),
        lifted_by=lifted_by,
        detectable=_in_kelvin,
    )


def _in_kelvin(asked: Asked, score: Score, mechanism: str) -> float:
    """None where no look holds darks of several exposures: of what does not grow with them nothing says how
    much of it is dark current, which kelvin are told by."""
    told = [known for fields in asked.looks if (known := dark_map(fields)) is not None]
    return BY_SHIFT(asked, score, mechanism) if any(known.thermal for known in told) else float("inf")
