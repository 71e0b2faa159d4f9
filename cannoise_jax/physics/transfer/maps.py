"""The fixed patterns of one camera unit, as its recordings show them.

An average of frames holds the pattern and the noise that is left. Of what is seen, each pixel (or row, or
column) keeps the share w = pattern / (pattern + noise) of the variances, its mean value given the recordings
(James and Stein), so that a map is no picture of noise. What the recordings leave open, the share 1 - w of
the pattern's variance, is drawn from the unit's key, so that the pattern has the strength that was measured.
Hot and telegraph pixels are those that are more likely so than not.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import special, stats

from cannoise_jax.physics.core.chain import mechanism_key
from cannoise_jax.physics.core.poisson_gaussian import sample_normal
from cannoise_jax.physics.core.sensor import Fitted, SensorModel, Settings
from cannoise_jax.physics.core.settings import black_levels, of_larger_gain, with_black_levels
from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import NotMeasurable, root
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.physics.transfer.estimators import charge
from cannoise_jax.physics.transfer.estimators import glow as glows
from cannoise_jax.physics.transfer.estimators import telegraph as telegraph_pixels
from cannoise_jax.physics.transfer.estimators.light_alone import light_alone
from cannoise_jax.physics.transfer.estimators.loud_lines import lines_of
from cannoise_jax.physics.transfer.estimators.maps import (
    Pattern,
    column_part,
    offset_pattern,
    pixel_part,
    response_pattern,
    white_lines,
)
from cannoise_jax.physics.transfer.estimators.pick import (
    brightest_flat,
    column_offsets,
    darkest,
    row_offsets,
    steady_pixels,
    without_step,
)
from cannoise_jax.physics.transfer.fit import robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.noise_of_lines import Line
from cannoise_jax.physics.transfer.spatial import temporal_mean_square
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import site

Statistics = Sequence[FrameStatistics]
_ROUNDS = 20
"""Of taking the mean out of currents that are cut off at zero: less than a thousandth of it is left."""


class Seen(NamedTuple):
    """What a map is made of: recordings, the baseline that was measured on them, standard normal numbers of a
    shape from the unit's key, and the mechanisms before it in the chain with their maps."""

    statistics: Statistics
    baseline: Baseline
    draw: Callable[[tuple[int, ...]], np.ndarray]
    known: tuple[Fitted, ...]

    def earlier(self, has: Callable[[Fitted], bool]) -> Fitted | None:
        """The mechanism of a kind that has maps and stands before in the chain."""
        return next((f for f in self.known if f.maps and has(f)), None)


def _is_charge(fitted: Fitted) -> bool:
    """Whether it adds dark charge."""
    return fitted.record.acts_on == "mean" and fitted.record.stage == "pixel"


def _is_heat(fitted: Fitted) -> bool:
    """Whether it adds dark charge to few pixels, which the read noise leaves out."""
    point = fitted.record.point
    return _is_charge(fitted) and point.distribution == "sparse" and point.combine == "add"


def _jumps(fitted: Fitted) -> bool:
    return fitted.record.point.time == "telegraph"


class _Jumps(NamedTuple):
    """What telegraph pixels, which stand before in the chain, have in the frames of a dark."""

    of_mean: Float[np.ndarray, "H W"]
    """Variance of the mean of the frames by jumps, DN^2; 0 at other pixels."""
    of_frames: Float[np.ndarray, "H W"]
    """Variance about that mean, DN^2."""


def _jumps_in(dark: FrameStatistics, seen: Seen) -> _Jumps:
    telegraph = seen.earlier(_jumps)
    if telegraph is None:
        return _Jumps(np.zeros(dark.mean.shape), np.zeros(dark.mean.shape))
    variance = (telegraph.parameters["jump_dn"] * np.asarray(telegraph.maps["sites"])[0]) ** 2 / 4
    lasting = telegraph_pixels.lasting(dark.recording.count, telegraph.parameters["rate"])
    return _Jumps(variance * lasting, variance * (1 - lasting))


