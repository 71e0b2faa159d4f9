"""Which recordings an estimator looks at, and what it says when they are not there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.fit import cut_and_loss, robust_mean_square
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.full_well import below_full, full_signal
from cannoise_jax.physics.transfer.quiet import BELOW_A_CODE, unchanging
from cannoise_jax.physics.transfer.unlit import UNLIT
from cannoise_jax.physics.transfer.views import black_of, pixel_variance, unspoilt
from cannoise_jax.recordings.packing import ALL, site
from cannoise_jax.recordings.recording import DARK

_WARM = 6.0
"""Robust standard deviations of the pixels' means above their median beyond which a pixel is warm."""
_COLDEST, _MIRRORED = 0.98, 1.25
"""Quantile of how far pixels lie below their median, and how often it those that are warm lie above."""

_REPEATED_FLATS = NotMeasurable("record at least 2 frames of an even, steady light, better 16")
_ENDS = NotMeasurable(
    "pixels of every repeated flat are full, or at an end of the codes: record dimmer flats, 2 frames or more"
)


def repeated_darks(statistics: Sequence[FrameStatistics], least: int = 2, better: int = 16) -> NotMeasurable:
    """What to record where so many frames in the dark are needed, in view of the biases and darks given."""
    most = max(
        (s.recording for s in statistics if s.recording.kind in DARK), key=lambda r: r.count, default=None
    )
    if most is None:
        return NotMeasurable(f"record at least {least} frames with the cap on, better {better}")
    kinds = {"bias": "biases", "dark": "darks"}
    if most.count >= least and darkest(statistics) is None:
        return NotMeasurable(BELOW_A_CODE)
    given = f"1 {most.kind}" if most.count == 1 else f"{most.count} {kinds[most.kind]}"
    return NotMeasurable(
        f"record at least {least} frames of one exposure with the cap on, better {better}: {given} given"
    )


def darkest(statistics: Sequence[FrameStatistics]) -> FrameStatistics | None:
    """The repeated darks with the most frames; among equals the shortest exposure. Those whose noise does not
    show do not count."""
    darks = [
        s for s in statistics if s.recording.kind in DARK and s.variance is not None and not unchanging(s)
    ]
    return min(darks, key=lambda s: (-s.recording.count, s.recording.exposure_s or 0.0), default=None)


def darks_by_exposure(statistics: Sequence[FrameStatistics]) -> list[FrameStatistics]:
    """Darks of known exposure, shortest first."""
    darks = [s for s in statistics if s.recording.kind in DARK and s.recording.exposure_s is not None]
    return sorted(darks, key=lambda s: s.recording.exposure_s or 0.0)


def brightest_flat(statistics: Sequence[FrameStatistics]) -> FrameStatistics | None:
    """The brightest repeated flat of which hardly a pixel is clipped or full."""
    full = [full_signal(statistics, c) for c in range(4)]
    flats = [
        s for s in statistics
        if s.recording.kind == "flat" and s.variance is not None and s.clipped[unspoilt(s)].mean() < 1e-3
        and all(below_full(s, full[c], black_of(s.recording, c), c) for c in range(4))
    ]  # fmt: skip
    return max(flats, key=lambda s: float(np.mean(s.level)), default=None)


def no_flat(statistics: Sequence[FrameStatistics]) -> NotMeasurable:
    """Why there is no `brightest_flat`, and what to record."""
    repeated = [s for s in statistics if s.recording.kind == "flat" and s.variance is not None]
    if not repeated:
        return _REPEATED_FLATS
    return NotMeasurable(UNLIT) if any(s.unlit is not None for s in repeated) else _ENDS


def steady_pixels(s: FrameStatistics, channel: int = ALL) -> Bool[np.ndarray, "h w"]:
    """Pixels that pass the rule for outliers of `transfer.fit`, each channel by itself, and never touched a
    rail: of one channel, or of the mosaic."""
    if channel != ALL:
        _, inside = robust_mean_square(pixel_variance(s, channel), s.dof)
        return inside & ~site(s.clipped, channel)
    keep = np.zeros(s.mean.shape, bool)
    for c in range(4):
        site(keep, c)[...] = steady_pixels(s, c)
    return keep


def odd_by_charge(s: FrameStatistics, gain: Float[np.ndarray, "4"] | None) -> Bool[np.ndarray, "H W"]:
    """Pixels of a repeated dark that say nothing of its read noise: dead ones, those that a particle hit, and
    warm ones whose variance is what the shot noise of their own dark charge explains. gain: DN/e-; without it
    none counts as warm."""
    odd = np.zeros(s.mean.shape, bool) if s.hits is None else s.hits.pixels.copy()
    odd = odd if s.dead is None else odd | s.dead
    if gain is None:
        return odd
    cut, _ = cut_and_loss(s.dof)
    for c in range(4):
        mean, variance = site(s.mean, c), pixel_variance(s, c)
        middle = float(median(mean))
        charge = mean - middle
        read, _ = robust_mean_square(variance, s.dof)
        least = _WARM * robust_std(mean, middle)
        # Heat only adds: what lies as far below (telegraph pixels in their lower state) has another cause.
        if (cold := -charge[charge < -least]).size:
            least = max(least, _MIRRORED * float(np.quantile(cold, _COLDEST)))
        warm = charge > least
        site(odd, c)[...] |= warm & (variance <= cut * (read + gain[c] * charge))
    return odd


def pooled_variance(s: FrameStatistics) -> tuple[float, float]:
    """Temporal pixel variance over all channels by the rule for outliers, DN^2, and degrees of freedom."""
    found = [robust_mean_square(pixel_variance(s, c), s.dof) for c in range(4)]
    return float(np.mean([f[0] for f in found])), float(sum(f[1].sum() for f in found) * s.dof)


def mean_variance(s: FrameStatistics) -> tuple[float, float]:
    """Temporal pixel variance, the mean over all pixels, loud ones included, DN^2, and the degrees of freedom
    that its scatter is worth: what the noise of pixels leaves in means of rows and columns."""
    values = np.concatenate([pixel_variance(s, c).ravel() for c in range(4)])
    mean = float(values.mean())
    return mean, max(2 * mean**2 * values.size / max(float(values.var()), 1e-12), 1.0)


def row_offsets(s: FrameStatistics) -> Float[np.ndarray, "T H"]:
    """Mean of every row of every frame above the frame's mean, DN, both colours of the row together."""
    means = s.row_means.mean(-1)
    return means - means.mean(1, keepdims=True)


def column_offsets(s: FrameStatistics) -> Float[np.ndarray, "T W"]:
    """Mean of every column of every frame above the frame's mean, DN."""
    means = s.column_means.mean(1)
    return means - means.mean(1, keepdims=True)


def without_step(columns: Float[np.ndarray, "*T W"]) -> Float[np.ndarray, "*T W"]:
    """Columns less the mean of either half of the frame, over all frames: what `amplifier_mismatch` holds."""
    halves = np.array_split(columns.reshape(-1, columns.shape[-1]).mean(0), 2)
    return columns - np.concatenate([np.full(half.shape, half.mean()) for half in halves])
