"""Log-likelihood of frames that took no part in finding anything, per frame, under the findings.

The codes are scored by `physics.likelihood.crossed.crossed_gaussian`: the mass over the code step, with
random offsets of rows, columns and the frame integrated out. Strengths and frozen patterns come from the
other frames, a pattern as its estimate with the doubt about it added to the pixel's variance. Black level,
gain, read noise and the smooth mean are nuisances, fitted on the scored frames alike for every model that
is compared.

Not every finding has such a likelihood (tails, telegraph and correlated pixels, waves, codes):
`Signature.predict` says which; for models with one of those the composite score serves, before and after.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.contrasts import Stack, at_level
from cannoise_jax.physics.likelihood.codes import CodeGrid
from cannoise_jax.physics.likelihood.crossed import SharedTerms, crossed_gaussian, stationary_factor
from cannoise_jax.signatures.fields import Fields, channel_index, native, stratum
from cannoise_jax.signatures.handed import Predicted
from cannoise_jax.signatures.line_sums import whiten_lines

_MASKED = 1e10
"""Variance of pixels that are not scored, DN^2."""
_LEAST = 0.05
"""Share of the baseline's variance that shared offsets must leave to the pixels."""


class Scored(NamedTuple):
    """Log-likelihood of every frame, nats; the recording it belongs to (recordings of one frame: those of
    their kind together), and the pixels that were scored. parts: of every frame cut into four, scored apart.
    """

    log_prob: Float[np.ndarray, "t"]
    recording: np.ndarray
    pixels: np.ndarray
    parts: Float[np.ndarray, "t 4"] | None = None


class _Look(NamedTuple):
    """One recording as it is scored: its frames, its fields in DN of their own, DN of its own in one of the
    findings', the expected value, DN, the share of a frame's variance that the estimate of that adds, and the
    pixels."""

    stacked: Stack
    field: Fields
    unit: float
    mean: Float[np.ndarray, "h w"]
    extra: float
    usable: Bool[np.ndarray, "h w"]