def with_measured_maps(
    model: SensorModel,
    statistics: Statistics,
    left: Statistics,
    baseline: Baseline,
    estimators: Mapping[str, Estimator],
) -> SensorModel:
    """The model with the maps of the unit that was recorded, where its mechanisms have any and the recordings
    show them; the others stay as they are drawn from the unit's key. estimators: by id. left: the
    recordings for what is frozen (see `Estimator.without`)."""
    kept: list[Fitted] = []
    for i, fitted in enumerate(model.mechanisms):
        key = mechanism_key(model.unit_key, model, i)

        def draw(shape: tuple[int, ...], key=key) -> np.ndarray:
            return np.asarray(sample_normal(key, shape), np.float64)

        estimator = estimators[fitted.mechanism]
        measure = estimator.maps
        seen = Seen(left if estimator.frozen else statistics, baseline, draw, tuple(kept))
        maps = measure(fitted.parameters, seen) if measure else {}
        stored = {name: jnp.asarray(values, jnp.float32) for name, values in maps.items()}
        kept.append(dataclasses.replace(fitted, maps=stored))
    return dataclasses.replace(model, mechanisms=tuple(kept))


def without_charge(model: SensorModel, exposures: Sequence[float], size: tuple[int, int]) -> SensorModel:
    """The model with a black level and a read noise that leave out the dark charge of the darks they were
    measured on, which its mechanisms add. exposures: of that dark at every ISO of the baseline, seconds.
    """
    gain, read = np.asarray(model.gain_dn_per_e), np.asarray(model.read_noise_e) * model.gain_dn_per_e
    read2 = np.asarray(read, np.float64) ** 2
    levels = black_levels(model)
    for n, seconds in enumerate(exposures):
        spread = _charge(model, lambda f: _is_charge(f) and not _is_heat(f), n, seconds, size)
        read2[n] = np.maximum(read2[n] - gain[n] * spread, 0.01 * read2[n])
        levels[n] -= _charge(model, _is_charge, n, seconds, size)
    quiet = (np.sqrt(read2) / gain).astype(np.float32)
    return dataclasses.replace(with_black_levels(model, levels), read_noise_e=quiet)


def _charge(
    model: SensorModel, some: Callable[[Fitted], bool], n: int, seconds: float, size: tuple[int, int]
) -> Float[np.ndarray, "4"]:
    """Mean of what some mechanisms add in a dark at the n-th ISO, DN per mosaic site."""
    bare = dataclasses.replace(model, mechanisms=tuple(f for f in model.mechanisms if some(f)))
    at = Settings(float(np.asarray(model.iso)[n]), seconds)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a dark outside the range of its own calibration is no news
        mean = np.asarray(bare.expected(jnp.zeros(size), at), np.float64)
    return np.array([float(np.mean(site(mean, c))) for c in range(4)]) - black_levels(model)[n]


def without_repetition(
    model: SensorModel, statistics: Statistics, estimators: Mapping[str, Estimator]
) -> SensorModel:
    """The model with a baseline that leaves out what its mechanisms add or take away; dark charge:
    `without_charge`.

    Photon transfer measures the baseline on frames that show all mechanisms. Crosstalk, image lag and
    in-camera denoising have lowered the slope of the variance, the last also the read noise; telegraph pixels
    that the rule for outliers keeps have raised the read noise. What was found in electrons stays the same in
    DN.
    """
    gain, read = np.asarray(model.gain_dn_per_e), np.asarray(model.read_noise_e) * model.gain_dn_per_e
    for fitted in model.mechanisms:
        if smooths := estimators[fitted.mechanism].smooths:
            kept = smooths(next(iter(fitted.parameters.values())), statistics)
            gain = gain / kept
            read = read if fitted.record.acts_on == "charge" else read / np.sqrt(kept)
        dark = darkest(statistics)
        if _jumps(fitted) and fitted.maps and dark is not None:
            quiet, keep = np.asarray(fitted.maps["sites"])[0] == 0, steady_pixels(dark)
            for c in range(4):
                variance, inside = pixel_variance(dark, c), site(keep, c)
                if not (inside & site(quiet, c)).any():
                    continue  # where every pixel jumps nothing shows what is left without
                alone = float(variance[inside & site(quiet, c)].mean() / variance[inside].mean())
                read[:, c] = read[:, c] * np.sqrt(min(alone, 1.0))
    grown = float(np.mean(gain / model.gain_dn_per_e))
    return dataclasses.replace(
        model,
        gain_dn_per_e=gain.astype(np.float32),
        read_noise_e=(read / gain).astype(np.float32),
        mechanisms=tuple(of_larger_gain(fitted, grown) for fitted in model.mechanisms),
    )


