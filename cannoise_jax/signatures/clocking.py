"""Charge that the clocking of an electron multiplier adds, electron by electron."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.events import (
    Heights,
    Hidden,
    Spikes,
    limit_of,
    restless,
    spike_score,
    without_spikes,
)
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import CONTRASTS, STATIC, Axes, Signature

_NONE_SEEN = 1e-6
"""Share of single electrons that stand out, below which none does: normal noise does so as often."""
_SINGLE_E = 10.0
"""Electrons above which a spike is of no single one: an electron multiplier makes e^-10 of them as large."""

_ENOUGH = 20
"""Spikes from which on their sizes tell of what law they are."""
_LEAST_COUNTED = 0.2
"""Share of the spikes that is taken to be counted at least."""
_AS_LARGE = 2.0
"""Gain by variance over the mean size of a multiplied electron, at most: the excess noise factor is in it."""


def _multiplied(spikes: Heights) -> float:
    """Mean size of a multiplied electron, DN, where spikes are as single electrons of an electron multiplier
    are, exponential beyond any limit, rather than of one size; 0 where they are not."""
    if spikes.height.size < _ENOUGH:
        return 0.0
    beyond = np.maximum(spikes.height - spikes.limit, 1e-3 * spikes.sigma)
    mean, gain = float(beyond.mean()), float(spikes.gain.mean())
    if not gain / _AS_LARGE < _AS_LARGE * mean < _AS_LARGE**2 * gain:
        return 0.0
    at, least = (spikes.height - spikes.gain) / spikes.sigma, (spikes.limit - spikes.gain) / spikes.sigma
    alike = stats.norm.logpdf(at) - np.log(spikes.sigma) - stats.norm.logsf(least)
    spread = -np.log(mean) - beyond / mean
    return mean if float(np.sum(spread)) > float(np.sum(alike)) else 0.0


def hidden(fields: tuple[Fields, ...], found: list[Spikes], spikes: Heights) -> Hidden:
    """How many single electrons are freed for each that stands out of the noise and is counted, and how large
    a multiplied one is."""
    by_number, size = {f.number: f for f in fields}, _multiplied(spikes)
    seen = frames = 0.0
    for s in found:
        f = by_number[s.number]
        if size:
            limit, sigma = float(median(limit_of(f) * f.sigma)), float(median(f.sigma))
            share = float(stats.exponnorm.sf(limit, size / sigma, scale=sigma))
        else:
            height = float(np.mean(f.gain)) / f.sigma
            share = float(np.mean(np.where(f.usable, stats.norm.sf(limit_of(f) - height), 0.0)))
        seen += s.frames * share
        frames += s.frames
    each = size / float(spikes.gain.mean()) if size else 1.0
    if seen <= _NONE_SEEN * frames:
        return Hidden(float("inf"), each)
    return Hidden(frames / seen / _counted(found), each)


def _counted(found: list[Spikes]) -> float:
    """Share of the spikes that are counted: those whose pixel is restless in another frame as well are not,
    which by chance are as many as pixels are."""
    still = [1 - float(restless(s).mean()) for s in found]
    own = [1 - (1 - q) * (1 - 1 / s.frames) for q, s in zip(still, found, strict=True)]
    kept = [own[n] * float(np.prod(still[:n] + still[n + 1 :])) for n in range(len(found))]
    number = [float(s.up.sum()) for s in found]
    return max(float(np.average(kept, weights=number)), _LEAST_COUNTED) if sum(number) else 1.0


def clocking(*, name: str, mechanism: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """Charge that single frames have and no other, as much of it in short exposures. It comes electron by
    electron: what is far larger, or stands out where single electrons do not, has no name."""

    def readings(score: Score, scores: Mapping[str, Score]) -> tuple[tuple[str | None, float], ...]:
        single = np.isfinite(score.shift) and score.parameters["charge_e"][0] < _SINGLE_E
        return ((mechanism if single else None, score.evidence),)

    return plain(
        name=name,
        axes=Axes("pixel", "pixel", "redrawn", "additive", "sparse"),
        reads=CONTRASTS | STATIC | {"signal"},
        score=partial(spike_score, kind="clocking", hidden=hidden),
        absorb=without_spikes,
        simulate=carried(lambda s: {"charge_e": s.amplitude * (s.payload or 1.0)}),
        covers=covers,
        lifted_by=lifted_by,
        rare=True,
        readings=readings,
        counted=True,
    )
