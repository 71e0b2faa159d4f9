"""Prove: what every finding gains on frames that took no part in finding it.

Strengths and frozen patterns found in one half of the frames are judged on the other half. Where the
finding has a likelihood (`heldout.predicted`), the gain is that of the codes, all findings in the model
against all but this one; its interval comes from the scatter of the frames' gains within each recording.
Where it has none, the gain is that of the finding's own statistic, which is close to quadratic in its
amplitude (to the statistic's power): its maximum on the second half less half the squared, standardised
distance between the two fits; its interval is a jackknife over blocks of frames. Frozen patterns are
learned in one half and predicted in the other: the claim is about this camera and new frames.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import stats

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.fields import Fields, helmert, refit
from cannoise_jax.discovery.fit import Fitted, Step
from cannoise_jax.discovery.heldout import Scored, predicted, score_frames
from cannoise_jax.discovery.statistics.score import Probe, Score

MOST_JOINT = 4
"""Up to so many findings each is judged with all others in the model."""
_BLOCKS = 6
_LARGE = 5_000_000
"""Values from which a jackknife takes fewer blocks: statistics of large sets take seconds each."""
_NUISANCES = 12
"""Black level, gain and read noise of four channels, fitted on the frames that are scored: half a nat each.
"""


class Proof(NamedTuple):
    """One mechanism on the second half.

    score: its fit there. gain: of the first half's fit, nats, with a 90 % interval (nan where the frames
    are too few for one). basis: 'likelihood', 'statistic' or 'composite'; log_e: natural log of the e-value,
    None without a likelihood.
    """

    score: Score | None
    gain: float | None
    low: float
    high: float
    pixels: int
    basis: str = "statistic"
    log_e: float | None = None

    @property
    def confirmed(self) -> bool:
        """Whether the whole interval of the gain lies above zero."""
        return self.gain is not None and self.gain > 0 and bool(self.low > 0)


class Proofs(NamedTuple):
    """All findings, and the mean negative log-likelihood of the second half, nats per pixel: of the baseline
    and with every finding (None where one of them has no likelihood), with the frames' scores."""

    each: tuple[Proof, ...]
    before: float | None
    after: float | None


def unproven(steps: tuple[Step, ...]) -> Proofs:
    """What is said where no frames could be set aside."""
    return Proofs(tuple(Proof(None, None, np.nan, np.nan, 0) for _ in steps), None, None)


def prove(fitted: Fitted, first: Prepared, second: Prepared, chosen: list[list[int]]) -> Proofs:
    """Every accepted mechanism on the other half of the frames, `chosen` per recording, all others in the
    model; for statistics, of many findings, those accepted before it, which have the larger effects.

    Pixels that a finding is about one by one (hot, telegraph) are scored for hot pixels only: their noise is
    not that of the others, and would drown what rows or frames share.
    """
    steps = fitted.steps
    probes = {p.name: p for p in second.probes}
    laws = [predicted(step) for step in steps]
    known = [p for p in laws if p is not None]
    base = score_frames(first, second, chosen, [])
    full = score_frames(first, second, chosen, known) if known else base
    pixels = int(base.pixels.sum())
    ordinary = {f.number: f.usable for f in fitted.fields}
    masked = any(not np.array_equal(f.usable, ordinary[f.number]) for f in first.fields)
    most = score_frames(first, second, chosen, known, ordinary) if masked and known else full
    out = []
    earlier = second.fields
    for n, step in enumerate(steps):
        fields = earlier if len(steps) > MOST_JOINT else second.fields
        for m, other in enumerate(steps):
            if m != n and len(steps) <= MOST_JOINT:
                fields = refit(other.named.probe.absorb(fields, other.named.score))
        if len(steps) > MOST_JOINT:
            earlier = refit(step.named.probe.absorb(earlier, step.named.score))
        probe = probes.get(step.named.probe.name)
        score = probe.score(fields) if probe is not None else None
        law = laws[n]
        if law is not None and pixels:
            rest = [p for p in laws if p is not None and p is not law]
            single = step.named.probe.name.startswith("hot_") or not masked
            reference = full if single else most
            without = score_frames(first, second, chosen, rest, None if single else ordinary)
            gain, low, high = frame_interval(reference, without)
            scored = int(reference.pixels.sum())
            out.append(Proof(score, gain, low, high, scored, "likelihood", gain - _NUISANCES / 2))
        elif score is None or probe is None or not pixels:
            out.append(Proof(None, None, np.nan, np.nan, 0))
        else:
            gain = held_out_gain(step.named.score, score)
            low, high = jackknife_interval(probe, fields, step.named.score, gain)
            out.append(Proof(score, gain, low, high, pixels))
    complete = len(known) == len(steps)
    return Proofs(
        tuple(out),
        -float(base.log_prob.sum()) / pixels if pixels else None,
        -float(full.log_prob.sum()) / pixels if pixels and complete else None,
    )


