"""Pixels that do not answer light, from flats."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool
from scipy import stats

from cannoise_jax.physics.robust import robust_std
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimators.dark_map import dark_map
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat, no_flat
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.response import CLEAR, DEAD, response_of
from cannoise_jax.physics.transfer.views import at_an_end
from cannoise_jax.recordings.packing import site

_DIM = NotMeasurable("record brighter flats: single pixels are not above their noise")
_NONE = NotMeasurable("every pixel answers the light of the flats", answered=True)


def dead_pixels(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """fraction of the pixels that show less than a fifth of the light about them in the brightest flat less
    its dark: a count, with the interval of Garwood (Biometrika 28, 1936). Parts that no light reaches, and
    pixels that are full in every frame, do not count."""
    flat = brightest_flat(statistics)
    if flat is None:
        return no_flat(statistics)
    dead = dead_of(statistics, flat)
    if dead is None:
        return _DIM
    count = int(dead.sum())
    if not count:
        return _NONE
    low, high = stats.chi2.ppf((0.05, 0.95), (2 * count, 2 * count + 2)) / 2
    ends = float(low) / dead.size, float(high) / dead.size
    return {"fraction": Estimate(count / dead.size, float(np.sqrt(count)) / dead.size, ends, 0.0)}


def dead_of(statistics: Sequence[FrameStatistics], flat: FrameStatistics) -> Bool[np.ndarray, "H W"] | None:
    """Which pixels do not answer the light of a repeated flat; None where it is too dim to tell."""
    dark = dark_map(statistics, flat)
    out = np.zeros(flat.mean.shape, bool)
    for c in range(4):
        signal = site(flat.mean, c) - flat.recording.black_level[c]
        if dark is not None:
            signal = signal - np.where(site(dark.keep, c), site(dark.offsets, c), 0.0)
        found = response_of(signal / flat.level[c], ~site(flat.clipped, c))
        healthy = found.pattern[found.keep]
        if not healthy.size or CLEAR * robust_std(healthy, 0.0) > 1 - DEAD:
            return None
        site(out, c)[...] = found.pattern < (DEAD - 1) * found.light
    # Masked pixels show nothing in the dark either.
    for s, _ in dark.darks if dark else ():
        out &= ~at_an_end(s)
    return out if flat.unlit is None else out & ~flat.unlit


def dead_map(values: Any, seen: Any) -> dict[str, np.ndarray]:
    """1 at dead pixels. seen: `transfer.maps.Seen`."""
    flat = brightest_flat(seen.statistics)
    dead = None if flat is None else dead_of(seen.statistics, flat)
    return {} if dead is None else {"dead": dead[None].astype(np.float64)}
