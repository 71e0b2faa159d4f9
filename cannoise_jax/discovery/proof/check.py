"""Check: what differs between the frames held back and draws of a simulator, whatever its name.

The layer of `compare` at the end of a run: it looks at the simulator that was judged and at the one that is
handed back, at the settings of the frames held back.
Where few were held back, some of the frames that looked lend their mean, so that one frame shows what is new
in it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.report import Comparison
from cannoise_jax.discovery.compare.run import Chosen, compare_bank
from cannoise_jax.discovery.compare.score import Better, better
from cannoise_jax.discovery.compare.sources import Source, modelled
from cannoise_jax.discovery.compare.table import differences
from cannoise_jax.discovery.proof.sides import Drawings
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet

LENT = 3
"""Frames that lend their mean to as many held back or fewer."""

_PIXELS = 1.2e6
"""Pixels of all frames that are looked at, beyond which fewer are of the longest recordings."""


_LITTLE, _FAR = 0.05, 0.1
"""Share of what differed by which more may differ where score and area both say that the draws came nearer,
and where the area says far nearer. Of living cells, which move, a remainder took a third off the area, and
0.03 to 0.06 more differed."""


_TIMES, _MUCH = 3.0, 0.05
"""By how much one kind of difference may grow with the remainder while it stays below such a share of all
that differed before. Where columns lost a noise of their own to it, one that was right became 0.12 of it and
0.99 of what was left. Where it took the area 0.11 nearer, of codes of 0.6 of the noise, one became 0.005."""


class Checked(NamedTuple):
    """What differs before and after. nearer: which of both is nearer to the recordings (None: they draw
    nothing in common); held_back: whether the frames had no part in fitting; surely: whether composite score
    and two-sample area both say that the simulator handed back is nearer, far: the area that it is far so."""

    before: Comparison
    after: Comparison
    nearer: Better | None
    held_back: bool
    surely: bool = False
    far: bool = False

    @property
    def nats(self) -> float:
        """The mismatch of the simulator that is handed back."""
        return sum(d.nats for d in self.after.differences)

    @property
    def worse(self) -> bool:
        """Whether more differs than before, also where nothing did: surely more, where all else is better."""
        more = (_FAR if self.far else _LITTLE) if self.surely else 0.0
        return self.nats > (1 + more) * sum(d.nats for d in self.before.differences)

    @property
    def left(self) -> float | None:
        """Share of the mismatch, in nats, that is left; None where there was none."""
        first = sum(d.nats for d in self.before.differences)
        return self.nats / first if first > 0 else None


def spoils(with_rest: Comparison, without: Comparison, first: Comparison) -> bool:
    """Whether the remainder makes much of a difference of some kind that was small without it, or leaves more
    that differs in all. first: of the simulator that was judged."""
    before, after = _by_kind(without), _by_kind(with_rest)
    total = sum(d.nats for d in first.differences)
    grown = any(
        nats > _TIMES * before.get(kind, 0.0) and nats > _MUCH * total for kind, nats in after.items()
    )
    return grown or sum(after.values()) > sum(before.values()) + _LITTLE * total


def _by_kind(found: Comparison) -> dict[tuple[str, str], float]:
    out: dict[tuple[str, str], float] = {}
    for d in found.differences:
        out[d.what, d.time] = out.get((d.what, d.time), 0.0) + d.nats
    return out


def frames_for(splits: list[tuple[list[int], list[int]]]) -> Chosen:
    """The frames of every recording that are looked at, and those that lend their mean."""
    return [(look[-LENT:] if held and len(held) <= LENT else [], held) for look, held in splits]


def frames_for_names(capture: CaptureSet, splits: Sequence[tuple[list[int], list[int]]]) -> Chosen:
    """The frames that are looked at, in the order they were taken, as what a frame has of the one before says
    much of a name: all, or as many of the first of every recording as there is room for, two at least, and of
    many large ones those of some recordings, spread evenly, the first and the last among them."""
    frames = [sorted((*look, *held)) for look, held in splits]
    size = [r.size[0] * r.size[1] for r in capture.recordings]

    def pixels(most: int) -> int:
        return sum(min(len(f), most) * n for f, n in zip(frames, size, strict=True))

    longest = max(map(len, frames), default=0)
    most = next((m for m in range(longest, 2, -1) if pixels(m) <= _PIXELS), 2)
    chosen = [(list[int](), f[:most]) for f in frames]
    shown = [n for n, (_, b) in enumerate(chosen) if b]
    number = max(int(len(shown) * _PIXELS / max(pixels(most), 1)), 3)
    if number < len(shown):
        kept = {shown[k] for k in np.linspace(0, len(shown) - 1, number).round().astype(int)}
        chosen = [c if n in kept else ([], []) for n, c in enumerate(chosen)]
    return chosen


def compared_on(
    capture: CaptureSet,
    splits: list[tuple[list[int], list[int]]],
    source: Source,
    alpha: float,
    tell: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """One simulator against the frames held back (all frames where there are none)."""
    held = any(held for _, held in splits)
    chosen = frames_for(splits) if held else [([], look) for look, _ in splits]
    bank = compare_bank(capture, source, alpha=alpha, held_back=chosen, tell=tell)._replace(held_back=held)
    return Comparison(bank, tuple(differences(bank)))


def source_of(model: SensorModel | None, draws: Drawings, label: str, key: Key[Array, ""]) -> Source:
    """What the layer draws from: of a camera model every set is another unit where no map was measured."""
    if model is not None:
        return modelled(model, key)._replace(label=label)
    return Source(label, lambda m, *asked: draws(jax.random.fold_in(key, m))(*asked))


def check(first: Comparison, last: Comparison | None, *, surely: bool = False) -> Checked:
    """What differs of the simulator that was judged and of the one that is handed back (None: the same)."""
    nearer = None if last is None else better(first.bank, last.bank)
    return Checked(first, last or first, nearer, first.bank.held_back, surely)
