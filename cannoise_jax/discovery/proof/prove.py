"""Prove: what every finding gains on frames that took no part in finding it.

Strengths and frozen patterns of the frames that looked are judged on those held back. Where the finding has
a likelihood (`Signature.predict`), the gain is that of the codes, all findings in the model against all but
this one; its interval comes from the scatter of the gains of parts of the frames within each recording.
Where it has none, the gain is that of the finding's own statistic, which is close to quadratic in its
amplitude (to the statistic's power): its maximum on the frames held back less half the squared,
standardised distance between the two fits; its interval is a jackknife over bands of rows or blocks of
frames. Frozen patterns are learned on some frames and predicted on others: the claim is about this camera
and new frames.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy import stats

from cannoise_jax.discovery.frames.blocks import bands, frame_blocks, leave_out
from cannoise_jax.discovery.frames.splits import Splits
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.proof.heldout import Scored, score_frames
from cannoise_jax.discovery.search.fit import Fitted, Step
from cannoise_jax.discovery.search.maps import beside_others, predictions
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.signatures.fields import Fields, refit, without_pixels
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature

MOST_JOINT = 4
"""Up to so many findings each is judged with all others in the model."""
_BLOCKS = 6
"""Blocks of a jackknife."""
_LARGE = 5_000_000
"""Values from which a jackknife takes fewer blocks: statistics of large sets take seconds each."""
_NUISANCES = 12
"""Black level, gain and read noise of four channels, fitted on the frames that are scored: half a nat each.
"""


class Proof(NamedTuple):
    """One mechanism on the frames held back.

    score: its fit there. gain: of the fit of those that looked, nats, with a 90 % interval (nan where the
    frames are too few for one). basis: 'likelihood', 'statistic' or 'composite'; log_e: natural log of the
    e-value, None without a likelihood. shown: whether the finding is confirmed where `gain` does not say.
    """

    score: Score | None
    gain: float | None
    low: float
    high: float
    pixels: int
    basis: str = "statistic"
    log_e: float | None = None
    shown: bool | None = None

    @property
    def confirmed(self) -> bool:
        """Whether the frames held back show the finding by themselves: the whole 90 % interval of what it
        gains there lies above zero. Of the finding's own evidence, whatever simulator is judged."""
        if self.shown is not None:
            return self.shown
        return self.gain is not None and self.gain > 0 and bool(self.low > 0)


class Proofs(NamedTuple):
    """All findings, and the mean negative log-likelihood of the frames held back, nats per pixel: of the
    baseline and with every finding (None where one of them has no likelihood), with the frames' scores."""

    each: tuple[Proof, ...]
    before: float | None
    after: float | None

    def without_likelihood(self) -> Proofs:
        """The proofs of a simulator that has none."""
        return self._replace(before=None, after=None)


def refuted(step: Step, proof: Proof) -> bool:
    """Whether the frames held back exclude a finding: they gain nothing by it, and the strength that they
    show, which is zero, leaves no room for half of that of the frames that looked."""
    found, again = step.named.score, proof.score
    if step.late or again is None or proof.confirmed or proof.gain is None or proof.gain > 0:
        return False
    if step.named.signature.single_pixels:
        return False  # a few pixels may not jump again in few frames
    return again.amplitude == 0 and 0 < Z90 * again.error < found.amplitude / 2


def standing(
    fitted: Fitted, proofs: Proofs, tell: Callable[[str], None] = lambda text: None
) -> tuple[Fitted, Proofs]:
    """Both without the findings that the frames held back exclude."""
    steps, each = [], []
    for step, proof in zip(fitted.steps, proofs.each, strict=True):
        if refuted(step, proof):
            named = step.named
            tell(f"given up: {named.mechanism} ({named.signature.name}), not in the frames held back")
        else:
            steps.append(step)
            each.append(proof)
    return fitted._replace(steps=tuple(steps)), proofs._replace(each=tuple(each))


