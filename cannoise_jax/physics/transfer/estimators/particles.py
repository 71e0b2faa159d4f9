"""Particle hits: how many there are, and how much charge they leave."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable, scatter_estimate
from cannoise_jax.physics.transfer.frames import FrameStatistics

_LONG = NotMeasurable("record at least 2 darks of one known exposure, tens of seconds, better 10")
_NONE = NotMeasurable("no particle hits show in the darks", answered=True)
_MEGAPIXEL = 1e6
"""Pixels that rates are quoted for."""


def cosmic_rays(statistics: Sequence[FrameStatistics], baseline=None) -> Estimates:
    """rate, events per megapixel and second, and charge_e, of the hits that stand out in repeated darks of
    known exposure: counts with the interval of Garwood (Biometrika 28, 1936), and the mean of their
    charges."""
    seen = [(s.hits, s.recording.exposure_s) for s in statistics if s.hits and s.recording.exposure_s]
    if not seen or baseline is None:
        return _LONG
    charges = np.concatenate([hits.charge for hits, _ in seen])
    if not len(charges):
        return _NONE
    looked = sum(hits.exposure * seconds for hits, seconds in seen) / _MEGAPIXEL
    count = len(charges)
    low, high = stats.chi2.ppf((0.05, 0.95), (2 * count, 2 * count + 2)) / 2
    rate = Estimate(
        count / looked, float(np.sqrt(count)) / looked, (float(low) / looked, float(high) / looked)
    )
    in_e = charges / float(np.mean(baseline.gain))
    charge = scatter_estimate(in_e) if count > 1 else Estimate(float(in_e[0]), float(in_e[0]), (0.0, np.inf))
    return {"rate": rate, "charge_e": charge}


def told(statistics: Sequence[FrameStatistics]) -> str:
    """A line that says how many particle hits were taken out of the darks; empty where none were."""
    hit = [s for s in statistics if s.hits is not None and len(s.hits.charge)]
    if not hit:
        return ""
    count = sum(len(s.hits.charge) for s in hit if s.hits)
    frames = sum(s.recording.count for s in hit)
    return (
        f"{count} particle hit{'s' * (count > 1)} (cosmic rays) in {frames} darks: their pixels are left out"
    )
