"""Whether what speaks for a name may be the trace of something stronger that has none."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from cannoise_jax.discovery.proof.own_part import TRACE, Borne, clear_of, own_part, owned
from cannoise_jax.discovery.search.name import Doubt
from cannoise_jax.discovery.search.steps import Step

LEFT_TOGETHER = 0.5
"""Share of its part that a name may leave where no single statistic differs significantly, but all together
leave more than chance."""
SLACK = 15.0
"""Nats that a name may leave beyond its share, so that one statistic does not speak against a weak effect."""
_OF_ITS_OWN = 0.3
"""Share of what a name changes, in nats, that no unknown finding changes far more."""
_FAR_MORE = 3.0
"""Times the evidence of all that has no name together."""
_SHADOW = "what speaks for it may be a trace of a stronger finding without a name"


def undrawn(step: Step, unknown: Sequence[Step]) -> Doubt | None:
    """What speaks against a name that no draw can be held against: that something without a name has so much
    more evidence that it may be its trace. From what the files hold nothing is taken out: only what is found
    there as well can be in it."""
    own = step.named
    told = [one.named for one in unknown if own.signature.reads or not one.named.signature.reads]
    more = any(TRACE * one.score.gain > own.score.gain for one in told)
    return Doubt(1.0, (_SHADOW,), instead=True) if more else None


def outweighs(one: Step, other: Step) -> bool:
    """Whether a step has more evidence than another that may be a trace of it: that is alike in time, or is
    told by what the files hold as it is, from which nothing is taken out."""
    first, second = one.named.signature, other.named.signature
    alike = first.frozen == second.frozen or not (first.reads or second.reads)
    return alike and one.named.score.gain > other.named.score.gain


def outshines(one: Step, unknown: Sequence[Step]) -> bool:
    """Whether a step has far more evidence than all that has no name together: it is no trace of that,
    however much the draws of what only resembles something are off where it is seen."""
    return one.named.score.gain > _FAR_MORE * sum(max(k.named.score.gain, 0.0) for k in unknown)


def shadowed(
    each: list[Borne],
    unknown: dict[tuple[str, str], np.ndarray],
    of_its_own: bool,
    larger: Mapping[tuple[str, str], float] = MappingProxyType({}),
) -> Doubt | None:
    """What speaks against a name beside something unknown: that it accounts for less than half of its part,
    or for little in the recordings in which no larger unknown finding moves far more, that it bears on little
    but what the unknown bears on far more, or on nothing at all where its evidence is not of its own: not
    shown by the frames held back, or less than that of an unknown finding of its kind. What moves no more
    than chance does is nothing: the frames held back decide. larger: nats that larger unknown findings of its
    kind move, by recording and part, see `moved_at`: an offset that biases show is no trace of what grows
    with the exposure."""
    part = own_part(each)
    if of_its_own and (max(part.before, part.after) < SLACK or not part.tells):
        return None
    whole = sum(float(b.change[b.own].sum()) for b in each)
    against = Doubt(part.after / part.before if part.before > 0 else 1.0, (_SHADOW,), instead=True)
    elsewhere = own_part(clear_of(each, larger)).before
    if part.after > LEFT_TOGETHER * part.before or elsewhere < min(SLACK, part.before):
        return against
    alone = [b for b in each if b.at not in unknown]
    alone += owned([b for b in each if b.at in unknown], unknown)
    own = sum(float(b.change[b.own].sum()) for b in alone)
    if own > _OF_ITS_OWN * whole or (of_its_own and not whole):
        return None
    return against