def unproven(steps: tuple[Step, ...]) -> Proofs:
    """What is said where no frames could be set aside."""
    return Proofs(tuple(Proof(None, None, np.nan, np.nan, 0) for _ in steps), None, None)


def unconfirmed(proofs: Proofs, steps: tuple[Step, ...]) -> Proofs:
    """The proofs without gains of findings that took all frames to see: none is left to confirm them."""
    each = (
        p._replace(gain=None, low=np.nan, high=np.nan, pixels=0, log_e=None, shown=False) if s.late else p
        for p, s in zip(proofs.each, steps, strict=True)
    )
    return proofs._replace(each=tuple(each))


def prove(
    fitted: Fitted,
    splits: Splits,
) -> Proofs:
    """Every accepted mechanism on the frames held back, all others in the model; for statistics, of many
    findings, those accepted before it, which have the larger effects. With all frames together the strength
    of a frozen pattern is told by `strength_beyond`.

    Pixels that a finding is about one by one (hot, telegraph) are scored for hot pixels only: their noise is
    not that of the others, and would drown what rows or frames share.
    """
    steps, first, second, chosen = fitted.steps, splits.looking, splits.held_back, splits.chosen
    signatures = {p.name: p for p in second.signatures}
    laws = predictions(steps)
    known = [p for p in laws if p is not None]
    base, full = each(lambda model: score_frames(first, second, chosen, model), ([], known))
    pixels = int(base.pixels.sum())
    ordinary = {f.number: f.usable for f in fitted.fields}
    masked = any(not np.array_equal(f.usable, ordinary[f.number]) for f in first.fields)

    def cut(n: int) -> tuple[bool, bool, bool]:
        """What says which pixels and parts of the frames are scored for a finding."""
        law = laws[n]
        assert law is not None
        return steps[n].named.signature.single_pixels or not masked, bool(law.frame), bool(law.column)

    def scored(n: int, whole: bool) -> Scored:
        model = [p for p in known if whole or p is not laws[n]]
        return score_frames(first, second, chosen, model, None if cut(n)[0] else ordinary, laws[n])

    lawful = [n for n, law in enumerate(laws) if law is not None and pixels]
    alike = {cut(n): n for n in lawful}  # the complete model is the same for all that are cut alike
    asked = [*((n, True) for n in alike.values()), *((n, False) for n in lawful)]
    told_by = each(lambda which: scored(*which), asked)
    complete_model = dict(zip(alike, told_by, strict=False))
    less = dict(zip(lawful, told_by[len(alike) :], strict=True))
    out: list[Proof] = []
    again, looking = others_out(steps, second.fields), others_out(steps, first.fields)
    once = any(step.named.signature.drawn_once for step in steps)
    together = others_out(steps, splits.together.fields) if once else None
    for n, step in enumerate(steps):
        fields = again(n)
        signature = signatures.get(step.named.signature.name)
        score = signature.score_again(fields, step.named.score) if signature is not None else None
        of_map = step.named.signature.map_of and step.left
        if together is not None and score is not None and step.named.signature.drawn_once and not of_map:
            looked, both = each(partial(_score_of, step.named.signature, n), (looking, together))
            if looked is not None and both is not None:
                score = strength_beyond(looked, both, score)
        told = step.named.signature.strength
        if score is not None and told is not None:
            score = told(step.named.score, looking(n), fields) or score
        law = laws[n]
        if law is not None and pixels:
            reference = complete_model[cut(n)]
            gain, low, high = frame_interval(reference, less[n])
            number, shown = int(reference.pixels.sum()), None
            if not np.isfinite(low) and score is not None and signature is not None:
                own = held_out_gain(step.named.score, score)  # one frame has no scatter: parts of it do
                shown = own > 0 and jackknife_interval(signature, fields, step.named.score, own)[0] > 0
            elif low <= 0 < gain:
                shown = frame_interval(*at_most_twice(reference, less[n]))[1] > 0
            log_e = gain - _NUISANCES / 2
            out.append(Proof(score, gain, low, high, number, "likelihood", log_e, shown))
        elif score is None or signature is None or not pixels:
            out.append(Proof(None, None, np.nan, np.nan, 0))
        else:
            gain = held_out_gain(step.named.score, score)
            low, high = jackknife_interval(signature, fields, step.named.score, gain)
            out.append(Proof(score, gain, low, high, pixels))
    if together is not None:
        out = _maps_beside(steps, out, again(len(steps)), together(len(steps)))
    complete = len(known) == len(steps)
    return Proofs(
        tuple(out),
        -float(base.log_prob.sum()) / pixels if pixels else None,
        -float(full.log_prob.sum()) / pixels if pixels and complete else None,
    )


