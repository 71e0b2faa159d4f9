"""Adequacy: whether a name accounts for its own part of the mismatch, or merely comes nearest.

Every accepted mechanism is left out of the extended simulator in turn, and both are drawn from. Its own part
are the statistics of the layer that knows no names on which it bears: those that it brings nearer to the
recordings or takes further away. What the full simulator leaves of their mismatch, in nats, is what speaks
against the name: a mechanism that is there leaves next to nothing in its own part, one that only resembles
what is there leaves a good part of it, or more than there was.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key
from scipy import stats

from cannoise_jax.discovery.compare.judge import Judgement
from cannoise_jax.discovery.compare.measure import STATIC, Family
from cannoise_jax.discovery.compare.run import Chosen, Compared, compare_bank
from cannoise_jax.discovery.compare.sources import Source, modelled
from cannoise_jax.discovery.compare.table import differences, lines_of
from cannoise_jax.discovery.proof.check import frames_for
from cannoise_jax.discovery.proof.gate import Gated
from cannoise_jax.discovery.search.fit import Fitted, Step
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.physics.core.chain import closed_form
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import DEFAULT, Settings, context_of, resolve
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures import bank

LEFT = 0.25
"""Share of the mismatch of its own part, in nats, that a name may leave: half of it in amplitude."""
LEFT_OF_SCENES = 0.1
"""The same of a name that speaks for all that stays in scenes, whose filter is fitted freely. References
shifted by 0.1 to 0.8 pixels of a colour, softened or sharpened leave 0 to 5 % of it; a wide halo, which is a
blur as well, 5 to 6 %; a trail along the rows 1 to 19 %, the more the more detail the scene has."""
LEFT_TOGETHER = 0.5
"""The same where no single statistic differs significantly, but all together leave more than chance."""
_BEARS = 4.0
"""Nats by which a statistic must change with a mechanism to be of its part: 2.8 standard deviations."""
_CLEAR = 0.1
"""Share of the larger mismatch by which it must change, beside what the draws scatter."""
_CHANCE = 1e-4
"""Probability that all statistics of the part leave as much by chance."""
_PIXELS = 1.2e6
"""Pixels of all frames that are looked at, beyond which fewer are."""


def doubts(
    capture: CaptureSet,
    splits: list[tuple[list[int], list[int]]],
    steps: tuple[Step, ...],
    of: Callable[..., SensorModel],
    key: Key[Array, ""],
    alpha: float,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Doubt | None, ...]:
    """What speaks against the name of each step, on the frames held back; None: nothing does, or it has none.

    of: the camera model with some of the steps, and one of them `silent` where asked, see
    `model.extended_model`. alpha: chance that something is said against a true one.
    """
    drawn = [n for n, s in enumerate(steps) if s.named.mechanism != UNKNOWN]
    if not drawn:
        return (None,) * len(steps)
    chosen = _few(capture, splits)

    off = [_off(s, n) for n, s in enumerate(steps)]

    def drawn_from(model: SensorModel, names: Sequence[int]) -> Compared:
        source = beside(modelled(model, key), [o for n in names if (o := off[n])], capture)
        return compare_bank(capture, source, alpha=alpha, held_back=chosen, sets=2)

    model, plain, every = of(steps), of(()), list(range(len(steps)))
    full, start = drawn_from(model, every), drawn_from(plain, ())
    out: list[Doubt | None] = [None] * len(steps)
    # Where all names together make it worse, each has to show by itself what it is worth.
    alone = _found(full) > _found(start)
    for n in drawn:
        less = of(tuple(s for s in steps if s is not steps[n]))
        still = len(less.mechanisms) == len(model.mechanisms)
        if still and not off[n]:
            continue  # of the capture or the bookkeeping: it is not drawn
        tell(f"adequacy: {steps[n].named.mechanism}")
        others, claimed = [k for k in every if k != n], steps[n].named.signature.speaks_for
        if alone:
            out[n] = doubt(drawn_from(of((steps[n],)), (n,)), start, claimed if off[n] else frozenset())
            continue
        if still:
            out[n] = doubt(full, drawn_from(model, others), claimed)
            continue
        # A program of the same mechanisms is compiled already.
        quiet = of(steps, silent=steps[n])
        alike = _alike(quiet, less, capture.recordings[0].size)
        out[n] = doubt(full, drawn_from(quiet if alike else less, others))
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


def _alike(one: SensorModel, two: SensorModel, size: tuple[int, int]) -> bool:
    """Whether two camera models have one closed form; False where a mechanism has none."""
    if any(f.record.effect is None and f.record.baseline is None for f in (*one.mechanisms, *two.mechanisms)):
        return False
    for level in (0.0, 0.4):
        told = [_moments(m, level, size) for m in (one, two)]
        if not all(np.allclose(a, b, rtol=1e-3, atol=1e-3) for a, b in zip(*told, strict=True)):
            return False
    return True


def _moments(model: SensorModel, level: float, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    context = context_of(model, jnp.full((1, *size), level, jnp.float32), DEFAULT)
    mean, variance = closed_form(model, context, resolve(model, context))
    return np.asarray(mean), np.asarray(variance)


class Part(NamedTuple):
    """A mechanism's own part of the mismatch: nats without and with it beyond what chance leaves, of how many
    statistics, those that still differ, and whether all together leave more than chance."""

    before: float
    after: float
    number: int
    left: list[tuple[Judgement, np.ndarray]]
    more: bool


def own_part(full: Compared, less: Compared, speaks_for: frozenset[str] = frozenset()) -> Part:
    """The statistics that a mechanism moves, of a simulator with it and one without, and all that stays and
    differs in recordings of the kinds that it speaks for."""
    without = {(j.family, j.where): j for j in less.judgements}
    before = after = 0.0
    number = 0
    left: list[tuple[Judgement, np.ndarray]] = []
    for j in full.judgements:
        other = without.get((j.family, j.where))
        if other is None or j.where not in full.seen or other.z.shape != j.z.shape:
            continue
        one = mismatch(other, less.recorded[j.where].families[j.family])
        two = mismatch(j, full.recorded[j.where].families[j.family])
        # Where the simulator's own units scatter more than independent ones, the nats weigh less.
        weight = np.clip(0.5 * j.z**2 / np.maximum(two, 1e-9), 0.0, 1.0) * (two > 1) + (two <= 1)
        one, two = weight * one, weight * two
        own = _moved(one, two)
        if full.seen[j.where].kind in speaks_for and j.family.startswith(STATIC):
            own |= one > _BEARS
        if j.family.endswith("structure"):
            own |= _broken(own, full.seen[j.where].size)
        before += float(one[own].sum())
        after += float(two[own].sum())
        number += int(own.sum())
        found = np.flatnonzero(own & (np.abs(j.z) > j.passing))
        if found.size:
            left.append((j, found))
    # Twice the nats of two equal normal laws are chi-squared.
    more = number > 0 and float(stats.chi2.sf(2 * after, number)) < _CHANCE
    return Part(max(before - 0.5 * number, 0.0), max(after - 0.5 * number, 0.0), number, left, more)


def doubt(full: Compared, less: Compared, speaks_for: frozenset[str] = frozenset()) -> Doubt | None:
    """What the simulator with a mechanism leaves of that mechanism's part of the mismatch, see `own_part`;
    None where nothing significant is left or it is little."""
    part = own_part(full, less, speaks_for)
    few = LEFT_OF_SCENES if speaks_for else LEFT
    if not (part.left or part.more) or part.after <= (few if part.left else LEFT_TOGETHER) * part.before:
        return None
    return Doubt(part.after / max(part.before, 1e-9), tuple(lines_of(full, part.left)[:3]))


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


def mismatch(j: Judgement, family: Family) -> Float[np.ndarray, "k"]:
    """Nats between the recorded and the simulated value of every statistic, see `compare.table`."""
    a, b, units = j.recorded, j.simulated, len(family.values)
    if family.law == "energy":
        ratio = np.where(family.size > 0, np.maximum(a, 1e-9) / np.maximum(b, 1e-9), 1.0)
        return units * family.size / 2 * (ratio - 1 - np.log(ratio))
    if family.law == "count":
        return a * np.log(np.maximum(a, 0.5) / np.maximum(b, 0.5)) - a + b
    return np.minimum(units * (a - b) ** 2 / np.maximum(family.size, 1e-30), 2 * 38.0**2) / 2


def _few(capture: CaptureSet, splits: Sequence[tuple[list[int], list[int]]]) -> Chosen:
    """The frames that are looked at, of those held back: of large recordings two of each, and of many large
    ones those of some recordings, spread evenly, the first and the last among them."""
    chosen = frames_for(list(splits))
    size = [r.size[0] * r.size[1] for r in capture.recordings]

    def pixels(some: Chosen) -> int:
        return sum((len(a) + len(b)) * n for (a, b), n in zip(some, size, strict=True) if b)

    if pixels(chosen) > _PIXELS:
        chosen = [(a, b[:2]) for a, b in chosen]
    shown = [n for n, (_, b) in enumerate(chosen) if b]
    most = max(int(len(shown) * _PIXELS / max(pixels(chosen), 1)), 3)
    if most < len(shown):
        kept = {shown[k] for k in np.linspace(0, len(shown) - 1, most).round().astype(int)}
        chosen = [c if n in kept else ([], []) for n, c in enumerate(chosen)]
    return chosen
