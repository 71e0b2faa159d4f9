"""What the light does from frame to frame and row to row, and how the mean follows it: from flats, and from
recordings that come with a reference."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.mosaic_ops import shifted
from cannoise_jax.physics.transfer.black import black_of, mean_error
from cannoise_jax.physics.transfer.estimate import (
    Estimates,
    NotMeasurable,
    normal_estimate,
    root,
    variance_difference,
)
from cannoise_jax.physics.transfer.estimators.pick import (
    brightest_flat,
    no_flat,
)
from cannoise_jax.physics.transfer.estimators.waves import strongest_wave
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.full_well import below_full, full_codes, full_signal
from cannoise_jax.physics.transfer.spatial import temporal_mean_square
from cannoise_jax.physics.transfer.two_offsets import two_offsets
from cannoise_jax.physics.transfer.views import pixel_variance
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import Recording

_LEVELS = NotMeasurable("record flats of one steady light at three or more exposure times up to saturation")
_OTHER_LIGHT = NotMeasurable(
    "the flats do not grow with their exposure as under one light (other lamps, or filters): record flats of "
    "one steady light at three or more exposure times"
)
_OFF = 0.02
"""Share of the signal by which a flat may miss the curve: lamps and shutters are steadier."""
_REFERENCE = NotMeasurable("record repeated frames of a scene together with an independent reference")


def illumination_drift(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma: relative drift of the light, from the variance of frame means less what rows leave in them."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    rows = relative_rows(flat)
    frames = rows.mean(1)
    square, dof = temporal_mean_square(rows)
    drift = variance_difference(frames.var(ddof=1), len(frames) - 1, square / rows.shape[1], dof)
    return {"sigma": root(drift)}


def flicker(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """amplitude (peak, fraction of the signal) and frequency (cycles per row) of the strongest sinusoid along
    the rows of a flat, its phase free in every frame: least squares on a constant, sine and cosine."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    found = strongest_wave(relative_rows(flat))
    return {"amplitude": found.amplitude, "frequency": found.frequency}


