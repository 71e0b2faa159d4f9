"""What a search has accepted, and how it is taken out of the fields."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.signatures.fields import Fields, refit
from cannoise_jax.signatures.handed import Many


class Step(NamedTuple):
    """One accepted mechanism, the fields before it was taken out, and the family-wise log p of its signature
    with all other accepted mechanisms in the model; of one that is kept for what would be found in its stead,
    as it was accepted. late: it took all frames together to see it. left: the fields with everything taken
    out that was accepted. rivals: evidence of the other signatures when it was accepted."""

    named: Named
    before: tuple[Fields, ...]
    log_p: float
    late: bool = False
    left: tuple[Fields, ...] = ()
    rivals: Mapping[str, float] = MappingProxyType({})


class Fitted(NamedTuple):
    """All accepted steps, the fields that are left, and the last pass of the battery."""

    steps: tuple[Step, ...]
    fields: tuple[Fields, ...]
    last: Located
    first: Located


def without(named: Named, fields: Many, before: Many = ()) -> Many:
    """The fields with a finding taken out, and the variance of every channel brought back to one, but for
    recordings whose contrasts are still those of `before`."""
    return refit(named.signature.absorb(fields, named.score), before)


def without_all(steps: Iterable[Step], fields: Many) -> Many:
    """The fields with every step taken out, in order."""
    for step in steps:
        fields = without(step.named, fields)
    return fields


def part_of(steps: tuple[Step, ...]) -> dict[int, int]:
    """Steps that are the slow part of another: means of frames that move no more than noise slower than a
    frame moves them, and the step with that noise."""
    out = {}
    for n, step in enumerate(steps):
        score = step.named.score
        if not step.named.signature.of_frames:
            continue
        for m, other in enumerate(steps):
            moved = other.named.signature.moves_frames
            size = step.before[0].mean.shape
            if moved and score.amplitude - Z90 * score.error < moved(other.named.score, size):
                out[n] = m
    return out


def changed(before: tuple[Fields, ...], after: tuple[Fields, ...]) -> frozenset[str]:
    """What of the fields is not the same any more."""
    pairs = list(zip(before, after, strict=True))
    return frozenset(n for n in Fields._fields if any(getattr(a, n) is not getattr(b, n) for a, b in pairs))