def _maps_beside(
    steps: tuple[Step, ...], proofs: list[Proof], held: tuple[Fields, ...], both: tuple[Fields, ...]
) -> list[Proof]:
    """The proofs with the strengths of maps beside all other maps, on the frames held back and on all."""
    out = list(proofs)
    for n, (step, there, whole) in enumerate(
        zip(steps, beside_others(steps, held), beside_others(steps, both), strict=True)
    ):
        score = proofs[n].score
        if score is not None and step.named.signature.map_of and step.left:
            again, every = there.named.score, whole.named.score
            again = score.replace(
                amplitude=again.amplitude, error=again.error, shift=again.shift, parameters=again.parameters
            )
            out[n] = proofs[n]._replace(score=strength_beyond(step.named.score, every, again))
    return out


def others_out(steps: tuple[Step, ...], fields: tuple[Fields, ...]) -> Callable[[int], tuple[Fields, ...]]:
    """Fields by number of a finding, asked for in order, with every other finding taken out; of many, and for
    hot pixels that stand out from a map found after them, those accepted before it. Of one more than there
    are: with all taken out."""
    done = 0

    def without(n: int) -> tuple[Fields, ...]:
        nonlocal fields, done
        for step in steps[done:n]:
            fields = _without(step, fields)
        done, out = n, fields
        if n == len(steps):
            return out
        found = steps[n].named
        if len(steps) <= MOST_JOINT and not found.signature.before(found.score):
            for step in steps[n + 1 :]:
                out = _without(step, out)
        return out

    return without


def _score_of(signature: Signature, n: int, split: Callable[[int], tuple[Fields, ...]]) -> Score | None:
    return signature.score(split(n))


def _without(step: Step, fields: tuple[Fields, ...]) -> tuple[Fields, ...]:
    return refit(step.named.signature.absorb(fields, step.named.score))


def strength_beyond(looked: Score, both: Score, held: Score) -> Score:
    """Strength of a frozen pattern from what the frames held back add to those that selected it.

    Log-likelihood of the frames held back given the others, log p(all) - log p(looked), as a function of the
    pattern's variance, each close to quadratic about its own estimate: their difference is again. The frames
    held back by themselves tell the strength too, and better where the others know the pattern already; of
    both, the one with the smaller error. The standard error of an estimate v is s + q v, s: without a
    pattern, q: from the draw of the pattern itself; both follow from each estimate's own errors.
    """

    def law(score: Score) -> tuple[float, float, float]:
        value, least = score.amplitude**2, score.shift**2
        error = 2 * max(score.amplitude, score.shift) * score.error
        return value, least, max(error - least, 0.0) / max(value, least)

    (v_all, s_all, q_all), (v_look, s_look, q_look), (_, s_held, q_held) = map(law, (both, looked, held))
    inverse_all, inverse_look = (s_all + q_all * v_all) ** -2, (s_look + q_look * v_all) ** -2
    left = inverse_all - inverse_look
    if not left > (s_held + q_held * v_all) ** -2:
        return held
    value = max((v_all * inverse_all - v_look * inverse_look) / left, 0.0)
    amplitude, error = float(np.sqrt(value)), float(left**-0.5)
    error /= 2 * max(amplitude, both.shift)
    name, (_, unit, _) = next(iter(held.parameters.items()))
    parameters = {**held.parameters, name: (amplitude, unit, error)}
    return held.replace(amplitude=amplitude, error=error, parameters=parameters)


