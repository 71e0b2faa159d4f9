"""Single frames in which a pixel stands far above its own level: cosmic rays, and charge of the clocking.

A hit adds charge to a few adjoining pixels of one frame and never comes back to them. Seen from the mean of
its recording a frame is standard normal, so what is beyond five and a half standard deviations while the
other frames of that pixel are quiet is no Gaussian noise. What else does that is told apart:

- heavy tails lie on both sides: the frames below are as many as those above;
- telegraph pixels come back: to one of them the next spike belongs with a chance that its duty sets;
- hot pixels stay: without the spike they are as high as in any other frame;
- shot noise of few electrons is skewed: the limit is that of a gamma law of its skewness;
- clock-induced charge comes with every readout: its rate does not grow with the exposure, and it draws no
  tracks.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import ndimage, special, stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, each_frame, without_pixels
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.remembered import remembered
from cannoise_jax.signatures.score import LEAST_LOG_P, Score
from cannoise_jax.signatures.signature import CONTRASTS, STATIC, Axes, Signature
from cannoise_jax.signatures.tracks import CELL, tracks

FAR = 5.5
"""Standard deviations of normal noise from which on a frame counts as a spike."""
_QUIET = 1e-3
"""Chance that the other frames of a pixel of normal noise are too noisy to call the spike alone."""
_RETURNS = 0.2
"""Share of the spikes of telegraph pixels, seen once, whose pixel shows another in the frames at hand, at
least: less is a duty of far below one frame in all."""
_MOST_ONCE = 0.35
"""Share of pixels that are hit once, up to which few are hit more often; of any number it is 0.37 at most."""
_TRACKS = 1.5
"""By which more pixels are hit twice than there would be by single hits that all stand out: tracks cross in
several pixels, and faint ends of one lie on another."""


class Spikes(NamedTuple):
    """Spikes of one recording `[t, h, w]`: up and down; back: those above at pixels that spike or are noisy
    elsewhere too. gain: nats by which the ones above are less likely than noise. earlier: pixels `[h, w]`
    that were hit in the frames before, from which all of these then differ alike."""

    number: int
    up: np.ndarray
    down: np.ndarray
    noisy: np.ndarray
    exposure_s: float
    frames: int
    dark: bool
    gain: float
    earlier: np.ndarray


def limit_of(field: Fields) -> np.ndarray:
    """Standard deviations that noise with the skewness of its shot noise, twice that for an electron
    multiplier, exceeds as seldom as normal noise does `FAR`."""
    electrons = np.maximum(field.signal, 0) * float(np.mean(field.gain)) ** 2
    skewness = np.clip(2 * electrons / field.sigma.astype(np.float64) ** 3, 0, 2)
    grid = np.linspace(0.01, 2, 60)
    shape = 4 / grid**2
    at = (stats.gamma.isf(stats.norm.sf(FAR), shape) - shape) / np.sqrt(shape)
    return np.interp(skewness, np.append(0, grid), np.append(FAR, at))


@remembered("contrasts", "static", "usable", "sigma", "signal")
def _spikes(field: Fields) -> Spikes | None:
    """Frames that stand alone, far above or below the others of their pixel."""
    if field.frames + min(field.before, 2) < 3 or median(field.sigma) < 0.4 * field.step:
        return None
    power = np.einsum("nij,nij->ij", field.contrasts, field.contrasts)
    frames = np.stack(list(each_frame(field, static=False)))
    if field.before:  # from the mean of the frames before to that of all others
        number = field.frames + field.before
        frames *= np.float32(np.sqrt(1 + 1 / field.before))
        frames = (frames - frames.sum(0) / np.float32(number)) / np.float32(np.sqrt(1 - 1 / number))
    farthest = np.argmax(np.abs(frames), 0)[None]
    value = np.take_along_axis(frames, farthest, 0)[0]
    freedom = len(field.contrasts) - 1
    quiet = (power - value**2 < stats.chi2.isf(_QUIET, freedom)) if freedom else np.isfinite(value)
    # The shot noise of the charge itself is in one frame only; of what is left of a spike in the others
    # rounding keeps some.
    alone = quiet & (np.abs(value) > limit_of(field)) & field.usable
    if field.static is not None and field.frames > 2:
        others = field.static / np.sqrt(field.frames) - value / np.sqrt(field.frames * (field.frames - 1))
        alone &= np.abs(others) * np.sqrt(field.frames - 1) < FAR
    at = np.arange(field.frames)[:, None, None] == farthest
    earlier = np.zeros(power.shape, bool)
    if field.before:
        inner = power - field.contrasts[-1] ** 2
        still = inner < stats.chi2.isf(_QUIET, freedom) if freedom else np.ones(power.shape, bool)
        earlier = still & (field.contrasts[-1] < -limit_of(field)) & field.usable
    noisy = (power > stats.chi2.isf(1e-5, len(field.contrasts))) & ~alone & ~earlier & field.usable
    up = at & alone & (value > 0)
    gain = float(np.sum(0.5 * np.minimum(value[up.any(0)], 1e3) ** 2 - np.log(max(value.size, 2))))
    down = at & alone & (value < 0) & ~earlier
    seconds = field.exposure_s or 0.0
    return Spikes(field.number, up, down, noisy, seconds, field.frames, not field.lit, gain, earlier)


def find(fields: tuple[Fields, ...]) -> list[Spikes]:
    """The spikes of every recording of three frames or more."""
    return [s for f in fields if (s := _spikes(f)) is not None]


class Count(NamedTuple):
    """up, down: spikes that do not come back; back: those above that do; again: the share of those above
    whose pixel shows another one by chance. pairs: spikes beside another of the same frame, chance: those
    that fall there by chance. tracks: groups of adjoining ones."""

    up: int
    down: int
    back: int
    again: float
    pairs: int
    chance: float
    tracks: int


def restless(spikes: Spikes) -> np.ndarray:
    """Pixels `[h, w]` that spike or are noisy in a recording."""
    return spikes.up.any(0) | spikes.down.any(0) | spikes.noisy


def count(found: list[Spikes]) -> Count:
    """Counts over all recordings."""
    size = found[0].noisy.shape
    each = [restless(s) for s in found]
    hit, still = np.sum(each, axis=0), [1 - float(pixels.mean()) for pixels in each]
    up = down = back = pairs = tracks = 0
    chance = met = 0.0
    for n, s in enumerate(found):
        again = hit > 1
        back += int((s.up.any(0) & again).sum())
        met += int(s.up.any(0).sum()) * (1 - float(np.prod(still[:n] + still[n + 1 :])))
        down += int((s.down.any(0) & ~again).sum())
        for frame in s.up:
            alone = frame & ~again
            number = int(alone.sum())
            if not number:
                continue
            beside = ndimage.convolve(alone.astype(np.int8), CELL.astype(np.int8), mode="constant") > 1
            up += number
            pairs += int((beside & alone).sum())
            chance += number * 8 * number / (size[0] * size[1])
            tracks += int(ndimage.label(alone, CELL)[1])
    return Count(up, down, back, met / max(up + back, 1), pairs, chance, tracks)


def _per_frame(found: list[Spikes]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Number of spikes, frames and exposure of every dark."""
    darks = [s for s in found if s.dark]
    number = np.array([float(s.up.sum()) for s in darks])
    return number, np.array([s.frames for s in darks], float), np.array([s.exposure_s for s in darks])


