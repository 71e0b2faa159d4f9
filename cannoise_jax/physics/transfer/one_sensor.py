"""One gain for all pixels of a sensor without colours, whose four sites differ by chance alone."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer, of_all_pixels


def of_one_sensor(t: PhotonTransfer, base: Baseline) -> Baseline:
    """The baseline with the gain, and the read noise, of all pixels where the sites of a sensor without
    colours do not differ in it: converters and rows that take turns do."""
    whole = of_all_pixels(t).baseline if t.cfa == "MONO" else base
    if not isinstance(whole, Baseline):
        return base
    gain, read = base, base
    if _alike(base.gain, base.gain_stderr):
        gain = whole
    if _alike(base.read_noise, base.read_stderr):
        read = whole
    return dataclasses.replace(
        base, gain=gain.gain, gain_stderr=gain.gain_stderr, read_noise=read.read_noise,
        read_stderr=read.read_stderr,
    )  # fmt: skip


def _alike(values: Float[np.ndarray, "4"], errors: Float[np.ndarray, "4"]) -> bool:
    """Whether chance makes four values of such standard errors differ as much."""
    weight = 1 / np.maximum(errors, 1e-12) ** 2
    apart = values - np.sum(weight * values) / weight.sum()
    return bool(stats.chi2.sf(np.sum(weight * apart**2), len(values) - 1) > BY_CHANCE)
