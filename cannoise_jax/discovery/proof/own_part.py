"""The part of the mismatch that a mechanism bears on, statistic by statistic, in nats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.discovery.compare.compared import Compared, Judgement, Statistics
from cannoise_jax.discovery.compare.families import (
    FAMILIES,
    IN_ONE_FRAME,
    LEVELS,
    MOMENTS,
    STATIC,
    STRUCTURE,
    TAILS,
    TEMPORAL,
    UNSTEADY,
    of,
)
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.laws import FARTHEST

_BEARS = 4.0
"""Nats by which a statistic must change with a mechanism to be of its part: 2.8 standard deviations."""
_CLEAR = 0.1
"""Share of the larger mismatch by which it must change, beside what the draws scatter."""
_OWNED = 1 / 3
"""Share of the largest change that any accepted mechanism makes to a statistic, from which on it is of
the part of another one too."""
_MUCH = 100.0
"""Nats that a mechanism moves in recordings that are its own, from which on these alone tell."""
_CHANCE = 1e-4
"""Probability that all statistics of the part leave as much by chance."""


_TELLS = 0.5
"""Statistics that a mechanism has to change, each counted by the share that changes, to be judged by them: a
part of one that is another one's speaks of that. A contrast of sites, which the layer does not hold, changed
a sixth of what flicker left of the tails of means."""


class Borne(NamedTuple):
    """What a mechanism does to the statistics of one family in one place: their mismatch without and with it,
    nats, those that are of its part, those of them that it speaks for whatever others do, and the weight of
    each in the part: the share of the mismatch that changes with it, for what it hardly changes speaks of
    something else, named or not."""

    judged: Judgement
    before: Float[np.ndarray, "k"]
    after: Float[np.ndarray, "k"]
    own: Bool[np.ndarray, "k"]
    claimed: Bool[np.ndarray, "k"]
    weight: Float[np.ndarray, "k"]

    @property
    def at(self) -> tuple[str, str]:
        """Family and place."""
        return self.judged.family, self.judged.where

    @property
    def place(self) -> tuple[str, str]:
        """The recording, and whether it is of what stays or of what is redrawn."""
        return self.judged.where, FAMILIES[self.judged.family].part

    @property
    def change(self) -> Float[np.ndarray, "k"]:
        """Nats by which it changes the mismatch."""
        return np.abs(self.before - self.after)


class Alone(NamedTuple):
    """The share of one family in a mechanism's part: nats without and with it, and what still differs."""

    family: str
    before: float
    after: float
    left: list[tuple[Judgement, np.ndarray]]

    @property
    def stays(self) -> bool:
        """Whether it is of what stays from frame to frame."""
        return FAMILIES[self.family].part == STATIC


class Part(NamedTuple):
    """A mechanism's own part of the mismatch: nats without and with it beyond what chance leaves, of how many
    statistics, those that still differ, whether all together leave more than chance, what share of it is of
    what stays, and every family by itself. weight: how many statistics it changes altogether, counted by the
    share of each that changes."""

    before: float
    after: float
    number: int
    left: list[tuple[Judgement, np.ndarray]]
    more: bool
    static: float
    alone: tuple[Alone, ...] = ()
    weight: float = 1.0

    @property
    def tells(self) -> bool:
        """Whether it is enough to judge the mechanism by."""
        return self.weight >= _TELLS


def borne_by(
    full: Compared,
    less: Compared,
    speaks_for: frozenset[str] = frozenset(),
    whole_frames: bool = False,
    blinking: bool = False,
) -> list[Borne]:
    """The statistics that a mechanism moves, of a simulator with it and one without, and all that stays and
    differs in recordings of the kinds that it speaks for. whole_frames: whether it moves all pixels of a
    frame alike, so that the shape of their noise tells nothing but the few numbers that were drawn. blinking:
    whether it says how pixels move, and not about which level."""
    without = {(j.family, j.where): j for j in less.judgements}
    out = []
    for j in full.judgements:
        other = without.get((j.family, j.where))
        if other is None or j.where not in full.seen or other.z.shape != j.z.shape:
            continue
        one = mismatch(other, less.recorded[j.where].families[j.family])
        two = mismatch(j, full.recorded[j.where].families[j.family])
        # Where the simulator's own units scatter more than independent ones, the nats weigh less.
        weight = np.clip(0.5 * j.z**2 / np.maximum(two, 1e-9), 0.0, 1.0) * (two > 1) + (two <= 1)
        one, two = weight * one, weight * two
        own, claimed = _moved(one, two), np.zeros(one.shape, bool)
        if full.recorded[j.where].coarse or whole_frames:
            own &= ~_of_shape(j.family, one.size)
        if full.seen[j.where].kind in speaks_for and FAMILIES[j.family].part == STATIC:
            claimed = one > _BEARS
        share = np.where(own & ~claimed, share_of(one, two), 1.0)
        if blinking:
            own &= FAMILIES[j.family].time == TEMPORAL
        if full.recorded[j.where].families[j.family].law == "energy":
            own |= _broken(own, full.seen[j.where].size)
        out.append(Borne(j, one, two, own | claimed, claimed, share))
    return out


