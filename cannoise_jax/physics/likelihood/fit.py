"""The Poisson-Gaussian baseline of a camera by maximum likelihood.

The baseline y = black + signal + noise, variance gain * signal + read^2 (DN), is fitted per channel from
frames whose expected signal is known: darks, or recordings with a clean reference. Everything static that the
reference does not hold (fixed pattern) counts as noise here; `transfer` separates it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy import ndimage

from cannoise_jax.physics.likelihood.codes import CodeGrid, gaussian_log_prob, log_normal_interval
from cannoise_jax.physics.likelihood.maximum import maximise
from cannoise_jax.physics.likelihood.shot import Shot, choose_shot, shot_log_prob
from cannoise_jax.recordings.codes import detect_code_step_per_channel
from cannoise_jax.recordings.recording import BadInput, PerChannel, Recording, per_channel

_FORMS: tuple[Shot, ...] = ("gaussian", "skewed", "poisson")


class BaselineFit(NamedTuple):
    """Poisson-Gaussian baseline of one setting, one value per mosaic site, with standard errors.

    black_level, read_noise: DN. gain: DN/e-; nan where no light tells it. Errors: DN and DN/e-;
    they take the reference errors of frames as independent: with one reference of M frames for T frames the
    black level is less certain by sqrt((T + M) / (M + 1)).
    log_likelihood: nats per pixel used. kept: fraction of pixels inside the trimming bounds.
    """

    black_level: Float[np.ndarray, "4"]
    gain: Float[np.ndarray, "4"]
    read_noise: Float[np.ndarray, "4"]
    black_error: Float[np.ndarray, "4"]
    gain_error: Float[np.ndarray, "4"]
    read_error: Float[np.ndarray, "4"]
    log_likelihood: Float[np.ndarray, "4"]
    kept: Float[np.ndarray, "4"]
    converged: bool


def reference_factor(reference: str | None, reference_frames: int | None) -> float:
    """Variance of frame minus reference over the variance of a frame, for a reference averaged from M frames.

    "independent": 1 + 1/M, M other frames (a leave-one-out mean is one); "burst_mean": 1 - 1/M, the frame
    among
    them. An unknown number of frames counts as many: 1.
    """
    if not reference_frames or reference is None:
        return 1.0
    return 1 + 1 / reference_frames if reference == "independent" else 1 - 1 / reference_frames


def fit_baseline(
    recordings: Sequence[Recording],
    *,
    code_step: float | PerChannel | None = None,
    rails: tuple[float, float] | None = None,
    trim: float | None = 4.0,
    pixels: int = 200_000,
    seed: int = 0,
) -> BaselineFit:
    """Black level, gain and read noise per channel by the discretised, censored likelihood.

    recordings: of one camera at one setting: darks and bias frames (expected signal 0), or with `clean`;
    their
      reference error is included (`reference_factor`).
    code_step: DN; default: the recordings' own, else the detected one. rails: lowest and highest code, DN;
      default 0 and the white level. Codes at the rails are censored.
    trim: pixels farther than this many standard deviations from their mean are left out, and the likelihood
    is
      that of the truncated distribution: outliers do not matter and clean data are not biased. None: use all.
    pixels: at most about so many per channel, drawn by `seed`.
    Raises BadInput for a recording without expected signal, and for recordings of different references.
    """
    steps = per_channel(code_step) if code_step is not None else _code_steps(recordings)
    low, high = rails if rails is not None else (0.0, float(recordings[0].white_level))
    factors = {reference_factor(r.reference, r.reference_frames) for r in recordings if r.clean is not None}
    if len(factors) > 1:
        raise BadInput(f"{_name(recordings[0])}: recordings differ in their reference: fit them one by one")
    factor = factors.pop() if factors else 1.0
    fits = []
    for site in range(4):
        black = float(np.mean([r.black_level[site] for r in recordings]))
        codes, signal, light = _gather(recordings, site, black, pixels, seed)
        step = steps[site]
        top = np.floor(high / step) * step if step > 0 else high  # the highest code, which is a white pixel's
        grid = CodeGrid(step, low - black, top - black)
        fit = _fit_site(codes, signal, light, grid, factor, trim)
        fits.append(fit._replace(black_level=fit.black_level + black))
    columns = [np.array(column) for column in zip(*fits, strict=True)]
    return BaselineFit._make([*columns[:-1], bool(columns[-1].all())])


def _name(recording: Recording) -> str:
    return recording.path or recording.camera


def _code_steps(recordings: Sequence[Recording]) -> PerChannel:
    known = [r.code_step for r in recordings if r.code_step is not None]
    return per_channel(known[0]) if known else detect_code_step_per_channel(recordings[0].frames)


def _gather(recordings: Sequence[Recording], site: int, black: float, pixels: int, seed: int):
    """Codes, expected signal, and the light that makes shot noise, of pixels of one mosaic site; DN above
    `black`."""
    rng = np.random.default_rng((seed, site))
    share = max(pixels // sum(r.count for r in recordings), 1)
    codes, signals, lights = [], [], []
    for r in recordings:
        if r.clean is None and r.kind not in ("dark", "bias"):
            raise BadInput(f"{_name(r)}: a {r.kind} without expected signal: give `clean`, or use darks")
        span = r.white_level - r.black_level[site]
        for t in range(r.count):
            frame = np.asarray(r.frames[t : t + 1])[0][site // 2 :: 2, site % 2 :: 2].reshape(-1)
            few = rng.integers(0, frame.size, share) if frame.size > share else slice(None)
            codes.append(frame[few].astype(np.float32) - np.float32(black))
            signal = light = np.zeros(frame.size, np.float32)
            if r.clean is not None:
                clean = np.asarray(r.clean if r.clean.ndim == 2 else r.clean[t], np.float32)
                image = span * clean[site // 2 :: 2, site % 2 :: 2]
                signal = image.reshape(-1)
                # A noisy reference may not set its own weight: errors below would count more than above.
                light = _smooth(image).reshape(-1) if r.reference_frames else signal
            signals.append(signal[few] + np.float32(r.black_level[site] - black))
            lights.append(np.maximum(light[few], 0))
    return np.concatenate(codes), np.concatenate(signals), np.concatenate(lights)


def _smooth(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Means of 5 x 5 pixels, gradients continued beyond the border."""
    padded = np.pad(image, 2, mode="reflect", reflect_type="odd")
    return ndimage.uniform_filter(padded, 5)[2:-2, 2:-2]


