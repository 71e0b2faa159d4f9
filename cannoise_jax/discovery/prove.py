"""Prove: what the model gains on frames that took no part in finding it.

Parameters found in one half of the frames are judged on the other half. The log-likelihood of every probe is
close to quadratic in its amplitude (to the probe's power), so its value at the parameters of the first half
is its maximum in the second half less half the squared, standardised distance between the two fits.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.fit import Step, refit
from cannoise_jax.discovery.statistics.score import Score
from cannoise_jax.physics.likelihood import CodeGrid, gaussian_log_prob

MOST_JOINT = 4
"""Up to so many findings each is judged with all others in the model."""


class Proof(NamedTuple):
    """One mechanism on the second half: its fit there, the gain of the first half's fit, nats, and its
    error."""

    score: Score | None
    gain: float | None
    error: float
    pixels: int


def prove(steps: tuple[Step, ...], other: Prepared) -> tuple[Proof, ...]:
    """Every accepted mechanism on the other half of the frames, all others in the model; of many, those
    accepted before it, which have the larger effects."""
    probes = {p.name: p for p in other.probes}
    out = []
    earlier = other.fields
    for n, step in enumerate(steps):
        fields = earlier if len(steps) > MOST_JOINT else other.fields
        for m, second in enumerate(steps):
            if m != n and len(steps) <= MOST_JOINT:
                fields = refit(second.named.probe.absorb(fields, second.named.score))
        if len(steps) > MOST_JOINT:
            earlier = refit(step.named.probe.absorb(earlier, step.named.score))
        score = probes[step.named.probe.name].score(fields) if step.named.probe.name in probes else None
        pixels = int(sum(f.usable.sum() * f.frames for f in fields))
        if score is None or pixels == 0:
            out.append(Proof(None, None, 0.0, 0))
            continue
        gain = held_out_gain(step.named.score, score)
        out.append(Proof(score, gain, float(np.sqrt(2 * max(abs(gain), 0.5))), pixels))
    return tuple(out)


def held_out_gain(found: Score, again: Score) -> float:
    """Log-likelihood gain on the second half at the parameters of the first, nats."""
    power = found.power
    a, b = found.amplitude**power, again.amplitude**power
    error = max(power * max(again.amplitude, again.shift) ** (power - 1) * again.error, 1e-30)
    if not np.isfinite(error) or not _same_place(found, again):
        return 0.0 if not _same_place(found, again) else again.gain
    return float(again.gain - 0.5 * min((a - b) / error, 50.0) ** 2)


def _same_place(found: Score, again: Score) -> bool:
    """Whether both halves put the effect at the same frequency, boundary, edge or period."""
    for name, tolerance in (
        ("frequency", 2.5),
        ("frequency_x", 2.5),
        ("frequency_y", 2.5),
        ("boundary", 4.0),
    ):
        if name in found.parameters and name in again.parameters:
            a, b = found.parameters[name], again.parameters[name]
            if abs(a[0] - b[0]) > tolerance * max(a[2], b[2]):
                return False
    same = all(found.where.get(k) == again.where.get(k) for k in ("period",) if k in found.where)
    return same


def nll_per_pixel(prepared: Prepared) -> float | None:
    """Mean negative log-likelihood of the codes under the baseline, nats per pixel; discretised to the
    step."""
    total, number = 0.0, 0
    grid = CodeGrid(prepared.step)
    for stacked, field in zip(prepared.stacks, prepared.fields, strict=True):
        recording = stacked.recording
        frames = range(recording.count)[1::2] if recording.count > 1 else range(1)
        variance = np.maximum(field.sigma**2 - prepared.step**2 / 12, (0.05 * prepared.step) ** 2)
        for t in list(frames)[: field.frames]:
            codes = np.asarray(recording.frames[t : t + 1])[0]
            total -= float(
                _log_prob(codes.astype(np.float32), field.mean, variance, grid)[field.usable].sum()
            )
            number += int(field.usable.sum())
    return total / number if number else None


@jax.jit
def _log_prob(codes, mean, variance, grid):
    return jnp.maximum(gaussian_log_prob(codes, mean, variance, grid), -60.0)
