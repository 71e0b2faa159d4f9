"""Adequacy: whether a name accounts for its own part of the mismatch, or merely comes nearest.

Every accepted mechanism is left out of the extended simulator in turn, and both are drawn from. Its own part
are the statistics of the layer that knows no names on which it bears: those that it brings nearer to the
recordings or takes further away, unless another accepted mechanism bears on them far more: what is left
of those speaks of that one. What the full simulator leaves of their mismatch, in nats, is what speaks against
the name: a mechanism that is there leaves next to nothing in its own part, one that only resembles what is
there leaves a good part of it, or more than there was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import count
from types import MappingProxyType

import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.compared import Compared
from cannoise_jax.discovery.compare.families import SPARSITY, TEMPORAL, of
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import Source, modelled, shaded
from cannoise_jax.discovery.compare.table import differences, lines_of
from cannoise_jax.discovery.proof.along_lines import pixels_alike
from cannoise_jax.discovery.proof.check import frames_for_names
from cannoise_jax.discovery.proof.claims import (
    by_level,
    empty,
    forgetful,
    lasting,
    two_levels,
    whatever_exposure,
)
from cannoise_jax.discovery.proof.gate import Gated
from cannoise_jax.discovery.proof.gaussian import not_gaussian
from cannoise_jax.discovery.proof.one_sided import one_sided
from cannoise_jax.discovery.proof.own_part import (
    Borne,
    at_home,
    borne_by,
    drawn_structures,
    most_at,
    most_of,
    overshadowed,
    own_part,
    owned,
)
from cannoise_jax.discovery.proof.shadow import (
    LEFT_TOGETHER,
    SLACK,
    outshines,
    outweighs,
    shadowed,
    undrawn,
)
from cannoise_jax.discovery.proof.shared_noise import shared, shared_lines, shared_map
from cannoise_jax.discovery.proof.single_waves import one_of_many
from cannoise_jax.discovery.proof.white_maps import gathered, noisy_again, patterned, ranged
from cannoise_jax.discovery.proof.whole_codes import codes_to_converters, in_few_lines
from cannoise_jax.discovery.proof.whole_lines import in_parts
from cannoise_jax.discovery.proof.whole_scans import in_places
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.discovery.search.steps import Fitted, Step
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_draws import closed_moments
from cannoise_jax.physics.core.settings import DEFAULT, Settings
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures import bank
from cannoise_jax.signatures.signature import BLINKING

LEFT = 0.03
"""Share of the mismatch of its own part, in nats, that a name may leave. Row noise, 1/f rows, maps, hot
pixels, tails of two laws, dark current and glow leave 0 to 0.018, telegraph pixels of two levels up to 0.05
of few; an offset that jumps along the raster leaves 0.04 to 0.075 as 1/f noise, noise that grows along the
frame or at its edges 0.065 to 0.12 as pixels of more noise, a wave of changing pitch 0.11 as 1/f rows."""
LEFT_STATIC = 0.1
"""The same of a part that stays: a blur of another form than crosstalk leaves 0.07."""
_SLACK_OF_SCENES = 50.0
"""The same of a name that speaks for all that stays in scenes: references softened so little that they cost
400 nats leave up to 75."""
LEFT_OF_WEAK = 0.25
"""Share beyond which that is no excuse."""
LEFT_OF_SCENES = 0.1
"""The same of a name that speaks for all that stays in scenes, whose filter is fitted freely. References
shifted by 0.1 to 0.8 pixels of a colour, softened or sharpened leave 0 to 5 % of it; a wide halo, which is a
blur as well, 5 to 6 %; a trail along the rows 1 to 19 %, the more the more detail the scene has."""
LEFT_ALONE = 0.15
"""Share of its part in one family that a name may leave."""
_MATTERS = 0.02
"""Share of a name's whole part from which on it matters what one family leaves. Beside a flicker of 2.5
million nats, and hot pixels and dark current of 100,000 and more, what other findings left in tails, levels
and codes was 0.00004 to 0.008."""
_UNEVEN = 4.5
"""Standard deviations from which on structures count as stronger in few places than noise is."""
_FEW_PLACES = -0.2
"""And by how much: the logarithm of a typical square against the mean square. Single steps across frames
of 96 x 128 pixels had -0.23 and -0.78, odd against even columns and dark current within 0.01 of zero, sixty
bursts a frame -0.05."""
_FEW_TIMES = "it is strong in few places or frames, not in all alike"


def doubts(
    capture: CaptureSet,
    splits: list[tuple[list[int], list[int]]],
    steps: tuple[Step, ...],
    of: Callable[..., SensorModel],
    *,
    key: Key[Array, ""],
    alpha: float,
    confirmed: Sequence[bool],
    tell: Callable[[str], None] = lambda text: None,
    shades: Mapping[int, np.ndarray] = MappingProxyType({}),
) -> tuple[Doubt | None, ...]:
    """What speaks against the name of each step, on all frames; None: nothing does, or it has none.

    of: the camera model with some of the steps, and one of them `silent` where asked, see
    `model.extended_model`. alpha: chance that something is said against a true one. confirmed: whether the
    frames held back show each step. shades: as `sources.shaded` has them.
    """
    named = [n for n, s in enumerate(steps) if s.named.mechanism != UNKNOWN]
    out: list[Doubt | None] = [None] * len(steps)
    if not named:
        return tuple(out)
    chosen = frames_for_names(capture, splits)
    frames = [shown for _, shown in chosen]
    model, plain, every = of(steps), of(()), list(range(len(steps)))

    @cache
    def silenced(n: int) -> SensorModel:
        return of((steps[n],), silent=steps[n])

    def held(n: int) -> bool:
        return len(silenced(n).mechanisms) > len(plain.mechanisms)

    # What a camera model holds, as a blur by crosstalk, is in its draws.
    speaks = [s.named.signature.off is not None for s in steps]
    off = [_off(s, n) if speaks[n] and not held(n) else {} for n, s in enumerate(steps)]

    def drawn_from(model: SensorModel, names: Sequence[int]) -> Compared:
        source = beside(shaded(modelled(model, key), shades), [o for n in names if (o := off[n])], capture)
        return compare_bank(capture, source, alpha=alpha, held_back=chosen, sets=2)

    full, start = drawn_from(model, every), drawn_from(plain, ())
    # Where all names together make it worse, each has to show by itself what it is worth.
    alone = _found(full) > _found(start)

    asked = count(1)

    def bears(n: int) -> tuple[Compared, list[Borne], frozenset[str]] | None:
        still = not held(n)
        if still and not off[n]:
            return None  # of the capture or the bookkeeping: it is not drawn
        tell(f"adequacy: {steps[n].named.mechanism}, {next(asked)} of {len(steps)}")
        others = [k for k in every if k != n]
        claimed = steps[n].named.signature.speaks_for if speaks[n] and (alone or still) else frozenset[str]()
        if alone:
            one, without = drawn_from(of((steps[n],)), (n,)), start
        elif still:
            one, without = full, drawn_from(model, others)
        else:
            # At strength zero where that is none at all: a program of these mechanisms is compiled already.
            if _nothing(silenced(n), plain, capture.recordings[0].size):
                less = of(steps, silent=steps[n])
            else:
                less = of(tuple(s for s in steps if s is not steps[n]))
            one, without = full, drawn_from(less, others)
        axes = steps[n].named.signature.axes
        whole, blinking = axes.varies_over == "frame", axes.time == BLINKING.time
        return one, borne_by(one, without, claimed, whole, blinking), claimed

    borne = {n: found for n in named if (found := bears(n)) is not None}
    most = most_of([each for _, each, _ in borne.values()])
    converters = {n for n in borne if steps[n].named.signature.axes.enters == "converter"}
    owned_by = codes_to_converters({n: owned(each, most) for n, (_, each, _) in borne.items()}, converters)
    largest = most_at(owned_by.values())
    mine = {n: at_home(each, largest) for n, each in owned_by.items()}
    for n, (one, each, claimed) in borne.items():
        # How a structure is spread was fitted on no frame.
        own = mine[n]
        dark = confirmed[n] and overshadowed(owned_by[n], largest)
        out[n] = (
            (None if dark else doubt(one, own, claimed, steps[n].named.signature.form_free))
            or empty(one, each, steps[n])
            or patterned(steps[n])
            or gathered(steps[n])
            or ranged(steps[n])
            or lasting(steps[n])
            or by_level(steps[n])
            or whatever_exposure(steps[n])
            or noisy_again(steps[n])
            or shared_map(steps[n])
            or shared_lines(steps[n])
            or in_parts(steps[n])
            or pixels_alike(steps[n])
            or in_places(steps[n])
            or in_few_lines(steps[n], capture, frames)
            or not_gaussian(steps, n)
            or shared(steps[n])
            or one_sided(steps, n)
            or one_of_many(steps, n, full)
            or (two_levels(one) if steps[n].named.signature.axes.time == BLINKING.time else None)
            or (
                None
                if steps[n].named.signature.frozen
                else forgetful(one, own) or _spread(steps[n], full, own)
            )
        )
    unknown = [n for n in every if n not in named or out[n] is not None]
    for n in named:
        if n not in borne:
            few = in_few_lines(steps[n], capture, frames)
            out[n] = few or undrawn(steps[n], [steps[k] for k in unknown])
    left = [n for n in borne if out[n] is None]
    if unknown and left:
        # What has no name leaves traces that look like others: what it moves more is no evidence for them.
        theirs = {n: found[1] for n in unknown if (found := borne.get(n) or bears(n)) is not None}
        every_one = most_of(list(theirs.values()))
        for n in left:
            if confirmed[n] and outshines(steps[n], [steps[k] for k in unknown]):
                continue
            larger = [k for k in unknown if outweighs(steps[k], steps[n])]
            of_its_own = confirmed[n] and not larger
            moved = most_at([theirs[k] for k in larger if k in theirs])
            out[n] = shadowed(mine[n], every_one, of_its_own, moved)
    return tuple(out)


def _off(step: Step, n: int) -> dict[int, np.ndarray]:
    """What a step that no camera model holds says that the references are off by, DN, by recording."""
    signature, named = step.named.signature, step.named
    if signature.off is None or named.mechanism == UNKNOWN:
        return {}
    return signature.off(step.before, named.score, np.random.default_rng(n))


def beside(source: Source, off: Sequence[dict[int, np.ndarray]], capture: CaptureSet) -> Source:
    """The source with the light of the scenes changed by what the references are off by, DN."""
    if not off:
        return source

    def frames(number_of_set: int, number: int, clean, settings: Settings):
        r = capture.recordings[number]
        span = min(float(r.white_level), 65535.0) - float(np.mean(r.black_level))
        more = sum(o[number] for o in off if number in o) / span
        return source.frames(number_of_set, number, np.asarray(clean + more, np.float32), settings)

    return source._replace(frames=frames)


def described(steps: Sequence[Step], against: Sequence[Doubt | None]) -> tuple[Step, ...]:
    """The steps that describe what they bear on, under whatever name."""
    return tuple(s for s, d in zip(steps, against, strict=True) if d is None or d.left <= LEFT_OF_WEAK)


def withdrawn(fitted: Fitted, gated: Gated, against: Sequence[Doubt | None]) -> tuple[Fitted, Gated]:
    """Both without the names that something speaks against; what was found stays in the simulator."""
    steps = tuple(
        s if doubt is None else s._replace(named=s.named.withdrawn(doubt))
        for s, doubt in zip(fitted.steps, against, strict=True)
    )
    same = {id(old): new for old, new in zip(fitted.steps, steps, strict=True)}
    return fitted._replace(steps=steps), gated._replace(steps=tuple(same[id(s)] for s in gated.steps))


def _found(compared: Compared) -> float:
    """Nats of all that differs."""
    return sum(d.nats for d in differences(compared))


def _nothing(one: SensorModel, plain: SensorModel, size: tuple[int, int]) -> bool:
    """Whether a camera model with one mechanism of strength zero beside those of another is, in closed form,
    what it is without it; False where the mechanism has none: it may round, or move pixels, at any strength.
    """
    if any(f.record.effect is None and f.record.baseline is None for f in one.mechanisms):
        return False
    bare = dataclasses.replace(one, mechanisms=plain.mechanisms)
    for level in (0.0, 0.4):
        clean = np.full(size, level, np.float32)
        told = [closed_moments(m, clean, DEFAULT) for m in (one, bare)]
        if not all(np.allclose(a, b, rtol=1e-3, atol=1e-3) for a, b in zip(*told, strict=True)):
            return False
    return True


def doubt(
    full: Compared, each: list[Borne], speaks_for: frozenset[str] = frozenset(), free: bool = False
) -> Doubt | None:
    """What the simulator with a mechanism leaves of that mechanism's part of the mismatch, see `borne_by`;
    None where nothing significant is left or it is little. free: whether its form is known but roughly."""
    part = own_part(each)
    if not (part.left or part.more) or not part.tells:
        return None
    if speaks_for:
        most = LEFT_OF_SCENES * part.before + _SLACK_OF_SCENES
    elif not part.left:
        most = LEFT_TOGETHER * part.before + SLACK
    else:
        share = LEFT_OF_WEAK if free else LEFT + (LEFT_STATIC - LEFT) * part.static
        most = min(share * part.before + SLACK, LEFT_OF_WEAK * part.before)
    share = part.after / max(part.before, 1e-9)
    if part.after > most:
        return Doubt(share, tuple(lines_of(full, part.left)[:3]))
    if speaks_for or free:
        return None
    # What one family says of the form is not outweighed by how much another says of the size. Of what is
    # redrawn a fixed map holds what happens to be left in a mean.
    told = [f for f in part.alone if f.left and not (f.stays and part.static < LEFT_TOGETHER)]
    least = _MATTERS * part.before
    against = [f for f in told if f.after > max(LEFT_ALONE * f.before + SLACK, least)]
    if not against:
        return None
    worst = max(against, key=lambda f: f.after)
    said = f"a simulator with it still differs in {', '.join(lines_of(full, worst.left)[:3])}"
    return Doubt(share, (said,), instead=True)


def _spread(step: Step, whole: Compared, each: list[Borne]) -> Doubt | None:
    """See `uneven`; single events of any form are strong where they are."""
    return None if step.named.signature.rare and step.named.signature.form_free else uneven(whole, each)


def uneven(whole: Compared, each: list[Borne]) -> Doubt | None:
    """What speaks against a name whose structures are strong in few places or frames, where the mechanism is
    everywhere: a tear, a burst or a flash has the same mean energies as noise along rows."""
    by = {(j.family, j.where): j for j in whole.judgements}
    mine = drawn_structures(each)
    found, weights, shifts, z = [], [], [], []
    for b, moved in mine:
        j = by.get((of(TEMPORAL, SPARSITY), b.judged.where))
        if j is None or j.z.shape != moved.shape:
            continue
        cells = moved & bank.told(whole.seen[j.where].size).ravel()
        weights.append((b.before - b.after)[cells])
        shifts.append((j.recorded - j.simulated)[cells])
        z.append(j.z[cells])
        found.append((j, np.flatnonzero(cells & (j.z < -1))))
    w = np.concatenate(weights or [np.zeros(0)])
    if not w.size:
        return None
    together = float(w @ np.concatenate(z) / np.sqrt(w @ w))
    shift = float(w @ np.concatenate(shifts) / w.sum())
    if together > -_UNEVEN or shift > _FEW_PLACES:
        return None
    left = float(np.sum(np.concatenate(z) ** 2) / 2)
    before = sum(float(b.before[cells].sum()) for b, cells in mine)
    lines = lines_of(whole, [f for f in found if f[1].size])[:3]
    return Doubt(left / (left + before), (_FEW_TIMES, *lines), instead=True)