def shrunk(
    shown: np.ndarray, sigma: float, noise_variance: float | np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """A pattern in units of its rms `sigma`: the seen one shrunk by its noise, filled up with standard normal
    numbers `rest`."""
    share = sigma**2 / (sigma**2 + noise_variance)
    return share * shown / sigma + np.sqrt(1 - share) * rest


def _of_pixels(
    found: Pattern, sigma: float, noise: float | np.ndarray, light: float | np.ndarray, rest: np.ndarray
) -> np.ndarray:
    """A pattern of pixels in units of its rms, with those means of rows and columns that independent pixels
    have: where lines have a pattern of their own theirs is told from it by its size."""
    drawn = white_lines(rest)
    field = shrunk(found.pixels / light, sigma, noise, rest - drawn)
    for seen, chance in zip(_by_axis(np.asarray(found.lines)), _by_axis(drawn), strict=True):
        own = sigma**2 * float(np.mean(chance**2))
        share = min(own / max(float(np.mean(seen**2)), 1e-30), 1.0)
        field = field + share * seen / light / sigma + np.sqrt(1 - share) * chance
    return field


def _by_axis(lines: Float[np.ndarray, "H W"]) -> tuple[np.ndarray, np.ndarray]:
    """The means of rows, and those of columns, of their sum."""
    rows = np.empty(lines.shape)
    for c in range(4):
        site(rows, c)[...] = site(lines, c).mean(1, keepdims=True)
    return rows, lines - rows


def offsets(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Fixed offsets of the pixels, in units of their rms."""
    dark = darkest(seen.statistics)
    if dark is None:
        return {}
    found = offset_pattern(dark, charge.grown(seen.statistics, seen.baseline, dark))
    rest = seen.draw(found.pixels.shape)
    jumps = _jumps_in(dark, seen)
    noise = found.noise + jumps.of_mean
    field = _of_pixels(found, values["sigma_dn"], noise, 1.0, rest)
    # Of a pixel far out nothing is noise, and of a hot one everything is its heat.
    out = (dark.mean - median(dark.mean)) / values["sigma_dn"]
    far = np.abs(out) * values["sigma_dn"] > 6 * np.sqrt(noise)
    field = np.where(found.keep, field, np.where(far, out, rest))
    hot = seen.earlier(_is_heat)
    if hot is not None:
        field = np.where(np.asarray(hot.maps["heat"])[0] > 0, 0.0, field)
    return {"field": field[None]}


def response(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Fixed sensitivities of the pixels, in units of their rms."""
    flat = brightest_flat(seen.statistics)
    alone = None if flat is None else light_alone(seen.statistics, flat)
    if alone is None or isinstance(alone, NotMeasurable):
        return {}
    found = response_pattern(alone.flat, alone.dark)
    rest = seen.draw(found.pixels.shape)
    # Where there is less light a pixel shows less of its sensitivity, and of its shot noise by the root.
    light = np.maximum(found.light, 0.01)
    # Of the strength as it is recorded: a response that bends may have changed it.
    sigma = root(pixel_part(found)).value or values["sigma"]
    field = _of_pixels(found, sigma, found.noise / light, light, rest)
    return {"field": np.where(found.keep, field, rest)[None]}


def column_response(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Fixed gains of the columns, in units of their rms."""
    flat = brightest_flat(seen.statistics)
    alone = None if flat is None else light_alone(seen.statistics, flat)
    if alone is None or isinstance(alone, NotMeasurable):
        return {}
    found = response_pattern(alone.flat, alone.dark)
    height, width = found.pixels.shape
    share = float(np.mean(found.pixels[found.keep] ** 2)) / height
    sigma = root(column_part(found)).value or values["sigma"]
    field = shrunk(found.columns.mean(0), sigma, share, seen.draw((width,)))
    return {"field": field[None, None]}


def _lines(offsets: Float[np.ndarray, "T n"], sigma: float, draw) -> np.ndarray:
    temporal, _ = temporal_mean_square(offsets)
    return shrunk(offsets.mean(0), sigma, temporal / len(offsets), draw(offsets.shape[1:]))


def row_pattern(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Fixed offsets of the rows, in units of their rms."""
    dark = darkest(seen.statistics)
    return (
        {}
        if dark is None
        else {"field": _lines(row_offsets(dark), values["sigma_dn"], seen.draw)[None, :, None]}
    )


def column_pattern(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Fixed offsets of the columns, in units of their rms."""
    dark = darkest(seen.statistics)
    if dark is None:
        return {}
    return {"field": _lines(without_step(column_offsets(dark)), values["sigma_dn"], seen.draw)[None, None]}


def read_noise_of_lines(values: Mapping[str, Any], seen: Seen, *, axis: Line) -> dict[str, np.ndarray]:
    """The read noise of rows or columns over that of the baseline."""
    dark = darkest(seen.statistics)
    found = None if dark is None else lines_of(dark, axis, seen.baseline.gain)
    if found is None:
        return {}
    width = 2 * float(np.sqrt(np.log1p(values["spread"] ** 2)))
    noise = np.where(found.known, found.error, 1e6)
    logs = width * shrunk(found.logs, width, noise, seen.draw(found.logs.shape))
    factor = np.exp(logs / 2)
    factor = factor / np.sqrt(np.mean(factor**2))
    return {"factor": factor.reshape((1, -1, 1) if axis == "row" else (1, 1, -1))}


def _of_lines(seen: Seen) -> np.ndarray | float:
    """Power of the read noise by the mechanisms of rows and columns before in the chain."""
    factors = (np.asarray(f.maps["factor"])[0] for f in seen.known if "factor" in f.maps)
    return math.prod((factor**2 for factor in factors), start=1.0)


def read_noise(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """The pixels' read noise over that of the baseline."""
    dark = darkest(seen.statistics)
    if dark is None:
        return {}
    # Log-normal read noise of unit mean square: the variances have logs of rms 2 w, w^2 = ln(1 + spread^2).
    width, half = 2 * float(np.sqrt(np.log1p(values["spread"] ** 2))), dark.dof / 2
    ratio, jumps = np.empty(dark.mean.shape), _jumps_in(dark, seen).of_frames
    grown = charge.grown(seen.statistics, seen.baseline, dark)
    for c in range(4):
        square, _ = robust_mean_square(pixel_variance(dark, c), dark.dof)
        rounding = dark.code_step**2 / 12
        known = site(jumps, c) + rounding
        if grown is not None:
            known = known + seen.baseline.gain[c] * site(grown[0], c)
        site(ratio, c)[...] = (pixel_variance(dark, c) - known) / (square - rounding)
    ratio = np.maximum(ratio / _of_lines(seen), 0.05)
    logs = np.log(ratio) - (special.digamma(half) - np.log(half)) + width**2 / 2
    unit = shrunk(logs, width, float(special.polygamma(1, half)), seen.draw(logs.shape))
    factor = np.where(jumps > 0, 1.0, np.exp(width / 2 * unit - width**2 / 4))
    return {"factor": np.where(_loud(ratio * np.exp(-2 * width), dark.dof), np.sqrt(ratio), factor)[None]}


def _loud(ratio: np.ndarray, dof: float) -> np.ndarray:
    """Whether a variance over the usual one is more likely of a loud pixel (any factor up to a hundred,
    evenly in its logarithm) than chance; the share of loud pixels from what lies beyond one chance in
    10^4."""
    share = float(np.mean(ratio > stats.chi2.isf(1e-4, dof) / dof))
    chance = stats.chi2.logpdf(ratio * dof, dof) + np.log(dof)
    loud = np.log(max(share, 1e-9)) - np.log(ratio * np.log(100.0))
    return (ratio > 1.0) & (loud > chance)


def heat(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Dark current of the hot pixels over their mean; 0 elsewhere."""
    found = charge.hot_map(seen.statistics, seen.baseline, values["e_per_s"], values["fraction"])
    return {} if found is None else {"heat": found[None]}


def currents(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Dark currents of ordinary pixels beyond their mean, in units of their standard deviation."""
    found = charge.currents(seen.statistics, seen.baseline)
    if found is None or not found.differ:
        return {}
    shown, sigma = found.charge, float(np.sqrt(found.spread))
    field = np.where(found.out, 0.0, shrunk(shown, sigma, found.noise, seen.draw(shown.shape)))
    # No current is negative, and their mean stays.
    for _ in range(_ROUNDS if values["variation"] else 0):
        field = np.maximum(field, -1 / values["variation"])
        field -= np.where(found.out, 0.0, field[~found.out].mean())
    return {"pixels": field[None]}


def glow(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Glow over its brightest point."""
    found = glows.glow_map(seen.statistics, seen.baseline)
    return {} if found is None else {"glow": found[None]}


def telegraph(values: Mapping[str, Any], seen: Seen) -> dict[str, np.ndarray]:
    """Height of the jumps of telegraph pixels over what is typical; 0 elsewhere."""
    dark = darkest(seen.statistics)
    if dark is None:
        return {}
    return {"sites": telegraph_pixels.heights(dark, **values, gain=seen.baseline.gain)[None]}