class _Pixels(NamedTuple):
    """Pixels of one channel that share a form of shot noise; `weight` is zero for those left out."""

    codes: np.ndarray
    signal: np.ndarray
    light: np.ndarray
    low: np.ndarray
    high: np.ndarray
    weight: np.ndarray


@partial(jax.jit, static_argnames="shot")
def _value_and_grad(theta, pixels: _Pixels, grid: CodeGrid, factor, shot: Shot):
    """Weighted log-likelihood of truncated codes, and its gradient; theta: black, log gain, log read, in
    DN."""

    def total(theta):
        gain, read = jnp.exp(theta[1]), jnp.exp(theta[2])
        mean, electrons = theta[0] + pixels.signal, pixels.light / gain
        variance = factor * (gain * pixels.light + read**2)
        if shot == "gaussian":
            log_prob = gaussian_log_prob(pixels.codes, mean, variance, grid)
        else:  # the error of an independent reference joins the read noise
            noise = jnp.sqrt(variance - gain * pixels.light)
            log_prob = shot_log_prob(pixels.codes, electrons, gain, mean - pixels.light, noise, grid, shot)
        middle, half = (pixels.low + pixels.high) / 2 - mean, (pixels.high - pixels.low) / 2
        inside = log_normal_interval(middle / jnp.sqrt(variance), half / jnp.sqrt(variance))
        return jnp.sum(pixels.weight * (log_prob - inside))

    return jax.value_and_grad(total)(theta)


