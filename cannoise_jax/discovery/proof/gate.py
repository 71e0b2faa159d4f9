"""Gate: what enters the simulator that is handed back, judged on the frames held back by draws.

The findings enter unless they make the draws worse; where they do, those that the held-back frames confirm
are tried alone, and then one by one. Findings at whose strength these frames are told no better than without
go again, unless the draws are then worse. What no name explains enters, as the remainder, where it makes the
draws better: beside all of these findings, in place of those that nothing describes well, or beside the
fitted baseline alone. It goes again where the layer that knows no names then finds more that differs than
before, and so do findings without a name; where nothing that is left is surely nearer, all of it does. So the
simulator that is handed back is no worse than the one that was given, or the report says so first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cannoise_jax.discovery.proof.gains import frame_interval
from cannoise_jax.discovery.proof.heldout import Scored
from cannoise_jax.discovery.proof.prove import Proof, Proofs
from cannoise_jax.discovery.proof.quality import (
    NAMED,
    NAMED_ALONE,
    NAMED_WITH_REST,
    PLAIN,
    REST_ALONE,
    STANDING,
    SURE,
    WELL_WITH_REST,
    WITH_REST,
    Looked,
    Panel,
)
from cannoise_jax.discovery.proof.sides import Sides, of_model
from cannoise_jax.discovery.proof.tried import LEAST_GAIN, Gain, Tried
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.signatures.fields import stratum

OF_GAIN, OF_LITTLE, LITTLE = 0.01, 0.1, 1e-3
"""Share of what the findings gain in the composite score that the remainder beside them may cost, where the
draws come nearer by all that a classifier sees: a hundredth, and a tenth of what is below so many nats a
pixel. Beside the findings of a CMOS camera of less than a code of noise, 0.0047 nats a pixel, it cost 0.0003
and took 0.096 off the two-sample area."""


WORTH_ALL = 0.1
"""By how much the two-sample area has to fall for all findings to be given up: what can be understood, drawn
anew for another unit and taken to other settings is worth that much."""


BY_CHANCE = 0.01
"""Chance by which the area alone may let the remainder in: it is tried where the recordings are told from the
draws, which one null in twenty is by chance, and whatever is drawn next is then nearer."""


_MOST_ALONE = 8
"""Findings that are tried one by one: each is drawn for it, which takes seconds."""


_FAR_NEARER = 0.2
"""Fall of the two-sample area by which a remainder stays though a kind of difference is made by it. Of living
cells it took a third off, and rows differed in how loud they were; of columns that lost their own noise 0.09.
"""


_FARTHER_WITHOUT = 0.03
"""Rise of the two-sample area, sure or not, by which findings that gain nothing stay beside those that do. A
camera was told from draws by 0.07 more without two of its 23; of one with a false flicker the area fell."""


FARTHER = 0.01
"""By how much the two-sample area may rise with the remainder, however sure: what one gain setting gains must
not be at the cost of another."""


Tell = Callable[[str], None]


class Gated(NamedTuple):
    """The simulator that is handed back, its measures and those of the one that was judged, the findings that
    are in it, the candidates, and whether the remainder is in it; spare: the same without the remainder."""

    model: SensorModel
    before: Looked
    after: Looked
    steps: tuple[Step, ...]
    tried: tuple[Tried, ...]
    remainder: bool
    spare: Gated | None = None

    @property
    def without_remainder(self) -> Gated:
        """The simulator before the remainder was added, which was tried and did not enter."""
        if self.spare is None:
            return self
        late = self.tried[len(self.spare.tried) :]
        return self.spare._replace(tried=(*self.spare.tried, *(t._replace(entered=False) for t in late)))

    @property
    def far_nearer(self) -> bool:
        """Whether the remainder took so much off the two-sample area that it may leave other things worse."""
        late = self.tried[len(self.spare.tried) :] if self.spare is not None else ()
        return any(t.entered and t.area is not None and t.area.value < -_FAR_NEARER for t in late)

    @property
    def helps(self) -> bool:
        """Whether anything that entered is surely nearer to the recordings."""
        return any(t.entered and t.better for t in self.tried)

    @property
    def surely(self) -> bool:
        """Whether something that entered is surely nearer by the composite score and by the area, both."""
        return any(t.entered and t.scored and t.nearer for t in self.tried)

    def with_only(self, steps: tuple[Step, ...], model: SensorModel, looked: Looked, panel: Panel) -> Gated:
        """With some of the findings in place of all that entered; of none it is the simulator that was
        judged."""
        tried = tuple(t._replace(entered=False) for t in self.tried)
        if steps:
            tried = (*tried, _tried("findings with a name", steps, panel, self.before, looked))
        return Gated(model, self.before, looked, steps, tried, False)


def gate(
    panel: Panel, sides: Sides, steps: tuple[Step, ...], proofs: Proofs, tell: Tell = lambda text: None
) -> Gated:
    """Which findings enter.

    A simulator that is no camera model keeps its own draws, changed by all findings; the camera model that is
    handed back for it is not gated.
    """
    before = panel.look(sides.plain, PLAIN)
    if sides.model is None:
        after = before if sides.extended is None else panel.look(sides.extended, NAMED)
        once = () if after is before else (_tried("findings", steps, panel, before, after),)
        return Gated(sides.exported, before, after, steps, once, False)
    model, after = sides.model, before
    kept: tuple[Step, ...] = ()
    all_tried: list[Tried] = []
    told = tuple(zip(steps, proofs.each, strict=True))
    standing = tuple(s for s, p in told if not p.loses)
    sure = tuple(s for s, p in told if p.confirmed)
    for what, some, number in (
        ("findings", steps, NAMED),
        ("findings that gain", standing, STANDING),
        ("confirmed findings", sure, SURE),
    ):
        done = {t.steps for t in all_tried}  # each is a part of the one before
        if not (some or sides.lowered) or len(some) in done or (number == SURE and after is not before):
            continue
        tell(f"gate: {what}")
        candidate = sides.level(sides.of(some))
        looked = panel.look(of_model(candidate), number)
        tried = _tried(what, some, panel, before, looked)
        than = _tried(what, some, panel, after, looked)
        farther = after is not before and _farther(than, _FARTHER_WITHOUT)
        enters = not tried.worse and not (than.worse or farther)
        all_tried = [t._replace(entered=t.entered and not enters) for t in all_tried]
        all_tried.append(tried._replace(entered=enters))
        if enters:
            model, after, kept = candidate, looked, some
    if not kept and len(sure) > 1:
        tell("gate: findings one by one")
        model, after, kept = _one_by_one(panel, sides, told, model, before)
        if kept:
            all_tried.append(_tried("findings one by one", kept, panel, before, after))
    return Gated(model, before, after, kept, tuple(all_tried), False)


def _one_by_one(
    panel: Panel, sides: Sides, told: Sequence[tuple[Step, Proof]], model: SensorModel, before: Looked
) -> tuple[SensorModel, Looked, tuple[Step, ...]]:
    """The confirmed findings that make the draws better beside those let in before them, the ones that gain
    most first: one that is wrong does not take the others along."""
    after, kept = before, tuple[Step, ...]()
    sure = sorted((t for t in told if t[1].confirmed), key=lambda t: -(t[1].gain or 0.0))
    for step, _ in sure[:_MOST_ALONE]:
        some = tuple(s for s, _ in told if s is step or any(s is k for k in kept))
        candidate = sides.level(sides.of(some))
        looked = panel.look(of_model(candidate), SURE)
        # Where all together are worse, each has to show by itself what it is worth.
        if _tried("", some, panel, after, looked).better:
            model, after, kept = candidate, looked, some
    return model, after, kept


def remaining(
    gated: Gated,
    panel: Panel,
    sides: Sides,
    *,
    described: tuple[Step, ...],
    sure: tuple[Step, ...],
    with_rest: Callable[[SensorModel], SensorModel],
    tell: Tell = lambda text: None,
) -> Gated:
    """With the remainder where it helps. described: findings that account for most of what they bear on;
    sure: those with a name against which nothing speaks; with_rest: adds what the frames that look show
    beyond a camera model."""
    if sides.model is None:
        return gated
    if sure and not gated.steps:
        gated = _named_alone(gated, panel, sides, sure)
    spare, well, named = gated, _those(gated.steps, described), _those(gated.steps, sure)
    # Findings that describe badly what they describe keep the remainder from describing it: it is tried in
    # their place too, and beside the fitted baseline, which also has nothing too much. Findings are what can
    # be understood: they are given up only where the recordings are told less well without them, and less
    # well than with the remainder beside them; all of them only where much less well.
    beside: tuple[SensorModel, Looked, Tried] | None = None
    last: int | None = None
    for what, some, number in (
        ("remainder", gated.steps, WITH_REST),
        ("remainder in place of what nothing describes well", well, WELL_WITH_REST),
        ("remainder in place of findings without a name", named, NAMED_WITH_REST),
        ("remainder beside the baseline", (), REST_ALONE),
    ):
        if last is not None and (len(some) == last or not _told(panel, gated.after)):
            continue
        last = len(some)
        base = spare.model if number == WITH_REST else sides.level(sides.of(some) if some else sides.bare)
        candidate = with_rest(base)
        if candidate is base:
            continue
        tell(f"remainder: draws with the {what}")
        looked = panel.look(of_model(candidate), number)
        tried = _tried(what, some, panel, gated.after, looked)
        if some:
            gained = _gained(spare)
            least = max(LEAST_GAIN, OF_GAIN * gained, min(OF_LITTLE * gained, LITTLE))
            tried = tried._replace(least=least)
        nearer = tried.nearer or (len(some) == len(gated.steps) and not _farther(tried))
        enters = tried.better and nearer and (tried.scored or _surely(tried))
        if gated.steps and not some:
            enters = enters and _worth_all(tried)
        tried = tried._replace(entered=enters)
        if number == WITH_REST and not enters and not tried.worse:
            beside = candidate, looked, tried
        instead = False
        if enters and beside is not None:
            than = _tried(what, some, panel, beside[1], looked)
            instead = not (than.nearer if some else _worth_all(than))
        every = (*gated.tried, tried._replace(entered=False) if instead else tried)
        if instead and beside is not None:
            candidate, looked, tried = beside
            some, every = spare.steps, tuple(t._replace(entered=True) if t is tried else t for t in every)
        gated = gated._replace(tried=every)
        if enters:
            gated = gated._replace(model=candidate, after=looked, steps=some, remainder=True, spare=spare)
    return gated


def _worth_all(tried: Tried) -> bool:
    return tried.area is not None and tried.area.value < -WORTH_ALL


def _surely(tried: Tried) -> bool:
    return tried.area is not None and tried.area.below(BY_CHANCE)


def _farther(tried: Tried, by: float = FARTHER) -> bool:
    return tried.area is not None and tried.area.value > by


def _named_alone(gated: Gated, panel: Panel, sides: Sides, sure: tuple[Step, ...]) -> Gated:
    """With the findings whose names hold, where all findings together made the draws worse."""
    model = sides.level(sides.of(sure))
    looked = panel.look(of_model(model), NAMED_ALONE)
    found = gated.with_only(sure, model, looked, panel)
    last = found.tried[-1]
    return found if last.better else gated._replace(tried=(*gated.tried, last._replace(entered=False)))


def _those(steps: Sequence[Step], chosen: Sequence[Step]) -> tuple[Step, ...]:
    return tuple(s for s in steps if any(s is c for c in chosen))


def sure_of(steps: Sequence[Step], against: Sequence[Doubt | None]) -> tuple[Step, ...]:
    """The steps with a name against which nothing speaks."""
    told = zip(steps, against, strict=True)
    return tuple(s for s, doubt in told if doubt is None and s.named.mechanism != UNKNOWN)


def lesser(
    gated: Gated,
    panel: Panel | None,
    sides: Sides,
    against: Sequence[Doubt | None],
    steps: Sequence[Step],
) -> Iterator[Gated]:
    """What may be handed back in place of a simulator from which the recordings differ by more than from the
    one that was judged: without the remainder, without findings against whose name something speaks, and,
    where nothing in it is surely nearer, as it was judged."""
    if gated.remainder:
        gated = gated.without_remainder
        yield gated
    if panel is None or sides.model is None:
        return
    sure = _those(gated.steps, sure_of(steps, against))
    if sure and len(sure) < len(gated.steps):
        model = sides.level(sides.of(sure))
        gated = gated.with_only(sure, model, panel.look(of_model(model), NAMED), panel)
        yield gated
    if not gated.helps:
        yield gated.with_only((), sides.model, gated.before, panel)


def _gained(gated: Gated) -> float:
    """What the findings that entered gained in the composite score, nats a pixel."""
    return sum(t.score.value for t in gated.tried if t.entered and t.score is not None)


def _told(panel: Panel, looked: Looked) -> bool:
    """Whether the recordings may still be told from the draws: else nothing better is looked for."""
    areas = panel.areas([looked])
    return areas is None or areas[0].low > 0.5


def _tried(what: str, steps: tuple[Step, ...], panel: Panel, before: Looked, after: Looked) -> Tried:
    """The measures of one candidate. Of two that the recordings are told from by chance alone, neither is
    nearer."""
    change = panel.change(before, after) if _told(panel, before) or _told(panel, after) else None
    return Tried(what, len(steps), score_gain(panel, before, after), change, True)


def score_gain(panel: Panel, before: Looked, after: Looked) -> Gain | None:
    """Composite score of one simulator less that of another, nats a pixel, from the scatter over frames."""
    one, two = before.side.composite, after.side.composite
    if one is None or two is None:
        return None
    fields = panel.halves[1].fields
    alike = np.concatenate([np.full(f.frames, stratum(f)) for f in fields])
    pixels = np.concatenate([np.full(f.frames, f.mean.size) for f in fields])
    total = float(pixels.sum())
    gain = frame_interval(Scored(two * pixels, alike, pixels), Scored(one * pixels, alike, pixels))
    return Gain(*(v / total for v in gain))