def share_of(before: Float[np.ndarray, "k"], after: Float[np.ndarray, "k"]) -> Float[np.ndarray, "k"]:
    """Share of the larger mismatch of every statistic that changes with a mechanism."""
    return np.abs(before - after) / np.maximum(np.maximum(before, after), 1e-9)


def most_of(each: Sequence[list[Borne]]) -> dict[tuple[str, str], Float[np.ndarray, "k"]]:
    """The largest change that any mechanism makes to every statistic."""
    out: dict[tuple[str, str], np.ndarray] = {}
    for borne in each:
        for b in borne:
            known = out.get(b.at)
            if known is None or known.shape == b.change.shape:
                out[b.at] = b.change if known is None else np.maximum(known, b.change)
    return out


def owned(each: list[Borne], most: dict[tuple[str, str], Float[np.ndarray, "k"]]) -> list[Borne]:
    """Without the statistics on which another mechanism bears far more."""
    return [
        b._replace(own=b.own & (b.claimed | (np.maximum(b.change, _BEARS) >= _OWNED * most[b.at])))
        if most[b.at].shape == b.change.shape
        else b
        for b in each
    ]


def most_at(every: Iterable[list[Borne]]) -> dict[tuple[str, str], float]:
    """The most nats that any mechanism moves in every recording, of what stays and of what is redrawn."""
    out: dict[tuple[str, str], float] = {}
    for each in every:
        for at, nats in moved_at(each).items():
            out[at] = max(out.get(at, 0.0), nats)
    return out


def at_home(each: list[Borne], largest: dict[tuple[str, str], float]) -> list[Borne]:
    """Only the recordings in which no other mechanism moves more, of what stays and of what is redrawn each;
    all, where there are none of either in which it moves much. largest: see `most_at`.

    What differs where another one is far stronger speaks of that: hot pixels and dark current fill the maps
    of long darks, offsets of pixels are told by the short ones."""
    mine = moved_at(each)
    home = {at for at, nats in mine.items() if nats >= largest.get(at, 0.0)}
    told = {
        part for _, part in home if sum(n for at, n in mine.items() if at in home and at[1] == part) > _MUCH
    }

    def kept(b: Borne) -> bool:
        return not told or b.place in home

    return but_for(each, kept)


def but_for(each: Sequence[Borne], kept: Callable[[Borne], bool]) -> list[Borne]:
    """Without what is not kept, but for what a mechanism speaks for whatever others do."""
    return [b if kept(b) else b._replace(own=b.own & b.claimed) for b in each]


TRACE = 0.05
"""Of the nats that a stronger mechanism changes: less that another one moves may be its trace, or off by the
rest of it. Blocks that jump, clouds and columns that wander, without a name, left 0.0002 to 0.016 of theirs
to sinusoids, columns and dark current. Many hot pixels moved 2,211 nats of what stays and left 107; a pattern
of all pixels beside them, of 7,600 nats of its own evidence, moved 32, and 17 of them seemed left."""


def overshadowed(each: list[Borne], largest: dict[tuple[str, str], float]) -> bool:
    """Whether in every recording another mechanism moves so much more that what is left of the part of this
    one speaks of that. largest: see `most_at`."""
    mine = moved_at(each)
    return all(nats < TRACE * largest.get(at, 0.0) for at, nats in mine.items())


def clear_of(each: list[Borne], larger: Mapping[tuple[str, str], float]) -> list[Borne]:
    """Only the recordings in which a mechanism moves more than what may be a trace of others. larger: nats
    that those move, see `moved_at`."""
    clear = {at for at, nats in moved_at(each).items() if nats >= TRACE * larger.get(at, 0.0)}
    return but_for(each, lambda b: b.place in clear)