def nonlinearity(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """loss: share of the signal missing at the white level, from the means of flats whose relative exposure
    is known (exposure time of one light, or their references).

    Flats of several lights follow no such curve, or one that has its top among them: nothing is said of them.
    Every flat is taken above the black level at its own exposure (`transfer.black`), whose error all share.
    """
    flats = [s for s in statistics if s.recording.kind == "flat" and _exposure(s.recording) is not None]
    if len({_exposure(s.recording) for s in flats}) < 3:
        return _LEVELS
    darks = [black_of(statistics, s) for s in flats]
    if told := two_offsets(statistics):
        return NotMeasurable(told)
    for found in darks:
        if not found.certain:
            return NotMeasurable(f"black level {found.note}, or darks of three exposures")
    white = flats[0].recording.white_level
    values, weights = [], []
    for c in range(4):
        black, doubt = (np.array([v[c] for v in part]) for part in zip(*(d[:2] for d in darks), strict=True))
        light = np.array([_exposure(s.recording) for s in flats], np.float64)
        signal = np.array([s.frame_means[:, c].mean() for s in flats]) - black
        error = np.array([mean_error(s, [c]) for s in flats])
        full = full_signal(flats, c)
        use = (signal < 0.95 * (white - black)) & [
            below_full(s, full, b, c) for s, b in zip(flats, black, strict=True)
        ]
        if use.sum() < 3:
            continue
        # signal = g x - a x^2 with loss = a (W - b) / g^2.
        light, signal = light[use] / light[use].max(), signal[use]
        design = np.stack([light, -(light**2)], -1)
        precision = np.linalg.inv(np.diag(error[use] ** 2) + np.outer(doubt[use], doubt[use]))
        covariance = np.linalg.inv(design.T @ precision @ design)
        g, a = covariance @ (design.T @ precision @ signal)
        off = np.abs(signal - design @ (g, a))
        slack = np.sqrt((_OFF * signal) ** 2 + 9 * (error[use] ** 2 + doubt[use] ** 2))
        if (off > slack).any() or 2 * a >= g:
            return _OTHER_LIGHT
        span = white - float(black[use].mean())
        slope = np.array([-2 * a / g**3, 1 / g**2]) * span
        values.append(a / g**2 * span)
        weights.append(1 / float(slope @ covariance @ slope))
    if not values:
        return _LEVELS
    weight = np.array(weights)
    return {
        "loss": normal_estimate(float(np.sum(weight * values) / weight.sum()), float(weight.sum() ** -0.5))
    }


def saturation(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """full_well_e: mean level of flats whose noise has collapsed below half the shot noise, over the gain."""
    if baseline is None:
        return _LEVELS
    found = []
    for s in statistics:
        for c in range(4) if s.recording.kind == "flat" and s.variance is not None else ():
            signal = s.frame_means[:, c].mean() - baseline.black_level[c]
            noise = float(pixel_variance(s, c).mean()) - baseline.read_noise[c] ** 2
            pixels = site(s.mean, c).size * s.recording.count
            # Of a flat that is hardly above black nothing is full, and its shot noise is not seen.
            lit = signal > max(10 * mean_error(s, [c]), 4 * baseline.read_noise[c] ** 2 / baseline.gain[c])
            if lit and noise < 0.25 * baseline.gain[c] * signal and np.isnan(s.high[c]):
                error = np.sqrt(float(pixel_variance(s, c).mean()) / pixels + s.code_step**2 / 12 / pixels)
                found.append((signal / baseline.gain[c], error / baseline.gain[c]))
    if not found:
        ended = any(s.recording.kind == "flat" and np.isfinite(s.high).any() for s in statistics)
        ended = ended or bool(full_codes(statistics))
        return NotMeasurable(
            "the codes end before the pixels are full: record flats at a lower gain"
            if ended
            else "no flat is bright enough to fill the pixels: record one that saturates"
        )
    weight = 1 / np.square([e for _, e in found])
    value = float(np.sum(weight * [v for v, _ in found]) / weight.sum())
    return {
        "full_well_e": normal_estimate(
            value, float(np.hypot(weight.sum() ** -0.5, baseline.gain_error * value))
        )
    }


def reference_error(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """sigma_dn, blur, shift_y, shift_x and scale of a reference: regression of (average frame - reference) on
    the reference, its high-pass and its gradients; what is left beyond temporal noise is sigma_dn."""
    scenes = [s for s in statistics if s.recording.kind == "scene" and s.recording.clean is not None]
    paired = [s for s in scenes if s.recording.clean is not None and s.recording.clean.ndim == 2]
    repeated = [s for s in paired if s.variance is not None]
    if not repeated:
        return _REFERENCE
    s = max(repeated, key=lambda s: s.recording.count)
    recording = s.recording
    black = recording.black_map().astype(np.float64)
    reference = np.asarray(recording.clean, np.float64) * (recording.white_level - black)
    inner = np.zeros(reference.shape, bool)
    inner[3:-3, 3:-3] = True
    inner &= ~s.clipped
    assert s.variance is not None
    target = (s.mean - black)[inner]
    noise = s.variance[inner] / recording.count
    found = dict.fromkeys(("scale", "blur", "shift_y", "shift_x"), 0.0)
    for _ in range(4):  # Gauss and Newton: blur, shift and scale act on each other
        expected, slopes = _referred(reference, **found)
        names = [n for n, t in slopes.items() if np.std(t[inner]) > 1e-9 * max(np.abs(reference).max(), 1)]
        if not names:
            return _REFERENCE  # a reference without any structure shows no error of it
        design = np.stack([slopes[n][inner] for n in names], -1)
        rest = target - expected[inner]
        move, *_ = np.linalg.lstsq(design, rest, rcond=None)
        for name, by in zip(names, move, strict=True):
            found[name] += float(by)
    rest = rest - design @ move
    dof = rest.size - len(names)
    square = float(rest @ rest) / dof
    inverse = np.linalg.inv(design.T @ design)
    spread = inverse @ (design.T * rest**2) @ design @ inverse  # sandwich: pixels differ in noise
    out = {
        n: normal_estimate(found[n], float(np.sqrt(v))) for n, v in zip(names, np.diag(spread), strict=True)
    }
    return {
        "sigma_dn": root(variance_difference(square, dof, float(noise.mean()), noise.size * s.dof)),
        **out,
    }


def _referred(reference: Float[np.ndarray, "H W"], scale: float, blur: float, shift_y: float, shift_x: float):
    """The true mean that belongs to a reference with these errors, and its slope by each of them, DN."""

    def along(x: np.ndarray, step: float, axis: int) -> tuple[np.ndarray, np.ndarray]:
        # Between pixels two of one colour mix: the slope is that towards the side it comes from, and at rest
        # that of both.
        sides = [
            _nearest(x, [(2, 0) if axis == 0 else (0, 2)]),
            _nearest(x, [(-2, 0) if axis == 0 else (0, -2)]),
        ]
        if step == 0:
            return x, (sides[0] - sides[1]) / 4
        slope = (sides[0] - x if step > 0 else x - sides[1]) / 2
        return x + step * slope, slope

    detail = reference - _nearest(reference, [(2, 0), (-2, 0), (0, 2), (0, -2)])
    down, slope_y = along(reference + blur * detail, shift_y, 0)
    moved, slope_x = along(down, shift_x, 1)
    moved_detail = along(along(detail, shift_y, 0)[0], shift_x, 1)[0]
    gain = 1 + scale
    return gain * moved, {
        "scale": moved,
        "blur": gain * moved_detail,
        "shift_y": gain * along(slope_y, shift_x, 1)[0],
        "shift_x": gain * slope_x,
    }


def relative_rows(s: FrameStatistics) -> Float[np.ndarray, "T H"]:
    """Row means over the mean of their channel above black, both colours of a row averaged."""
    black = np.asarray(s.recording.black_level)
    level = s.frame_means.mean(0) - black
    out = np.empty(s.row_means.shape[:2])
    for parity in (0, 1):
        c = 2 * parity
        rows = s.row_means[:, parity::2]
        out[:, parity::2] = np.mean([(rows[..., p] - black[c + p]) / level[c + p] for p in (0, 1)], 0)
    return out


def _exposure(recording: Recording) -> float | None:
    """Relative amount of light: the mean of the reference if there is one, else the exposure time."""
    if recording.clean is not None:
        return float(np.mean(recording.clean))
    return recording.exposure_s


def _nearest(x: Float[np.ndarray, "H W"], steps: Sequence[tuple[int, int]]) -> Float[np.ndarray, "H W"]:
    """Mean of x at the given steps (dy, dx)."""
    return np.mean([shifted(x, *step) for step in steps], axis=0)  # type: ignore[arg-type]