def by_exposure(fields: tuple[Fields, ...]) -> tuple[float, float]:
    """log p of hits that come as often at every exposure, and of hits in proportion to it."""
    return _grows_log_p(find(fields))


def _grows_log_p(found: list[Spikes]) -> tuple[float, float]:
    """log p that the rate per frame is the same at every exposure, against one that grows with it, and that
    it grows in proportion, against one that does not; 0 each where the exposures tell nothing."""
    number, frames, seconds = _per_frame(found)
    if number.size < 2 or seconds.max() < 2 * max(seconds.min(), 1e-12) or number.sum() < 5:
        return 0.0, 0.0
    long = seconds > np.sqrt(max(seconds.min(), 1e-6 * seconds.max()) * seconds.max())
    total, there = number.sum(), number[long].sum()
    same = frames[long].sum() / frames.sum()
    grown = (frames * seconds)[long].sum() / (frames * seconds).sum()
    return float(stats.binom.logsf(there - 1, total, same)), float(stats.binom.logcdf(there, total, grown))


def log_p_of(found: list[Spikes], seen: Count, kind: str) -> float:
    """log p of spikes that neither tails (as many below), nor telegraph pixels (which come back) make, and
    that come as hits do, or as charge of the clocking."""
    pixels = sum(s.noisy.size * s.frames for s in found)
    # A hundredth of an expected spike: no law of the noise is known better than that.
    noise = float(stats.poisson.logsf(seen.up - 1, pixels * stats.norm.sf(FAR) + 0.01))
    sides = float(stats.binom.logsf(seen.up - 1, seen.up + seen.down, 0.5))
    # Where many pixels are hit a spike meets another one, whatever made it.
    least = seen.again + _RETURNS * (1 - seen.again)
    returns = float(stats.binom.logcdf(seen.back, seen.up + seen.back, least))
    tracks = float(stats.poisson.logsf(seen.pairs - 1, seen.chance + 0.01))
    grows, proportional = _grows_log_p(found)
    if kind == "hits":
        # Tracks, or single pixels that do not come back and grow in number with the exposure.
        own = min(tracks, max(returns, grows) if grows or proportional else returns) + np.log(2)
        # As many in short darks as in long ones, and no tracks: the clocking.
        if not tracks < -7 and proportional < -7 and not grows < -7:
            return 0.0
    else:
        single = seen.pairs < 0.2 * seen.up + 3 * seen.chance
        own = max(returns, proportional) if single and not grows < -7 else 0.0
    return min(0.0, max(noise, sides, own))


