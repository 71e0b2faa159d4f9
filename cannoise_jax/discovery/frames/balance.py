"""Noise of the baseline beside the findings: lowered by what they add, so that nothing is counted twice."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy import stats

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.calibrate import ordinary_variance, own_variance
from cannoise_jax.discovery.frames.contrasts import FLICKER, Stack, steady_variance
from cannoise_jax.physics.core.fields import within_frame
from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.physics.core.places import place
from cannoise_jax.physics.core.sensor import Fitted, SensorModel, Settings
from cannoise_jax.physics.core.sensor_draws import closed_moments
from cannoise_jax.physics.core.settings import IsoTable, of_larger_gain
from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import channel_index, native
from cannoise_jax.signatures.phasors import orthonormal, projected_out

_BRIGHT = 0.4
"""Signal over the range at which the lit variance is matched: below a full well, and where photons make
the noise (99.8 % of the variance of a camera of 11,000 electrons)."""
_MOST_CHANGE = (0.3, 3.0)
"""By which a gain may change: mechanisms of typical strength change it by 0.77 (excess noise) to 1.37
(denoising in the camera)."""
_MOST_SHARE = 3.0
"""By which findings may change the light that a channel shows."""
_LEAST_READ = 0.05**2
"""Share of the dark variance that stays read noise: a sensor model has no read noise of zero."""
_ROUNDS = 4
"""Of gain and read noise by turns, for the findings' own part goes with them. Of mechanisms of typical
strength most are matched after one; after four, denoising in the camera is off by 0.15 % of the variance."""


def _of_frames(record: Mechanism) -> bool:
    """Whether it is what a whole frame, or channel of it, shares."""
    return place(record.point.over).whole and record.point.time != "frozen"


def _of_lit_rows(record: Mechanism) -> bool:
    """Whether it is what rows of light share: out of the fitted baseline where it is strong, see
    `contrasts.without_flicker`."""
    point = record.point
    return point.over == "row" and point.combine == "multiply" and point.time != "frozen"


def balanced(bare: SensorModel, model: SensorModel, prepared: Prepared) -> SensorModel:
    """The model with gain and read noise lowered so that its temporal variance of the ordinary pixel is that
    of the recordings: at black of the shortest dark, and brighter of the fitted baseline, whose line through
    long darks and flats need not meet the short ones. Brighter: at the same mean, not under the same light,
    of which findings such as unlike greens take or give a part. What findings have in electrons was measured
    in DN, at the gain of the fitted baseline."""
    channel = channel_index(prepared.fields[0].mean.shape)
    for n, iso in enumerate(np.asarray(bare.iso)):
        seconds, dark, freedom = _shortest_dark(prepared, float(iso), channel, model)
        settings = Settings(float(iso), seconds)
        wanted = [_variance(bare, level, settings, channel) for level in (0.0, _BRIGHT)]
        wanted[0] = wanted[0] if dark is None else dark
        wanted[1] = wanted[0] + (wanted[1] - wanted[0]) * _share_of_light(model, bare, settings, channel)
        gain, read = np.array(bare.gain_dn_per_e)[n], np.array(bare.read_noise_e)[n]
        shot0 = gain.copy()
        for _ in range(_ROUNDS):
            trial = _with_noise(model, n, gain, read)
            have = [
                _variance(trial, level, settings, channel)
                if level or dark is None
                else _closed_variance_of(trial, _of_dark, level, settings, channel, freedom)
                for level in (0.0, _BRIGHT)
            ]
            slope = (wanted[1] - wanted[0]) / np.maximum(have[1] - have[0], 1e-9)
            read_dn = np.sqrt(np.maximum((gain * read) ** 2 + wanted[0] - have[0], _LEAST_READ * wanted[0]))
            gain = np.clip(gain * slope, _MOST_CHANGE[0] * shot0, _MOST_CHANGE[1] * shot0)
            read = read_dn / gain
        model = _with_noise(model, n, gain, read)
    grown = float(np.mean(np.asarray(model.gain_dn_per_e) / np.asarray(bare.gain_dn_per_e)))
    kept = tuple(of_larger_gain(f, grown) for f in model.mechanisms)
    return dataclasses.replace(model, mechanisms=kept)


def _share_of_light(
    model: SensorModel, bare: SensorModel, settings: Settings, channel: np.ndarray
) -> np.ndarray:
    """Signal of each channel of the model over that of the bare one under the same light."""
    signals = []
    for one in (model, bare):
        lit, dark = (
            np.asarray(closed_moments(one, np.full(channel.shape, level, np.float32), settings)[0])
            for level in (_BRIGHT, 0.0)
        )
        signals.append(np.array([median((lit - dark)[channel == c]) for c in range(4)]))
    return np.clip(signals[0] / np.maximum(signals[1], 1e-9), 1 / _MOST_SHARE, _MOST_SHARE)


def _tail_shape(model: SensorModel) -> float | None:
    """Shape of the tails of the model's read noise; None: normal ones."""
    shapes = [f.parameters.get("tukey_lambda") for f in model.mechanisms if f.record.baseline is not None]
    known = [float(s) for s in shapes if s is not None and np.ndim(s) == 0 and not isinstance(s, IsoTable)]
    return known[0] if known else None


@lru_cache
def shown_of_tails(shape: float, freedom: int) -> float:
    """Share of the variance of noise of such tails that `own_variance` shows, which leaves out pixels that
    vary more than normal ones do: 0.98 at an excess kurtosis of 4, 0.93 at one of 10."""
    rng = np.random.default_rng(0)
    values = stats.tukeylambda.ppf(rng.random((freedom + 1, 40_000)), shape)
    pixels = values.var(0, ddof=1)
    return ordinary_variance(pixels, freedom) / float(stats.tukeylambda.var(shape))