def _start(codes, signal, light, step: float) -> tuple[np.ndarray, bool]:
    """Robust moments: median offset, spread of the darkest tenth, slope of the spread to the brightest
    fifth."""
    residual, floor = codes - signal, 0.3 * max(step, 1e-3)

    def variance(chosen):
        r = residual[chosen]
        return max(1.4826 * float(np.median(np.abs(r - np.median(r)))), floor) ** 2

    dark, bright = light <= np.quantile(light, 0.1), light >= np.quantile(light, 0.8)
    lift = float(light[bright].mean() - light[dark].mean())
    lit = lift > 0.05 * np.sqrt(variance(dark)) and variance(bright) > 1.02 * variance(dark)
    gain = (variance(bright) - variance(dark)) / lift if lit else 1.0
    read = np.sqrt(max(variance(dark) - gain * float(light[dark].mean()), 0.1 * variance(dark)))
    return np.array([float(np.median(residual)), np.log(gain), np.log(read)]), lit


def _groups(codes, signal, light, grid: CodeGrid, theta, factor: float, trim: float | None):
    """The pixels inside the bounds around the model `theta`, by form of shot noise, padded to powers of
    two."""
    gain, read = np.exp(theta[1]), np.exp(theta[2])
    sigma = np.sqrt(factor * (gain * light + read**2))
    level, step = theta[0] + signal, float(grid.step)
    reach = (50.0 if trim is None else trim) * sigma
    kept = np.abs(codes - level) <= reach if trim is not None else np.ones(codes.shape, bool)
    if step > 0:  # bounds on the edges of codes; past a rail everything is in its last code
        low = codes - np.floor((codes - level + reach) / step) * step - step / 2
        high = codes + np.floor((level + reach - codes) / step) * step + step / 2
    else:
        low, high = level - reach, level + reach
    low = np.where(low <= grid.low + step / 2, np.minimum(low, level - 50 * sigma), low)
    high = np.where(high >= grid.high - step / 2, np.maximum(high, level + 50 * sigma), high)
    form = choose_shot(light / gain, gain, read) if factor >= 1 and step > 0 else np.zeros(codes.shape, int)
    count = int(kept.sum())
    groups = []
    for k, shot in enumerate(_FORMS):
        chosen = np.flatnonzero(kept & (form == k))
        if chosen.size:
            blank = (1 << int(chosen.size - 1).bit_length()) - chosen.size
            padded = np.concatenate([chosen, np.full(blank, chosen[0])])
            weight = np.where(np.arange(padded.size) < chosen.size, 1 / count, 0.0)
            fields = [a[padded].astype(np.float32) for a in (codes, signal, light, low, high)]
            groups.append((_Pixels._make([*fields, weight.astype(np.float32)]), shot))
    return groups, count


def _fit_site(codes, signal, light, grid: CodeGrid, factor: float, trim: float | None) -> BaselineFit:
    """The baseline of one channel: two rounds, the second with bounds and forms from the first."""
    theta, lit = _start(codes, signal, light, float(grid.step))
    light = light if lit else np.zeros_like(light)
    free = np.array([True, lit, True])
    scale = np.array([np.exp(theta[2]), 1.0, 1.0])  # the black level in units of the read noise
    for bound in (trim and max(trim, 6.0), trim):
        groups, count = _groups(codes, signal, light, grid, theta, factor, trim if bound is None else bound)
        base = theta

        def objective(free_theta, groups=groups, base=base):
            full = base.copy()
            full[free] = free_theta * scale[free]
            parts = [_value_and_grad(full.astype(np.float32), g, grid, factor, shot) for g, shot in groups]
            grad = sum(np.asarray(p[1], np.float64) for p in parts)
            return sum(float(p[0]) for p in parts), (grad * scale)[free]

        found = maximise(objective, (theta / scale)[free], count * min(factor, 1.0))
        theta = base.copy()
        theta[free] = found.values * scale[free]
    error = np.full(3, np.nan)
    error[free] = np.sqrt(np.diag(found.covariance)) * scale[free]
    gain, read = float(np.exp(theta[1])), float(np.exp(theta[2]))
    return BaselineFit._make(
        [
            theta[0],
            gain if lit else np.nan,
            read,
            error[0],
            error[1] * gain,
            error[2] * read,
            found.log_likelihood / (count * min(factor, 1.0)),
            count / codes.size,
            found.converged,
        ]
    )
