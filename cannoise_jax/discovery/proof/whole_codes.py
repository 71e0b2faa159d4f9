"""Whether codes are missing, or favoured, in all of the frame, as a name for the lattice of codes says.

A histogram of the whole frame has every so-manieth code more often where the converters of some columns are
coarser than those of the others. A comb of the whole frame is in each of its lines: where a typical row, or a
typical column, has next to nothing of it, a few have it alone.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.compare.families import CODES, of
from cannoise_jax.discovery.proof.own_part import Borne, but_for
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.robust import median
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.codes import COMB

_TYPICAL = 0.25
"""Of what all lines have on average, below which a typical one has next to nothing."""
_CHANCE = 1e-6
"""Probability that lines of one comb differ as much."""


def in_few_lines(step: Step, capture: CaptureSet, chosen: Sequence[Sequence[int]]) -> Doubt | None:
    """What speaks against a step that names a comb of codes; None: nothing does, it names none, or its codes
    do not repeat after a whole number of them. chosen: frames of every recording to look at."""
    where = step.named.score.where
    if step.named.mechanism == UNKNOWN or step.named.signature.axes.law != COMB:
        return None
    if where["period"] % 1 or where["period"] < 2:
        return None
    period, phase = int(where["period"]), int(where["phase"])
    more, total = _more(step, capture, chosen, period, phase)
    for axis, lines in enumerate(("rows", "columns")):
        off, number = more.sum(1 - axis), total.sum(1 - axis)
        seen = number > 0
        share, whole = off[seen] / number[seen], float(off.sum() / max(number.sum(), 1))
        # Counts of three residues of all: by chance what as many values at random have.
        spread = np.sqrt(1.5 / period / number[seen])
        uneven = float(np.sum(((share - whole) / spread) ** 2))
        typical = float(median(share)) * np.sign(whole)
        if typical > _TYPICAL * abs(whole) or stats.chi2.sf(uneven, seen.sum() - 1) > _CHANCE:
            continue
        few = int(np.sum(share * np.sign(whole) > abs(whole)))
        said = f"{few} of {int(seen.sum())} {lines} have these codes alone, the others have none of it"
        return Doubt(1 - max(typical, 0.0) / abs(whole), (said,), instead=True)
    return None


def codes_to_converters(
    each: Mapping[int, list[Borne]], converters: Collection[int]
) -> dict[int, list[Borne]]:
    """What mechanisms bear on, by number, but for how codes are filled where one of the converter moves that
    by more: any offset moves it too, and says nothing of where codes lie. converters: numbers of those."""
    moved: dict[str, float] = {}
    for n in converters:
        for b in each.get(n, ()):
            if b.judged.family == of("", CODES):
                moved[b.judged.where] = max(moved.get(b.judged.where, 0.0), float(b.change.sum()))

    def kept(b: Borne) -> bool:
        return b.judged.family != of("", CODES) or float(b.change.sum()) >= moved.get(b.judged.where, 0.0)

    return {n: borne if n in converters else but_for(borne, kept) for n, borne in each.items()}


def _more(
    step: Step, capture: CaptureSet, chosen: Sequence[Sequence[int]], period: int, phase: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """How often each pixel has a code of the comb, more than those beside it, and of how many values."""
    size = step.before[0].mean.shape
    more, total = np.zeros(size), np.zeros(size)
    for field in step.before:
        frames = capture.recordings[field.number].frames
        # A line of noise that is narrow beside the comb has what its level gives it.
        broad = field.usable & (field.sigma > period * field.step / 2)
        for t in chosen[field.number] if broad.any() else ():
            residue = (np.asarray(frames[t : t + 1])[0] // field.step).astype(np.int64) % period
            beside = (residue == (phase - 1) % period) | (residue == (phase + 1) % period)
            more += broad * ((residue == phase) - 0.5 * beside)
            total += broad
    return more, total