def _is_wave(record: Mechanism) -> bool:
    """Whether it is a wave that each frame has at a phase of its own."""
    point = record.point
    return point.spectrum == "sinusoid" and point.time == "redrawn" and point.combine == "add"


def _of_dark(record: Mechanism) -> bool:
    """Whether it is in what `_shortest_dark` tells."""
    return not (_of_frames(record) or _is_wave(record))


def _without_waves(stacked: Stack, model: SensorModel) -> Stack:
    """The frames without the waves of the model: how much the phases of a few frames differ by is chance, as
    is what a wave adds to their variance."""
    if not len(stacked.contrasts):
        return stacked
    h, w = stacked.mean.shape
    kept = []
    for f in (f for f in model.mechanisms if _is_wave(f.record)):
        at = {name: float(np.asarray(f.parameters[name])) for name in f.parameters if "frequency" in name}
        cycles = at.get("frequency", 0.0)
        fy, fx = {
            "row": (cycles, 0.0),
            "column": (0.0, cycles),
            "raster": (cycles * w % 1.0, cycles),
            "pixel": (at.get("frequency_y", 0.0), at.get("frequency_x", 0.0)),
        }[f.record.point.over]
        turn = np.exp(2j * np.pi * (fy * np.arange(h)[:, None] + fx * np.arange(w)))
        kept += [turn.real.ravel(), turn.imag.ravel()]
    if not kept:
        return stacked
    left = projected_out(stacked.contrasts, orthonormal(np.stack(kept)))
    return stacked._replace(contrasts=left, variance=steady_variance(left, stacked.mean, lit=False))


def _shortest_dark(prepared: Prepared, iso: float, channel: np.ndarray, model: SensorModel):
    """Exposure, s, and temporal variance before rounding per channel, DN^2, of the shortest dark of one gain
    setting, but for that of the model's waves; 0.01 and None without one, None where one frame or rounding
    hides it; and its degrees of freedom."""
    tails = _tail_shape(model)
    isos = [np.float32(prepared.isos[b.iso]) for b in prepared.baselines]
    mine = [f for f in prepared.fields if not f.lit and f.exposure_s is not None and isos[f.group] == iso]
    if not mine:
        return 0.01, None, 0
    f = native(min(mine, key=lambda f: f.exposure_s or 0.0))
    stacked = next(s for s in prepared.stacks if s.number == f.number)
    # Of the frames as they were recorded: the fields' own holds what whole frames share.
    total = own_variance(_without_waves(stacked, model), channel, f.sigma.astype(np.float64) ** 2, f.mean)
    if tails is not None and -0.45 < tails < 0 and f.frames > 1:
        total = total / shown_of_tails(round(tails, 3), f.frames - 1)
    variance = np.array([median(total[channel == c]) for c in range(4)]) - f.step**2 / 12
    shown = f.frames > 1 and variance.min() > (0.5 * f.step) ** 2
    return f.exposure_s, variance if shown else None, len(stacked.contrasts)


def _with_noise(model: SensorModel, n: int, gain: np.ndarray, read: np.ndarray) -> SensorModel:
    gains, reads = np.array(model.gain_dn_per_e), np.array(model.read_noise_e)
    gains[n], reads[n] = gain, read
    return dataclasses.replace(model, gain_dn_per_e=gains, read_noise_e=reads)


def _variance(model: SensorModel, level: float, settings: Settings, channel: np.ndarray) -> np.ndarray:
    """Median over the pixels of each channel of the temporal variance before rounding, DN^2, but for what the
    fitted baseline is without: what whole frames share, and rows of light where that is strong."""
    own = _closed_variance_of(model, lambda r: not _of_frames(r), level, settings, channel)
    if not level or not any(_of_lit_rows(f.record) for f in model.mechanisms):
        return own
    steady = _closed_variance_of(
        model, lambda r: not (_of_frames(r) or _of_lit_rows(r)), level, settings, channel
    )
    return np.where(own - steady > FLICKER * steady, steady, own)


def _within_frames(fitted: Fitted, size: tuple[int, int]) -> Fitted:
    """1/f noise at the strength that it has within a frame: what its slow part gives the means of frames is
    what whole frames share."""
    point, exponent = fitted.record.point, fitted.parameters.get("exponent")
    if point.spectrum != "power_law" or exponent is None or isinstance(exponent, IsoTable):
        return fitted
    strength = fitted.record.parameters[0].name
    kept = within_frame(float(np.asarray(exponent)), point.over, size)
    values = {**fitted.parameters, strength: fitted.parameters[strength] * kept}
    return dataclasses.replace(fitted, parameters=values)


def _closed_variance_of(
    model: SensorModel,
    kept_if: Callable[[Mechanism], bool],
    level: float,
    settings: Settings,
    channel: np.ndarray,
    freedom: int = 0,
) -> np.ndarray:
    """As `_variance`, of the mechanisms that are `kept_if`. freedom: of the recordings that it is compared
    with, whose mean leaves out pixels far noisier than the others."""
    kept = tuple(_within_frames(f, channel.shape) for f in model.mechanisms if kept_if(f.record))
    model = dataclasses.replace(model, mechanisms=kept)
    values = np.asarray(closed_moments(model, np.full(channel.shape, level, np.float32), settings)[1])
    if freedom:
        scatter = np.random.default_rng(0).chisquare(freedom, values.shape) / freedom
        seen = values * scatter
        return np.array([ordinary_variance(seen[channel == c], freedom) for c in range(4)])
    return np.array([median(values[channel == c]) for c in range(4)])