def frame_interval(with_it: Scored, without: Scored) -> tuple[float, float, float]:
    """Total gain in nats and its 90 % interval from the scatter of the frames within each recording; where
    every recording has one frame, from that of the recordings."""
    gains = with_it.log_prob - without.log_prob
    total = float(gains.sum())
    groups = [gains[with_it.recording == r] for r in np.unique(with_it.recording)]
    several = [g for g in groups if g.size > 1]
    if several:
        parts = np.array([g.size * np.var(g, ddof=1) for g in several])
        # Recordings of one frame scatter like the others.
        parts *= gains.size / sum(g.size for g in several)
        freedom = parts.sum() ** 2 / max(np.sum(parts**2 / [g.size - 1 for g in several]), 1e-300)
    elif gains.size > 1:
        parts, freedom = np.array([gains.size * np.var(gains, ddof=1)]), gains.size - 1.0
    else:
        return total, float("nan"), float("nan")
    half = float(stats.t.isf(0.05, max(freedom, 1.0)) * np.sqrt(parts.sum()))
    return total, total - half, total + half


def held_out_gain(found: Score, again: Score) -> float:
    """Log-likelihood gain on the second half at the parameters of the first, nats."""
    power = found.power
    a, b = found.amplitude**power, again.amplitude**power
    error = max(power * max(again.amplitude, again.shift) ** (power - 1) * again.error, 1e-30)
    if not _same_place(found, again):
        return 0.0
    if not np.isfinite(error):
        return float(again.gain)
    return float(again.gain - 0.5 * min((a - b) / error, 50.0) ** 2)


def jackknife_interval(
    probe: Probe, fields: tuple[Fields, ...], found: Score, gain: float
) -> tuple[float, float]:
    """90 % interval of a held-out gain by leaving out blocks of frames; nan for fewer than two blocks."""
    size = sum(f.contrasts.size for f in fields)
    blocks = frame_blocks(fields, _BLOCKS if size < _LARGE else _BLOCKS // 2 + 1)
    if len(blocks) < 2:
        return float("nan"), float("nan")
    again = [probe.score(leave_out(fields, block)) for block in blocks]
    gains = np.array([held_out_gain(found, s) for s in again if s is not None])
    if gains.size < 2:
        return float("nan"), float("nan")
    g = gains.size
    half = float(stats.t.isf(0.05, g - 1) * np.sqrt((g - 1) / g * np.sum((gains - gains.mean()) ** 2)))
    return gain - half, gain + half


def frame_blocks(fields: tuple[Fields, ...], most: int) -> list[list[tuple[int, int]]]:
    """Frames as (field, frame), in at most `most` blocks. The two frames of a recording of two stay
    together: one alone says nothing."""
    units: list[list[tuple[int, int]]] = []
    for n, f in enumerate(fields):
        if f.frames == 2:
            units.append([(n, 0), (n, 1)])
        elif f.frames > 2:
            units += [[(n, t)] for t in range(f.frames)]
    count = min(most, len(units))
    return [[frame for unit in units[k::count] for frame in unit] for k in range(count)]


def leave_out(fields: tuple[Fields, ...], block: list[tuple[int, int]]) -> tuple[Fields, ...]:
    """The fields without some of their frames; recordings of which one frame would be left drop out."""
    out = []
    for n, f in enumerate(fields):
        gone = [t for m, t in block if m == n]
        if not gone:
            out.append(f)
            continue
        kept = [t for t in range(f.frames) if t not in gone]
        if len(kept) < 2:
            continue
        frames = np.einsum("nt,nij->tij", helmert(f.frames).astype(np.float32), f.contrasts)[kept]
        static = None
        if f.static is not None:
            frames += f.static / np.float32(np.sqrt(f.frames))
            static = frames.sum(0) / np.float32(np.sqrt(len(kept)))
        contrasts = np.einsum("nt,tij->nij", helmert(len(kept)).astype(np.float32), frames)
        out.append(f._replace(frames=len(kept), contrasts=contrasts, static=static))
    return tuple(out)


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
