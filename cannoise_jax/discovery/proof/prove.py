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

from collections.abc import Callable, Sequence
from functools import partial
from itertools import compress
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.frames.splits import Splits
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.proof.gains import (
    at_most_twice,
    frame_interval,
    held_out_gain,
    jackknife_interval,
    strength_beyond,
)
from cannoise_jax.discovery.proof.heldout import Scored, score_frames
from cannoise_jax.discovery.search.maps import beside_others, predictions
from cannoise_jax.discovery.search.name import TIE_NATS, UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Fitted, Step, without_all
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import FILES, Signature

MOST_JOINT = 4
"""Up to so many findings each is judged with all others in the model."""
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

    @property
    def loses(self) -> bool:
        """Whether the frames held back are told no better with the finding, at its strength, than without."""
        return self.gain is not None and self.gain <= 0 and not self.confirmed


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
    show, which is zero, leaves no room for half of that of the frames that looked, or they lose surely. Of
    one without a name that they gain nothing is enough: nothing but its strength speaks for it, and a law
    that is a little off, as that of noise along the raster, leaves as much. A map that is drawn once has to
    be the same in both: of one that the frames held back have at no strength nothing would be handed back but
    its name; and a pattern that stays is where it was. What would take from the gain what it is needs a name
    and has to be confirmed: no draw shows which of both it is."""
    found, again, signature = step.named.score, proof.score, step.named.signature
    if signature.of_gain and (step.named.mechanism == UNKNOWN or not proof.confirmed):
        return True
    if step.late or again is None or proof.confirmed or proof.gain is None:
        return False
    if signature.drawn_once and again.amplitude == 0:
        return True
    if proof.gain > 0:
        return False
    if signature.frozen and signature.reads != FILES and not found.same_spot(again):
        return True
    if signature.single_pixels:
        return False  # a few pixels may not jump again in few frames
    if step.named.mechanism == UNKNOWN:
        return True
    excluded = 0 < Z90 * again.error < found.amplitude / 2 or proof.gain < -TIE_NATS
    return again.amplitude == 0 and excluded


def standing(
    fitted: Fitted, proofs: Proofs, tell: Callable[[str], None] = lambda text: None
) -> tuple[Fitted, Proofs]:
    """Both without the findings that the frames held back exclude."""
    kept = [not refuted(step, proof) for step, proof in zip(fitted.steps, proofs.each, strict=True)]
    for step in (s for s, stands in zip(fitted.steps, kept, strict=True) if not stands):
        named = step.named
        tell(f"given up: {named.mechanism} ({named.signature.name}), not in the frames held back")
    return with_those(fitted, proofs, kept)


def with_those(fitted: Fitted, proofs: Proofs, kept: Sequence[bool]) -> tuple[Fitted, Proofs]:
    """Both with the findings that are kept alone."""
    steps, each = tuple(compress(fitted.steps, kept)), tuple(compress(proofs.each, kept))
    return fitted._replace(steps=steps), proofs._replace(each=each)


def without_doubted_gain(
    fitted: Fitted, proofs: Proofs, against: Sequence[Doubt | None]
) -> tuple[Fitted, Proofs] | None:
    """Both without the findings that take from the gain and lose their name; None: there are none."""
    named = [not s.named.signature.of_gain or d is None for s, d in zip(fitted.steps, against, strict=True)]
    return None if all(named) else with_those(fitted, proofs, named)


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
    tell: Callable[[str], None] = lambda text: None,
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
        model = known if whole else [q for p in known if (q := p.left_out if p is laws[n] else p) is not None]
        return score_frames(first, second, chosen, model, None if cut(n)[0] else ordinary, laws[n])

    lawful = [n for n, law in enumerate(laws) if law is not None and pixels]
    alike = {cut(n): n for n in lawful}  # the complete model is the same for all that are cut alike
    asked = [*((n, True) for n in alike.values()), *((n, False) for n in lawful)]
    told_by = each(lambda which: scored(*which), asked, tell, "prove: likelihood of findings")
    complete_model = dict(zip(alike, told_by, strict=False))
    less = dict(zip(lawful, told_by[len(alike) :], strict=True))
    out: list[Proof] = []
    again, looking = others_out(steps, second.fields), others_out(steps, first.fields)
    once = any(step.named.signature.drawn_once or step.named.signature.redraws_frames for step in steps)
    together = others_out(steps, splits.together.fields) if once else None
    for n, step in enumerate(steps):
        tell(f"prove: strength of findings, {n} of {len(steps)}")
        fields = again(n)
        signature = signatures.get(step.named.signature.name)
        score = signature.score_again(fields, step.named.score) if signature is not None else None
        of_map = step.named.signature.map_of and step.left
        if together is not None and score is not None and step.named.signature.drawn_once and not of_map:
            looked, both = each(partial(_score_of, step.named.signature, n), (looking, together))
            if looked is not None and both is not None:
                score = strength_beyond(looked, both, score)
        told = step.named.signature.strength
        strength = None if told is None else partial(told, step.named.score, looking(n))
        if score is not None and strength is not None:
            score = strength(fields) or score
        law = laws[n]
        if law is not None and pixels:
            reference = complete_model[cut(n)]
            gain, low, high = frame_interval(reference, less[n])
            number, shown = int(reference.pixels.sum()), None
            if not np.isfinite(low) and score is not None and signature is not None:
                own = held_out_gain(step.named.score, score)  # one frame has no scatter: parts of it do
                shown = own > 0 and jackknife_interval(signature, fields, step.named.score, score, own)[0] > 0
            elif low <= 0 < gain:
                shown = frame_interval(*at_most_twice(reference, less[n]))[1] > 0
            log_e = gain - _NUISANCES / 2
            out.append(Proof(score, gain, low, high, number, "likelihood", log_e, shown))
        elif score is None or signature is None or not pixels:
            out.append(Proof(None, None, np.nan, np.nan, 0))
        else:
            gain = held_out_gain(step.named.score, score)
            low, high = jackknife_interval(signature, fields, step.named.score, score, gain, strength)
            out.append(Proof(score, gain, low, high, pixels))
        if together is not None and signature is not None and signature.redraws_frames:
            out[-1] = _of_every_frame(out[-1], signature.score(together(n)))
    if together is not None:
        out = _maps_beside(steps, out, *(split(len(steps)) for split in (looking, again, together)))
    complete = len(known) == len(steps)
    return Proofs(
        tuple(out),
        -float(base.log_prob.sum()) / pixels if pixels else None,
        -float(full.log_prob.sum()) / pixels if pixels and complete else None,
    )


def _of_every_frame(proof: Proof, whole: Score | None) -> Proof:
    """The proof with the strength that all frames show: those held back may be a few that lie close."""
    if whole is None or proof.score is None or not proof.score.amplitude > 0 or not (proof.gain or 0) > 0:
        return proof
    return proof._replace(score=whole)


def _maps_beside(steps: tuple[Step, ...], proofs: list[Proof], *splits: tuple[Fields, ...]) -> list[Proof]:
    """The proofs with the strengths of maps beside all other maps. splits: the frames that looked, those held
    back, and all, with all findings taken out."""
    out = list(proofs)
    beside = (beside_others(steps, fields) for fields in splits)
    for n, (step, looked, there, whole) in enumerate(zip(steps, *beside, strict=True)):
        score = proofs[n].score
        if score is not None and step.named.signature.map_of and step.left:
            again, every = there.named.score, whole.named.score
            again = score.replace(
                amplitude=again.amplitude, error=again.error, shift=again.shift, parameters=again.parameters
            )
            out[n] = proofs[n]._replace(score=strength_beyond(looked.named.score, every, again))
    return out


def others_out(steps: tuple[Step, ...], fields: tuple[Fields, ...]) -> Callable[[int], tuple[Fields, ...]]:
    """Fields by number of a finding, asked for in order, with every other finding taken out but those in
    which it would be counted; of many, and for hot pixels that stand out from a map found after them, those
    accepted before it. Of one more than there are: with all taken out. What whole frames have is in all of
    their rows and columns, whose noise would take most of it along."""
    done, start = 0, fields

    def without(n: int) -> tuple[Fields, ...]:
        nonlocal fields, done
        fields = without_all(steps[done:n], fields)
        done, out = n, fields
        if n == len(steps):
            return out
        found = steps[n].named
        frame = found.signature.axes.varies_over == "frame"
        # Next to nothing of white noise of lines is in the mean of a frame.
        others = [s for s in steps[:n] if not s.named.signature.axes.white_lines]
        if frame and len(others) < n:
            out = without_all(others, start)
        if len(steps) <= MOST_JOINT and not found.signature.before(found.score):
            holds_it = found.signature.found_in
            after = (s for s in steps[n + 1 :] if s.named.signature.name not in holds_it)
            out = without_all((s for s in after if not (frame and s.named.signature.axes.white_lines)), out)
        return out

    return without


def _score_of(signature: Signature, n: int, split: Callable[[int], tuple[Fields, ...]]) -> Score | None:
    return signature.score(split(n))