_OF_UNSEEN = 0.1
"""Share of the events that do not stand out by which their number may be wrong: it follows from a law of
their sizes."""


class Heights(NamedTuple):
    """Spikes above the level of their pixels, DN: how far, the limit from which on they are spikes, the noise
    of their pixel, and the gain, each of every spike."""

    height: np.ndarray
    limit: np.ndarray
    sigma: np.ndarray
    gain: np.ndarray


def heights(fields: tuple[Fields, ...], found: list[Spikes]) -> Heights:
    """Those of all recordings."""
    by_number, parts = {f.number: f for f in fields}, []
    for s in (s for s in found if s.up.any()):
        f = by_number[s.number]
        others, limit = f.before or f.frames - 1.0, limit_of(f) * f.sigma
        for frame, up in zip(each_frame(f, static=False), s.up, strict=True):
            height = frame[up] * f.sigma[up] * np.sqrt((others + 1) / others)
            parts.append((height, limit[up], f.sigma[up], np.full(height.size, float(np.mean(f.gain)))))
    if not parts:
        return Heights(*np.zeros((4, 0)))
    return Heights(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class Hidden(NamedTuple):
    """How many events there are for each that stands out of the noise, infinite where none can; and their
    mean size over that of one electron by the gain that variance tells."""

    times: float = 1.0
    size: float = 1.0


def nothing_hidden(fields: tuple[Fields, ...], found: list[Spikes], spikes: Heights) -> Hidden:
    """Events that all stand out."""
    return Hidden()


def spike_score(
    fields: tuple[Fields, ...],
    *,
    kind: str,
    hidden: Callable[[tuple[Fields, ...], list[Spikes], Heights], Hidden] = nothing_hidden,
) -> Score[float] | None:
    """Spikes of single frames as hits of cosmic rays make them, or as clocking does. Amplitude: events per
    megapixel and second, or electrons per pixel and frame. Payload: `Hidden.size`."""
    found = find(fields)
    if kind == "clocking":
        found = [s for s in found if s.dark]
    if not found or (kind == "clocking" and not any(len(_per_frame([s])[0]) for s in found)):
        return None
    seen = count(found)
    log_p = log_p_of(found, seen, kind) if seen.up else 0.0
    gain = sum(s.gain for s in found if s.up.any()) if seen.up else 0.0
    size = found[0].noisy.size
    if kind == "hits":
        # Where no exposure is known or all are zero a frame counts as one second.
        known = any(s.exposure_s > 0 for s in found)
        volume = sum(s.frames * (s.exposure_s if known else 1.0) for s in found) * size / 1e6
    else:
        volume = sum(s.frames for s in found) * float(size)
    unit = 1 / volume if volume > 0 else float("inf")
    spikes = heights(fields, found)
    times, each = hidden(fields, found, spikes)
    events, charge = seen.up, _charge(found, spikes)
    if kind == "hits":
        events, charge = _of_tracks(fields, found, seen, charge)
    all_of = unit * times if np.isfinite(times) else unit
    where = {"axis": "pixel", "pixels": seen.up}
    unseen = _OF_UNSEEN * max(1 - 1 / times, 0.0) if np.isfinite(times) and times > 0 else 0.0
    return Score(
        log_p=max(log_p, LEAST_LOG_P),
        gain=max(gain, 0.0),
        penalty=float(np.log(max(size, 2))),
        amplitude=events * all_of,
        error=float(np.hypot(np.sqrt(max(events, 1)), unseen * events)) * all_of,
        shift=3 * unit * times,
        power=1,
        parameters={"charge_e": (charge, "e-", charge / np.sqrt(max(events, 1)))},
        where=where,
        payload=each,
    )


def _charge(found: list[Spikes], spikes: Heights) -> float:
    """Mean charge of a spike beyond the limit, electrons."""
    total = float(np.sum(spikes.height / np.maximum(spikes.gain, 1e-9)))
    events = sum(int(ndimage.label(up, CELL)[1]) for s in found for up in s.up)
    return total / events if events else 0.0


def _of_tracks(
    fields: tuple[Fields, ...], found: list[Spikes], seen: Count, charge: float
) -> tuple[int, float]:
    """How many particles have hit, and the mean charge of one; by the spikes that stand alone, see `charge`,
    where there are few frames."""
    by_number = {f.number: f for f in fields}
    often = np.sum([restless(s) for s in found], axis=0) > 1
    # Beside pixels that jump: by chance alone no more spikes come back than these.
    comes_back = seen.back > stats.poisson.isf(1e-3, seen.again * (seen.up + seen.back))
    told = [
        tracks(
            by_number[s.number],
            (s.up.any(0) | _twice(s)) & ~(often & comes_back),
            limit_of(by_number[s.number]),
        )
        for s in found
        if s.up.any()
    ]
    known = [t for t in told if t is not None]
    number = sum(t.number for t in known)
    if not number or len(known) < len(told):
        return seen.tracks, charge
    return number, sum(t.charge_e for t in known) / number


def _twice(spikes: Spikes) -> np.ndarray:
    """Noisy pixels `[h, w]`, where there are no more of them than are hit twice by chance."""
    once = float(np.any(spikes.up, 0).mean())
    # Of hits that fall by chance: a pixel has one with the chance h exp(-h), h a pixel and recording.
    hits = -float(np.real(special.lambertw(-min(once, _MOST_ONCE))))
    chance = spikes.noisy.size * -float(np.expm1(np.log1p(hits) - hits))
    few = spikes.noisy.sum() <= stats.poisson.isf(1e-3, _TRACKS * chance)
    return spikes.noisy if few else np.zeros_like(spikes.noisy)


def without_spikes(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """The fields without the pixels that were hit, and those beside them, in the recording where they were:
    the faint ends of a track lie beside its bright pixels. Of many hits a few meet the same pixel twice."""
    hit = {s.number: ndimage.binary_dilation(s.up.any(0) | s.earlier | _twice(s), CELL) for s in find(fields)}
    out = []
    for f in fields:
        mask = hit.get(f.number)
        if mask is None or not mask.any():
            out.append(f)
            continue
        out += without_pixels((f,), mask)
    return tuple(out)


def hits(*, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """Charge that single frames have and no other, more of it in longer exposures."""
    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "exposure", "sparse"),
        reads=CONTRASTS | STATIC | {"signal"},
        score=partial(spike_score, kind="hits"),
        absorb=without_spikes,
        simulate=carried(lambda s: {"rate": s.amplitude, "charge_e": max(s.parameters["charge_e"][0], 1.0)}),
        covers=covers,
        lifted_by=lifted_by,
        rare=True,
        form_free=True,  # tracks of all lengths, charges of all particles
    )
