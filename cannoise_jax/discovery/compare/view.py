"""How frames are seen: as contrasts in time and a static map, divided by the simulator's noise, with pixels
that are not like the others set aside.

Recordings and draws go through the same functions, so that whatever these do to a law they do to both.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, UInt16
from scipy import stats

from cannoise_jax.discovery.compare import moves
from cannoise_jax.discovery.compare.light import Light
from cannoise_jax.discovery.frames.contrasts import MOST_FRAMES
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.fields import contrast_matrix, helmert

FAR = 1e-5
"""Chance by which a pixel of normal noise is set aside."""
STATIC = 6.0
"""Robust standard deviations from which a pixel of the static map stands out."""
RESIDUES = (2, 4, 8, 16)
"""The stored codes are counted modulo each of these."""


class Noise(NamedTuple):
    """The simulator's noise of one recording: variance (DN^2) of every mosaic site at its signal knots."""

    knots: tuple[np.ndarray, ...]
    variance: tuple[np.ndarray, ...]

    def sigma(self, signal: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """Standard deviation of every pixel, DN."""
        out = np.empty(signal.shape, np.float32)
        for at, knots, variance in zip(SITES, self.knots, self.variance, strict=True):
            out[at] = np.sqrt(np.interp(signal[at], knots, variance))
        return out


class Raw(NamedTuple):
    """Frames reduced, in DN: contrasts in time, mean, and which pixels are never at a rail; rails: pixels of
    every frame at the low and the high one; codes: how often each residue of the stored codes modulo each of
    `RESIDUES` occurs among usable pixels."""

    contrasts: Float[np.ndarray, "n h w"]
    mean: Float[np.ndarray, "h w"]
    usable: Bool[np.ndarray, "h w"]
    rails: Float[np.ndarray, "t 2"]
    frames: int
    codes: Float[np.ndarray, "k"]


class View(NamedTuple):
    """One recording as the bank sees it; standardised, masked pixels zero.

    z: contrasts; kept: pixels of them.
    static: mean over frames minus the expected one, times the root of the number of frames; None: not known.
    static_kept: pixels of it; outlying: the map before any was set aside.
    steadiness: mean square of every pixel's contrasts over that of the bulk.
    single: values of each frame that lie off alone, see `moves.lone_values`.
    levels: unsteady pixels by what two levels leave of them.
    level: mean of every frame and site, DN (of contrasts alone where `static` is None).
    """

    z: Float[np.ndarray, "n h w"]
    kept: Bool[np.ndarray, "h w"]
    static: Float[np.ndarray, "h w"] | None
    static_kept: Bool[np.ndarray, "h w"]
    outlying: Float[np.ndarray, "h w"] | None
    usable: Bool[np.ndarray, "h w"]
    steadiness: Float[np.ndarray, "h w"]
    single: Float[np.ndarray, "t s"]
    levels: Float[np.ndarray, "l"]
    level: Float[np.ndarray, "t 4"]
    rails: Float[np.ndarray, "t 2"]
    codes: Float[np.ndarray, "k"]


def chosen_frames(r: Recording) -> np.ndarray:
    """Numbers of the frames that are looked at: at most `MOST_FRAMES`, spread evenly."""
    return np.unique(np.linspace(0, r.count - 1, min(r.count, MOST_FRAMES)).round().astype(int))


def reduce(frames: UInt16[np.ndarray, "t h w"], high: float, dark: bool, step: float, before: int = 0) -> Raw:
    """Contrasts, mean and rails of frames; `high`: the level at which a pixel is full, DN. before: how
    many of the first serve only as those whose mean the last contrast is taken from."""
    first = frames[0].astype(np.float32)
    moved = frames.astype(np.float32) - first
    matrix = contrast_matrix(len(frames) - before, before).astype(np.float32)
    contrasts = np.tensordot(matrix, moved, 1)
    frames, moved = frames[before:], moved[before:]
    count = len(frames)
    low, full = frames == 0, frames >= high - 0.5
    rails = np.stack([low.mean((1, 2)), full.mean((1, 2))], 1) * frames[0].size
    usable = ~(low | full).any(0)
    if dark and usable.mean() < 0.9:
        usable = ~full.any(0)
    most = RESIDUES[-1]
    index = np.round(frames[:, usable] / step).astype(np.int64) % most
    counts = np.bincount(index.ravel(), minlength=most).astype(float)
    codes = np.concatenate([counts.reshape(-1, m).sum(0) for m in RESIDUES])
    return Raw(contrasts, first + moved.mean(0), usable, rails, count, codes)


def noise_of(drawn: list[Raw], signal: Float[np.ndarray, "h w"], step: float) -> Noise:
    """The noise of a simulator from its draws, over the signal where that varies by more than the noise."""
    knots, variances = [], []
    for cell in SITES:
        s = signal[cell].ravel()
        parts = [np.mean(r.contrasts[:, *cell] ** 2, 0).ravel() for r in drawn if len(r.contrasts)]
        if not parts:
            parts = [_scatter(r.mean[cell] - signal[cell]) for r in drawn]
        v = np.mean(parts, 0)
        dof = max(sum(len(r.contrasts) for r in drawn), 1)
        used = np.mean([r.usable[cell] for r in drawn], 0).ravel() > 0
        typical = float(median(v))
        bins = int(np.clip(np.ptp(s) ** 2 / max(400 * typical, 1e-9), 1, 16)) if s.size else 1
        edges = np.unique(np.quantile(s, np.linspace(0, 1, bins + 1)[1:-1])) if bins > 1 else np.zeros(0)
        which = np.searchsorted(edges, s)
        at, value = [], []
        for b in range(len(edges) + 1):
            mine = (which == b) & used
            if mine.sum() < 32:
                continue
            at.append(float(s[mine].mean()))
            value.append(bulk_variance(v[mine], dof))
        if not at:
            at, value = [float(s.mean())], [bulk_variance(v, dof)]
        order = np.argsort(at)
        knots.append(np.array(at)[order])
        variances.append(np.maximum(np.array(value)[order], 1e-4 * step**2))
    return Noise(tuple(knots), tuple(variances))


def _scatter(residual: np.ndarray) -> np.ndarray:
    """Squares of a single frame about its median, for want of differences in time."""
    return ((residual - median(residual)) ** 2).ravel()


_MOST_PIXELS = 0.95
"""Share of the pixels whose mean variance is no outlier's: hits of long darks reach 2 % of them, with ten
thousand times the variance of the others."""


def _of_most(v: np.ndarray) -> float:
    """Mean variance of all pixels but the noisiest."""
    return float(np.mean(v[v <= np.quantile(v, _MOST_PIXELS)]))


def trimmed(v: np.ndarray, dof: int) -> float:
    """Mean variance of the pixels that are like the others."""
    most = stats.chi2.isf(FAR, dof) / stats.chi2.median(dof)
    centre, least = float(median(v)), 0.1 * _of_most(v)
    for _ in range(2):
        kept = v[v <= most * max(centre, least)]
        centre = max(float(median(kept)), 0.5 * float(kept.mean()))
    return float(kept.mean())


def bulk_variance(v: np.ndarray, dof: int) -> float:
    """Mean variance without outlying pixels; of noise that leaves most pixels still, of nearly all."""
    if median(v) > 0.3 * _of_most(v):
        return trimmed(v, dof)
    return float(v[v <= 60 * v.mean()].mean())


def view(
    raw: Raw, noise: Noise, signal: np.ndarray, light: Light | None, step: float, coarse: bool = False
) -> View:
    """The frames as the bank sees them under a simulator's noise; `light` None: their mean is not known.
    step: of the codes, DN. coarse: noise of less than a code takes few values, and a limit in units of its
    own scatter jumps from one to the next: both sides are then counted beyond the same one."""
    weight = raw.usable / noise.sigma(signal)
    z = raw.contrasts * weight.astype(np.float32)
    n = len(z)
    steadiness = np.mean(z**2, 0) if n else np.zeros(raw.mean.shape, np.float32)
    odd, single, jumping = np.zeros(raw.mean.shape, bool), np.zeros((raw.frames, 1)), np.zeros(1)
    if n:
        scale = np.ones_like(steadiness) if coarse else _typical(steadiness, raw.usable, n)
        odd = steadiness > scale * stats.chi2.isf(FAR, n) / n
        inner = z[: raw.frames - 1]
        unsteady = odd & raw.usable
        jumping = moves.two_levels(inner[:, unsteady], scale[unsteady])
        alone, single = moves.lone_values(inner, scale, raw.usable, step * weight)
        odd |= alone
        steadiness = steadiness / scale
    level, static, static_kept = np.zeros(4), None, raw.usable & ~odd
    outlying = None
    if light is not None:
        residual, level = light.residual(raw.mean, raw.usable)
        static = residual * weight.astype(np.float32) * np.float32(np.sqrt(raw.frames))
        outlying = static
        static_kept &= np.abs(static) < STATIC * _robust(static, static_kept)
    kept = raw.usable & ~odd
    z *= kept
    inner = raw.contrasts[: raw.frames - 1]
    number = np.array([max(int(kept[at].sum()), 1) for at in SITES])  # a site that is not seen moves by 0
    levels = np.broadcast_to(level, (raw.frames, 4))
    if len(inner):
        moved = np.array([[np.sum(c[at], where=kept[at], dtype=float) for at in SITES] for c in inner])
        levels = level + helmert(raw.frames).T @ (moved / number)
    if static is not None:
        static = np.where(static_kept, static, 0).astype(np.float32)
    return View(
        z, kept, static, static_kept, outlying, raw.usable, steadiness, single, jumping, levels, raw.rails,
        raw.codes,
    )  # fmt: skip


def _typical(steadiness: np.ndarray, usable: np.ndarray, n: int) -> np.ndarray:
    """How much noisier the bulk of every site is than the simulator: a mean, as a median of noise
    below a code jumps from one of few values to the next."""
    out = np.ones(steadiness.shape, np.float32)
    for at in SITES:
        mine = steadiness[at][usable[at]]
        if mine.size:
            out[at] = max(bulk_variance(mine, n), 1e-3)
    return out


def _robust(static: np.ndarray, kept: np.ndarray) -> float:
    """Robust standard deviation of the static map, at least that of the noise."""
    values = static[kept]
    return max(robust_std(values), 1.0) if values.size else 1.0
