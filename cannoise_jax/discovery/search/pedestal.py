"""Where the darks lie beside what a camera model expects of them, exposure by exposure.

The mean of a dark is no noise: each recording's own is taken out before anything is looked for. A camera that
sets its black level by shielded pixels moves it with the exposure by laws of its own (of two cameras by 9 and
15 DN, two to twenty times what frames differ by), so a model that is to draw such darks holds it as measured.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.contrasts import Stack, ordinary, robust_mean
from cannoise_jax.discovery.search.dark_level import stored_dark
from cannoise_jax.mechanisms.pedestal import LEVELS, PEDESTAL
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.recordings.recording import DARK

_CHANCE = 1e-4
"""Chance of levels that differ as much where the model is right."""


def with_pedestals(model: SensorModel, prepared: Prepared) -> SensorModel:
    """The model with the black level of each exposure, where the darks of one gain setting differ from what
    the model expects by more than their frames scatter; as it is where they do not."""
    darks = [s for s in prepared.stacks if s.recording.kind in DARK and s.recording.exposure_s is not None]
    error = _scatter(darks)
    if error is None or len({s.recording.iso for s in darks}) != 1:
        return model
    seconds = np.array([float(s.recording.exposure_s or 0.0) for s in darks])
    frames, times = np.array([s.frames for s in darks]), np.unique(seconds)
    if times.size < 2:
        return model
    iso = prepared.isos[darks[0].recording.iso]
    off, expected, left = np.stack([_off(model, s, iso) for s in darks], 1)
    # Black is that of the shortest dark, and charge is known in DN as well as the gain of each site is.
    first = int(np.argmin(seconds))
    own = np.maximum(error**2 / frames[:, None], left)
    baseline = next(b for b in prepared.baselines if b.iso == darks[0].recording.iso)
    unsure = (expected - expected[first]) * baseline.gain_stderr / np.maximum(baseline.gain, 1e-9)
    chi2 = float(np.sum(off**2 / (own + own[first] + unsure**2)))
    if stats.chi2.sf(chi2, off.size) > _CHANCE:
        return model
    for k, at in enumerate(times):
        here = seconds == at
        level = np.average(off[here], axis=0, weights=frames[here])
        values: dict[str, Any] = {name: float(v) for name, v in zip(LEVELS, level, strict=True)}
        values["exposure_s"], values["below_s"] = float(at), float(times[max(k - 1, 0)])
        values["above_s"] = float(times[min(k + 1, times.size - 1)])
        model = model.with_mechanism(PEDESTAL, again=True, **values)
    return model


def _off(model: SensorModel, stacked: Stack, iso: float) -> Float[np.ndarray, "3 4"]:
    """Level of every site beyond what the model expects, that, DN, and the variance of their difference by
    what single pixels differ by: of pixels whose difference is ordinary. What the model expects has no noise
    that would tell which of them are few and far."""
    r = stacked.recording
    expected = stored_dark(_lasting(model), r.size, Settings(iso, r.exposure_s or 0.0, r.temperature_c))
    apart = stacked.mean - expected
    told = [(apart[at], expected[at][ordinary(apart[at])].mean()) for at in SITES]
    off, own = [robust_mean(values) for values, _ in told], [level for _, level in told]
    spread = [robust_std(values) ** 2 / values.size for values, _ in told]
    return np.array([off, own, spread])


def _lasting(model: SensorModel) -> SensorModel:
    """The model without what single frames have in a few pixels, as hits: the level of most has none."""
    points = ((f, f.record.point) for f in model.mechanisms)
    kept = (f for f, at in points if not (at.time == "redrawn" and at.distribution == "sparse"))
    return dataclasses.replace(model, mechanisms=tuple(kept))


def _scatter(darks: list[Stack]) -> Float[np.ndarray, "4"] | None:
    """Standard deviation of the level of a frame about that of its recording, DN, all darks together."""
    moved = [np.mean(c[at]) for s in darks for c in s.contrasts for at in SITES]
    if not moved:
        return None
    square = np.square(np.reshape(moved, (-1, len(SITES))))
    # Of few frames the median square would be chance; one that jumps must not hide what all share.
    return np.sqrt(np.maximum(np.minimum(square, 25 * median(square, 0)).mean(0), 1e-12))
