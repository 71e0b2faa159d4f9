"""How well a simulator describes frames that it has not seen: the same measures before and after.

All compare recordings with draws of the simulator at equal settings, both seen through the same baseline:
histogram divergence with its floor, probability integral transform, spectra of row and column means,
neighbour covariances, photon-transfer curve, a composite score per frame, and a two-sample test.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.draws import as_fields, draw_like, frames_at_once, spread_codes
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.proof.curves import Curves, curves
from cannoise_jax.discovery.proof.gains import frame_interval
from cannoise_jax.discovery.proof.heldout import Scored
from cannoise_jax.discovery.proof.patch_network import SIDE
from cannoise_jax.discovery.proof.prove import Proof, Proofs
from cannoise_jax.discovery.proof.sides import Drawings, Sides
from cannoise_jax.discovery.proof.twosample import Area, Pair, TwoSample, areas_of, controlled, judge
from cannoise_jax.discovery.proof.twosample import Scored as TwoSampleScores
from cannoise_jax.evaluation.kl import kl_divergence, kl_floor
from cannoise_jax.physics.likelihood.composite import Profile, composite_score, profile, ruler
from cannoise_jax.signatures.fields import Fields, frame_fields, stratum

_PIT_BINS = 20
"""Of the histogram of ranks: the first and the last hold 5 % each, where tails show."""
_PIT_MOST = 40_000
"""Recorded pixels whose ranks are counted, of twice as many drawn ones: each bin is known to 2.7 %."""
_LEARNED, _LEAST_LEARNED, _TIMES_SCORED = 400_000, 60_000, 30
"""Drawn pixels of each recording from which the composite score learns: so many times those that it scores,
within these bounds. A score of n pixels is uncertain by some 0.7 / sqrt(n) nats a pixel; what is learned
from N pixels for some 370 bins costs about 185 / N nats, a fifth of that or less."""
_LEAST_USABLE = 0.05
"""Share of the pixels that must not lie at a rail for a recording to be compared."""


class Side(NamedTuple):
    """One simulator against the recordings.

    pit: share of the pixels per bin of their probability under the draws, uniform when right. composite:
    score in nats per pixel of every frame `[T]`; None where it was not asked for.
    """

    kl: float
    kl_floor: float
    pit: Float[np.ndarray, "20"]
    curves: Curves
    composite: Float[np.ndarray, "t"] | None


class Quality(NamedTuple):
    """Before and after, on frames that took no part in finding anything; real: curves of the recordings;
    half: the recordings held back which the simulator could draw."""

    before: Side
    after: Side
    real: Curves
    two_sample: TwoSample | None
    half: Prepared


@dataclass(frozen=True, eq=False)
class Panel:
    """What every candidate for the extended simulator is measured by, all of them alike.

    halves: the recordings that looked and those held back, of those that show new noise in both and that the
      simulator draws.
    span: of the signal, DN.
    patches: to a decision of the two-sample test; None where frames are too small or too few for it.
    control: its area for the row noise put in; nan where there is no test.
    plain: draws of the simulator that is judged.
    """

    key: Key[Array, ""]
    halves: tuple[Prepared, Prepared]
    span: float
    patches: int | None
    control: float
    plain: Pair

    @property
    def real(self) -> Pair:
        """The recordings."""
        return self.halves[0].fields, self.halves[1].fields

    @property
    def seed(self) -> int:
        """Of the two-sample test."""
        return int(jax.random.randint(self.key, (), 0, 2**31 - 1))

    def look(self, draw: Drawings, number: int, composite: bool = True) -> Looked:
        """One simulator; number: of the candidate, for the random numbers of all but its score."""
        pair = self.plain if number == PLAIN else _pair(draw, self.halves, _keys(self.key)[number])
        scores = composite_scores(_of_scores(self.key), self.halves[1], draw) if composite else None
        side = _side(self.real[1], pair[1], self.span, scores)
        told = judge(self.real, pair, self.seed) if self.patches else None
        return Looked(side, told)

    def areas(self, looked: list[Looked]) -> list[Area] | None:
        """Areas of the two-sample test with 90 % intervals, under the same resampling of frames."""
        told = [one.told for one in looked]
        if self.patches is None or any(t is None for t in told):
            return None
        return areas_of(told, self.patches, self.seed)[0]  # type: ignore[arg-type]

    def change(self, before: Looked, after: Looked) -> Area | None:
        """How much nearer to one half the area came."""
        if self.patches is None or before.told is None or after.told is None:
            return None
        return areas_of([before.told, after.told], self.patches, self.seed)[1]


class Looked(NamedTuple):
    """One simulator on a panel: its measures, and what the network says of patches of it."""

    side: Side
    told: TwoSampleScores | None


def open_panel(
    key: Key[Array, ""], first: Prepared, second: Prepared, sides: Sides, control_sigma: float | None
) -> Panel | None:
    """The panel of a run; control_sigma: row noise that is added to draws of the baseline for the control,
    DN. None where no recording shows new noise in both splits."""
    shown = [
        {f.number for f in p.fields if len(f.contrasts) and f.usable.mean() > _LEAST_USABLE}
        for p in (first, second)
    ]
    names = shown[0] & shown[1]
    if not names:
        return None
    halves = _only(first, names), _only(second, names)
    keys = _keys(key)
    drawn = [
        [draw_like(d(own), half) for half, own in zip(halves, jax.random.split(k), strict=True)]
        for d, k in ((sides.plain, keys[PLAIN]), (sides.control, keys[_CONTROL]))
    ]
    known = set.intersection(*(set(frames) for pair in drawn for frames in pair))
    if not known:
        return None
    halves = _only(halves[0], known), _only(halves[1], known)
    plain, control = ((as_fields(halves[0], a), as_fields(halves[1], b)) for a, b in drawn)
    panel = Panel(key, halves, first.span, None, float("nan"), plain)
    if min(panel.real[0][0].mean.shape) < 2 * SIDE or judge(panel.real, plain, panel.seed) is None:
        return panel
    quiet = plain if sides.calibrated else _pair(sides.control, panel.halves, keys[_QUIET])
    size, reached = controlled((control, quiet), control_sigma, panel.seed)
    return dataclasses.replace(panel, patches=size, control=reached)


PLAIN, _CONTROL, NAMED, _QUIET, SURE = range(5)
WITH_REST, WELL_WITH_REST, REST_ALONE, NAMED_WITH_REST, NAMED_ALONE, STANDING = range(5, 11)
"""Numbers of the simulators that are drawn, for their random numbers."""


def _keys(key: Key[Array, ""]) -> Key[Array, "n"]:
    return jax.random.split(key, STANDING + 1)


def _pair(draw: Drawings, halves: tuple[Prepared, Prepared], key: Key[Array, ""]) -> Pair:
    return tuple(
        as_fields(p, draw_like(draw(own), p)) for p, own in zip(halves, jax.random.split(key), strict=True)
    )  # type: ignore[return-value]


def quality_of(panel: Panel, before: Looked, after: Looked) -> Quality:
    """Before and after as they are reported."""
    tested = None
    areas = panel.areas([before, after])
    if areas is not None and panel.patches is not None:
        change = None if after is before else panel.change(before, after)
        tested = TwoSample(areas[0], areas[1], change, panel.patches, panel.control)
    return Quality(before.side, after.side, curves(panel.real[1]), tested, panel.halves[1])


def _only(prepared: Prepared, names: set[int]) -> Prepared:
    kept = [n for n, f in enumerate(prepared.fields) if f.number in names]
    return prepared._replace(
        fields=tuple(prepared.fields[n] for n in kept), stacks=tuple(prepared.stacks[n] for n in kept)
    )


def _side(
    real: tuple[Fields, ...], drawn: tuple[Fields, ...], span: float, composite: np.ndarray | None
) -> Side:
    rng = np.random.default_rng(0)
    noise = [spread_codes(f, rng)[:, f.usable] * (f.sigma[f.usable] / span) for f in real]
    fake = [spread_codes(f, rng)[:, f.usable] * (f.sigma[f.usable] / span) for f in drawn]
    pooled, pooled_fake = (np.concatenate([v.ravel() for v in part]) for part in (noise, fake))
    return Side(
        kl_divergence(pooled, pooled_fake),
        kl_floor(pooled, pooled_fake.size, seed=0),
        np.mean([_pit(a, b) for a, b in zip(noise, fake, strict=True) if a.size], axis=0),
        curves(drawn),
        composite,
    )


def _pit(real: np.ndarray, fake: np.ndarray) -> np.ndarray:
    """Histogram of the randomised ranks of recorded values among drawn ones."""
    rng = np.random.default_rng(0)
    x = rng.permutation(real.ravel())[:_PIT_MOST]
    y = np.sort(rng.permutation(fake.ravel())[: 2 * _PIT_MOST])
    low, high = np.searchsorted(y, x, "left"), np.searchsorted(y, x, "right")
    u = (low + rng.random(x.size) * (high - low + 1)) / (y.size + 1)
    return np.histogram(u, _PIT_BINS, (0, 1))[0] / x.size


def _of_scores(key: Key[Array, ""]) -> Key[Array, ""]:
    """The random numbers of draws that a score is learned from, the same for all simulators: how bright a
    lamp happens to be in a few dozen frames moves a score by more than a candidate gains."""
    return jax.random.fold_in(key, NAMED)


def composite_scores(key: Key[Array, ""], half: Prepared, draw: Drawings) -> Float[np.ndarray, "t"]:
    """Composite score of every frame held back, nats per pixel, learned from draws of the simulator: batches
    of as many frames as each recording has, for the mean of a batch is taken out of it."""

    def one(number: int) -> Float[np.ndarray, "t"]:
        field = half.fields[number]
        alone = _only(half, {field.number})
        return _composite(field, _learned(jax.random.fold_in(key, number), alone, draw))

    return np.concatenate(each(one, range(len(half.fields))))


def _learned(key: Key[Array, ""], alone: Prepared, draw: Drawings) -> list[Fields]:
    """Drawn batches of one recording, as many pixels in all as the score learns from, or more."""
    (field,) = alone.fields
    scored = field.frames * field.mean.size
    missing = -(-int(np.clip(_TIMES_SCORED * scored, _LEAST_LEARNED, _LEARNED)) // scored)
    most = max(frames_at_once(field.mean.size) // (field.before + field.frames), 1)
    out: list[Fields] = []
    while len(out) < missing:
        times = min(most, missing - len(out))
        frames = draw_like(draw(jax.random.fold_in(key, len(out))), alone, times)[field.number]
        for batch in np.split(frames, times):
            out += as_fields(alone, {field.number: batch})
    return out


def _composite(real: Fields, drawn: list[Fields]) -> Float[np.ndarray, "t"]:
    """Scores of the frames of one recording. Residuals are scored with every code spread over its step, and
    which codes occur by the codes as they are."""
    rng = np.random.default_rng(real.number)
    by = ruler(real.mean, real.sigma, real.step)
    spread = _average(
        [profile(g.mean + spread_codes(g, rng) * g.sigma, by._replace(mean=g.mean)) for g in drawn]
    )
    exact = _average([profile(g.mean + frame_fields(g) * g.sigma, by._replace(mean=g.mean)) for g in drawn])
    residuals = composite_score(spread, real.mean + spread_codes(real, rng) * real.sigma, by)
    codes = composite_score(exact, real.mean + frame_fields(real) * real.sigma, by).codes
    return residuals.per_frame + (codes - residuals.codes)


def composite_proofs(key: Key[Array, ""], proven: Proofs, quality: Quality, sides: Sides) -> Proofs:
    """The findings on a simulator without a likelihood: the gain of each is the change of the composite
    score, nats per pixel times pixels, when it alone is left out."""
    if quality.after.composite is None:
        return proven
    half = quality.half
    alike = np.concatenate([np.full(f.frames, stratum(f)) for f in half.fields])
    pixels = np.concatenate([np.full(f.frames, f.mean.size) for f in half.fields])
    full = Scored(quality.after.composite * pixels, alike, pixels)
    out = []
    for proof, without in zip(proven.each, sides.less, strict=True):
        rest = composite_scores(_of_scores(key), half, without)
        gain, low, high = frame_interval(full, Scored(rest * pixels, alike, pixels))
        sure = proof.confirmed
        out.append(Proof(proof.score, gain, low, high, int(pixels.sum()), "composite", shown=sure))
    return Proofs(tuple(out), None, None)


def _average(profiles: list[Profile]) -> Profile:
    """One profile of several batches of equal size."""
    return Profile(
        np.log(np.mean([np.exp(p.log_bins) for p in profiles], axis=0)),
        np.log(np.mean([np.exp(p.log_codes) for p in profiles], axis=0)),
        np.mean([p.correlations for p in profiles], axis=0),
        np.mean([p.mean_squares for p in profiles], axis=0),
    )