def moved_at(each: list[Borne]) -> dict[tuple[str, str], float]:
    """Nats that a mechanism moves in every recording, of what stays and of what is redrawn."""
    out: dict[tuple[str, str], float] = {}
    for b in each:
        out[b.place] = out.get(b.place, 0.0) + float(b.change[b.own].sum())
    return out


def own_part(each: list[Borne]) -> Part:
    """A mechanism's part, summed."""
    before = sum(float((b.weight * b.before)[b.own].sum()) for b in each)
    after = sum(float((b.weight * b.after)[b.own].sum()) for b in each)
    weight = sum(float(b.weight[b.own].sum()) for b in each)
    number = sum(int(b.own.sum()) for b in each)
    left_over = sum(float(b.after[b.own].sum()) for b in each)
    left = [
        (b.judged, found)
        for b in each
        if (found := np.flatnonzero(b.own & (np.abs(b.judged.z) > b.judged.passing))).size
    ]
    # Twice the nats of two equal normal laws are chi-squared.
    more = number > 0 and float(stats.chi2.sf(2 * left_over, number)) < _CHANCE
    stays = sum(
        float((b.weight * b.before)[b.own].sum()) for b in each if FAMILIES[b.judged.family].part == STATIC
    )
    static = stays / before if before > 0 else 0.0
    return Part(
        max(before - 0.5 * weight, 0.0), max(after - 0.5 * weight, 0.0), number, left, more, static,
        tuple(_alone(family, each, left) for family in dict.fromkeys(b.judged.family for b in each)), weight,
    )  # fmt: skip


def _alone(family: str, each: list[Borne], left: list[tuple[Judgement, np.ndarray]]) -> Alone:
    mine = [b for b in each if b.judged.family == family]
    before, after = (
        sum(float((b.weight * (nats - 0.5))[b.own].sum()) for b, nats in zip(mine, values, strict=True))
        for values in ([b.before for b in mine], [b.after for b in mine])
    )
    return Alone(family, max(before, 0.0), max(after, 0.0), [f for f in left if f[0].family == family])


def drawn_structures(each: Sequence[Borne]) -> list[tuple[Borne, Bool[np.ndarray, "k"]]]:
    """The energies of what is redrawn that come nearer with the mechanism."""
    mine = [(b, b.own & (b.before > b.after)) for b in each if b.judged.family == of(TEMPORAL, STRUCTURE)]
    return [(b, cells) for b, cells in mine if cells.any()]


def _of_shape(family: str, number: int) -> Bool[np.ndarray, "k"]:
    """Statistics of the shape of the noise. Below a code they follow where the level lies between two codes,
    to a hundredth of one."""
    name = FAMILIES[family].name
    if name == MOMENTS:
        return np.arange(number) >= number // 3
    return np.full(number, name in (TAILS, UNSTEADY, IN_ONE_FRAME, LEVELS))


def _moved(one: Float[np.ndarray, "k"], two: Float[np.ndarray, "k"]) -> Bool[np.ndarray, "k"]:
    change = np.abs(one - two)
    return (change > _BEARS) & (change > _CLEAR * np.maximum(one, two))


def _broken(own: Bool[np.ndarray, "k"], size: tuple[int, int]) -> Bool[np.ndarray, "k"]:
    """Parts of the lines, from an eighth of the frame on, whose means over the whole frame are among these
    energies: a name for whole lines has to say why they are not whole."""
    cells = own.reshape(bank.counts(size).shape)
    rows, columns = ([s.length >= n / 8 for s in bank.scales(bank.cropped_side(n) // 2)] for n in size)
    out = np.zeros_like(cells)
    out[:, :, columns] |= cells[:, :, -1:]
    out[:, rows, :] |= cells[:, -1:, :]
    return out.ravel()


def mismatch(j: Judgement, family: Statistics) -> Float[np.ndarray, "k"]:
    """Nats between the recorded and the simulated value of every statistic, see `compare.table`."""
    a, b, units = j.recorded, j.simulated, len(family.values)
    if family.law == "energy":
        ratio = np.where(family.size > 0, np.maximum(a, 1e-9) / np.maximum(b, 1e-9), 1.0)
        return units * family.size / 2 * (ratio - 1 - np.log(ratio))
    if family.law == "count":
        return a * np.log(np.maximum(a, 0.5) / np.maximum(b, 0.5)) - a + b
    return np.minimum(units * (a - b) ** 2 / np.maximum(family.size, 1e-30), 2 * FARTHEST**2) / 2