def pieces(law: Predicted, size: tuple[int, int]) -> list[tuple[slice, slice]] | None:
    """The frame cut into four parts between which the chance in what a finding gains is independent: bands of
    rows, or of columns for offsets of columns; None for offsets of whole frames."""
    if law.frame:
        return None
    along = 1 if law.column else 0
    edges = [size[along] // 2 * k // 4 * 2 for k in range(5)]
    cuts = [slice(a, b) for a, b in zip(edges, edges[1:], strict=False)]
    every = slice(None)
    return [(every, c) if along else (c, every) for c in cuts]


def score_frames(
    first: Prepared,
    second: Prepared,
    chosen: list[list[int]],
    found: list[Predicted],
    masks: dict[int, np.ndarray] | None = None,
    parts_for: Predicted | None = None,
) -> Scored:
    """Scores the frames held back, `chosen` per recording. A mean that is not modelled (a reference averaged
    from the recording's own frames, or none) is rebuilt from the frames that looked, its noise added to the
    pixel's. masks: pixels to score, by recording. parts_for: score parts as `pieces` cuts them as well."""
    before = {f.number: (s, native(f)) for s, f in zip(first.stacks, first.fields, strict=True)}
    values, recordings, pixels, parts = [], [], [], []
    for stacked, referred in zip(second.stacks, second.fields, strict=True):
        field, unit = native(referred), referred.unit
        mean, extra, usable = _mean(stacked, field, before.get(field.number))
        usable = usable & masks[field.number] if masks and field.number in masks else usable
        if mean is None or not usable.any():
            continue
        frames = chosen[field.number][: field.frames]
        look = _Look(stacked, _by_pixels(field, unit, found), unit, mean, extra, usable)
        scored = _score(look, found, frames, (slice(None), slice(None)))
        values.append(scored)
        recordings.append(np.full(scored.size, stratum(field)))
        pixels.append(np.full(scored.size, int(usable.sum())))
        cut = pieces(parts_for, usable.shape) if parts_for else None
        if cut:
            scores = [_score(look, found, frames, c) for c in cut]
            parts.append(np.stack(scores, 1))
    if not values:
        return Scored(np.zeros(0), np.zeros(0, int), np.zeros(0, int))
    cut_apart = np.concatenate(parts) if parts else None
    return Scored(np.concatenate(values), np.concatenate(recordings), np.concatenate(pixels), cut_apart)


def _mean(
    stacked: Stack, field: Fields, other: tuple[Stack, Fields] | None
) -> tuple[np.ndarray | None, float, Bool[np.ndarray, "h w"]]:
    """Expected value of the frames without frozen patterns, DN; the share of a frame's variance that its
    estimate adds; the pixels to score."""
    if field.static is not None or not field.lit:
        return field.mean, 0.0, field.usable
    if other is None:
        return None, 0.0, field.usable
    usable = field.usable & other[1].usable
    mean = at_level(other[0].mean, stacked.mean, field.black, usable)
    return mean, 1 / other[0].frames, usable


def _score(
    look: _Look, found: list[Predicted], frames: list[int], part: tuple[slice, slice]
) -> Float[np.ndarray, "t"]:
    """Log-likelihood of a part of the frames of one recording, nats per frame."""
    stacked, field, unit, mean, extra, usable = look
    step = field.step
    spread = np.maximum(field.sigma.astype(np.float64) ** 2 - step**2 / 12, (0.05 * step) ** 2)
    own, shift = spread * (1 + extra), np.zeros(field.mean.shape)
    height, width = field.mean[part].shape
    row, column, frame = np.zeros(height), 0.0, 0.0
    for p in found:
        if p.pattern is not None and not extra:  # a mean of the recording's own frames holds the pattern
            one = _in_codes(p.scaling, field, unit)
            if one is not None:
                shift += np.broadcast_to(p.pattern * one, shift.shape)
                own = own + p.doubt * one**2
        offset = _of_offsets(p, unit)
        row = row + (p.row * offset) ** 2 * _autocovariance(height, p.exponent)
        column, frame = column + (p.column * offset) ** 2, frame + (p.frame * offset) ** 2
    factor = stationary_factor(jnp.asarray(row, jnp.float32)) if row[0] > 0 else jnp.zeros((height, 1))
    terms = SharedTerms(
        factor,
        np.float32(np.sqrt(column)) * jnp.eye(width) if column > 0 else jnp.zeros((width, 1)),
        jnp.asarray(np.sqrt(frame), jnp.float32),
    )
    centre = (mean + _centred(shift, field, usable)).astype(np.float32)
    variance = np.where(usable, own, _MASKED).astype(np.float32)
    grid = CodeGrid(float(step))
    read = [np.asarray(stacked.recording.frames[t : t + 1])[0].astype(np.float32) for t in frames]
    codes = np.stack([np.where(usable, frame, centre)[part] for frame in read])
    # One factorisation serves all frames.
    out = np.asarray(crossed_gaussian(codes, centre[part], variance[part], terms, grid), np.float64)
    # What the pixels that are not scored added.
    masked = np.log(step) - 0.5 * np.log(2 * np.pi * (_MASKED + step**2 / 12))
    return out - masked * float((~usable[part]).sum())


def _by_pixels(field: Fields, unit: float, found: list[Predicted]) -> Fields:
    """The field with the noise of its pixels alone: offsets of rows and columns are in the fitted read noise,
    drift of whole frames was kept out of it. As measured within the lines, where several frames are seen."""
    for axis in ("row", "column"):
        variance = float(sum((getattr(p, axis) * _of_offsets(p, unit)) ** 2 for p in found))
        if variance and len(field.contrasts):
            field = whiten_lines(field, axis, "additive", variance)
        elif variance:
            own = np.maximum(field.sigma**2 - variance, _LEAST * field.sigma**2)
            field = field._replace(sigma=np.sqrt(own))
    return field


def _in_codes(scaling: str, field: Fields, unit: float) -> np.ndarray | float | None:
    """DN of this recording per unit of a pattern; None where it does not reach."""
    if scaling == "signal":
        return field.signal if field.lit else None
    if scaling == "codes":
        return 1.0
    if scaling == "exposure":
        return unit * field.exposure_s if field.exposure_s else None
    return unit


def _of_offsets(law: Predicted, unit: float) -> float:
    """DN of a recording per DN of random offsets."""
    return 1.0 if law.scaling == "codes" else unit


def _centred(shift: np.ndarray, field: Fields, usable: Bool[np.ndarray, "h w"]) -> np.ndarray:
    """The shift without its mean per channel, which the fitted mean of the recording already holds."""
    channel = channel_index(shift.shape)
    out = shift.copy()
    for c in range(4):
        chosen = (channel == c) & usable
        if chosen.any():
            out[channel == c] -= np.mean(shift[chosen])
    return out


def _autocovariance(size: int, exponent: float) -> Float[np.ndarray, "n"]:
    """Autocovariance of unit variance of offsets whose power falls as 1/f^exponent (0: white)."""
    if not exponent:
        return np.eye(1, size)[0]
    frequency = np.maximum(np.arange(size + 1), 1) / (2 * size)
    covariance = np.fft.irfft(frequency**-exponent, 2 * size)[:size]
    return covariance / covariance[0]