def frame_interval(with_it: Scored, without: Scored) -> tuple[float, float, float]:
    """Total gain in nats and its 90 % interval: from the scatter of the parts of the frames within each
    recording where they were scored apart, else from that of the frames."""
    gains = with_it.log_prob - without.log_prob
    total = float(gains.sum())
    recordings = np.unique(with_it.recording)
    if with_it.parts is not None and without.parts is not None:
        values = with_it.parts - without.parts
        groups = [values[with_it.recording == r].ravel() for r in recordings]
        # What a part cannot tell of an offset that it shares with another is missing in the sum of the parts.
        scale = np.clip(total / values.sum(), 1.0, 2.0) ** 2 if values.sum() > 0 else 1.0
    elif gains.size > 1:
        several = [g for r in recordings if (g := gains[with_it.recording == r]).size > 1]
        groups = several or [gains]
        # Recordings of one frame scatter like the others.
        scale = gains.size / sum(g.size for g in groups)
    else:
        return total, float("nan"), float("nan")
    variances = np.array([g.size * np.var(g, ddof=1) for g in groups]) * scale
    freedom = variances.sum() ** 2 / max(np.sum(variances**2 / [g.size - 1 for g in groups]), 1e-300)
    half = float(stats.t.isf(0.05, max(freedom, 1.0)) * np.sqrt(variances.sum()))
    return total, total - half, total + half


def at_most_twice(with_it: Scored, without: Scored) -> tuple[Scored, Scored]:
    """Both with no part of a recording's frames counting for more than twice the typical one of that
    recording: a few pixels far out may gain more than all others, and their scatter then says nothing."""
    if with_it.parts is None or without.parts is None:
        return with_it, without
    values = with_it.parts - without.parts
    for r in np.unique(with_it.recording):
        own = with_it.recording == r
        values[own] = np.minimum(values[own], 2 * max(float(np.median(values[own])), 0.0))
    kept = without._replace(log_prob=np.zeros(len(values)), parts=np.zeros(values.shape))
    return with_it._replace(log_prob=values.sum(1), parts=values), kept


def held_out_gain(found: Score, again: Score) -> float:
    """Log-likelihood gain on the frames held back at the parameters of the others, nats."""
    power = found.power
    a, b = found.amplitude**power, again.amplitude**power
    if not found.same_spot(again):
        return 0.0
    if not again.error > 0:  # a shape without a strength: less what its free parameters gain by chance
        return float(again.gain - again.penalty)
    error = max(power * max(again.amplitude, again.shift) ** (power - 1) * again.error, 1e-30)
    if not np.isfinite(error):
        return float(again.gain)
    return float(again.gain - 0.5 * np.clip((a - b) / error, -50.0, 50.0) ** 2)


def jackknife_interval(
    signature: Signature, fields: tuple[Fields, ...], found: Score, gain: float
) -> tuple[float, float]:
    """90 % interval of a held-out gain by leaving out bands of rows, or blocks of frames where a row or frame
    shares what is new in it; nan for fewer than two blocks."""
    size = sum(f.contrasts.size for f in fields)
    most = _BLOCKS if size < _LARGE else _BLOCKS // 2 + 1
    banded = signature.axes.in_bands
    blocks: list = bands(fields[0].mean.shape, most) if banded else frame_blocks(fields, most)
    if len(blocks) < 2:
        return float("nan"), float("nan")
    left: Callable[..., tuple[Fields, ...]] = without_pixels if banded else leave_out
    again = each(lambda block: signature.score_again(left(fields, block), found), blocks)
    gains = np.array([held_out_gain(found, s) for s in again if s is not None])
    if gains.size < 2:
        return float("nan"), float("nan")
    g = gains.size
    half = float(stats.t.isf(0.05, g - 1) * np.sqrt((g - 1) / g * np.sum((gains - gains.mean()) ** 2)))
    return gain - half, gain + half
