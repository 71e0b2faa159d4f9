"""The simulator that is handed back: that of the gate, or less of it where it differs from the recordings by
more than the one that was judged."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.report import Comparison
from cannoise_jax.discovery.compare.sources import shaded
from cannoise_jax.discovery.proof.check import Checked, check, compared_on, source_of, spoils
from cannoise_jax.discovery.proof.gate import Gated
from cannoise_jax.discovery.proof.judged import Judged
from cannoise_jax.discovery.proof.prove import Proofs, with_those
from cannoise_jax.discovery.proof.sides import Sides
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Fitted, Step
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput

_AFTER = "the simulator handed back"


def worth_telling(
    fitted: Fitted, proofs: Proofs, entered: Sequence[Step], tell: Callable[[str], None]
) -> tuple[Fitted, Proofs]:
    """Both without the findings that lost their name, that the frames held back gain nothing by, and that did
    not enter the simulator: nothing speaks for them."""
    kept = []
    for step, proof in zip(fitted.steps, proofs.each, strict=True):
        nameless = step.named.mechanism == UNKNOWN and step.named.doubt is not None
        empty = nameless and proof.loses and not step.late and not any(step is e for e in entered)
        if empty:
            tell(f"given up: no name, and nothing gained by it ({step.named.signature.name})")
        kept.append(not empty)
    return with_those(fitted, proofs, kept)


def checked(
    judged: Judged,
    sides: Sides,
    gated: Gated | None,
    instead: Callable[[Gated], Iterator[Gated]],
    frames: list[tuple[list[int], list[int]]],
    *,
    light: Mapping[int, np.ndarray],
    alpha: float,
    key: Key[Array, ""],
    tell: Callable[[str], None],
) -> tuple[Gated | None, Checked | None, SensorModel]:
    """What differs between the frames held back and draws before and after (None: none can be drawn; of a
    function beside which nothing was found, of the function), and the simulator that is handed back. Where
    more differs than before, the first of what is `instead` is by which less does; where too few frames were
    held back for the gate, all that was found goes. light: `shades`; alpha: of the comparison."""
    model = sides.exported if gated is None else gated.model

    def compared(model: SensorModel | None, label: str) -> Comparison:
        source = shaded(source_of(model, sides.plain, label, key), light)
        return compared_on(judged.capture, frames, source, alpha, tell)

    def against(first: Comparison, model: SensorModel, gated: Gated | None) -> Checked:
        given = model is sides.model or (sides.model is None and sides.extended is None)
        sure = gated is not None and gated.surely
        found = check(first, None if given else compared(model, _AFTER), surely=sure)
        return found._replace(far=gated is not None and gated.far_nearer)

    try:
        first = compared(sides.model, judged.label)
        found = against(first, model, gated)
        if gated is not None and gated.remainder and not gated.far_nearer:
            spare = gated.without_remainder
            alone = against(first, spare.model, spare)
            if spoils(found.after, alone.after, first):
                gated, model, found = spare, spare.model, alone
        if not found.worse:
            return gated, found, model
        if gated is None and sides.model is not None:
            return None, check(first, None), sides.model
        for less in instead(gated) if gated is not None else ():
            without = against(first, less.model, less)
            if without.nats < found.nats:
                gated, found, model = less, without, less.model
            if not found.worse:
                break
    except BadInput:
        return gated, None, model
    return gated, found, model
