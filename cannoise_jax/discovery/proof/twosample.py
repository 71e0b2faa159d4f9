"""A two-sample test that knows no physics: can a small network tell recordings from draws of the simulator?

The network (`patch_network`) sees patches of 32 x 32 residuals, standardised by the baseline for both
simulators. It is trained on the frames that looked and one half of the image and measured on the other
halves of both, for both halves of the image; nothing of it differs before and after. Patches are compared
within their recording. An area of 0.5 under the curve: it cannot tell.

One patch holds little: a decision is the mean score of several patches of one frame. How many is fixed by a
control, row noise of four times the smallest detectable effect added to draws of the baseline: the number
is doubled until the network tells those from plain draws with an area of 0.6, as long as a frame gives four
decisions: with fewer, chance does so too. That effect is counted over the whole rows of all frames of the
set, so in large sets no number of patches of one frame may show it. A decision is then one patch, whose area
the frames tell best, and the control is reported as it is. Neither depends on how the recordings compare.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.discovery.proof.patch_network import cut, train
from cannoise_jax.signatures.fields import Fields, stratum

CONTROL_AREA = 0.6
"""Area of the injected row noise from which on the test counts as able to tell an effect of that size."""
_DECISIONS = 4
"""Decisions that a frame gives at least."""
_GROUPINGS = 4
"""Random groupings of patches over which a decision is averaged."""
_RESAMPLED = 400
"""Bootstrap draws of an interval: the 5 % quantile of so many is known to 0.1 standard deviations."""
_LEAST_AREA = 0.03
"""Distance from one half that a baseline fitted on few frames shows by itself."""


class Scored(NamedTuple):
    """What the network says of unseen patches of the recordings and of the draws, with their frames; of every
    frame its recording, and the stratum within which it is drawn again."""

    real: np.ndarray
    fake: np.ndarray
    real_frame: np.ndarray
    fake_frame: np.ndarray
    recording: np.ndarray
    strata: np.ndarray


class Compared(NamedTuple):
    """Decisions of every recorded frame against those of every drawn one of the same recording: the share of
    pairs in which the recorded one scores higher, and the number of decisions of each frame."""

    share: Float[np.ndarray, "t t"]
    same: Float[np.ndarray, "t t"]
    real: Float[np.ndarray, "t"]
    fake: Float[np.ndarray, "t"]


class Area(NamedTuple):
    """Area under the curve with its 90 % interval by resampling frames, its standard error by the same and
    the degrees of freedom of that."""

    value: float
    low: float
    high: float
    error: float = float("nan")
    freedom: int = 1

    @property
    def sure(self) -> float:
        """What it surely exceeds: of few frames the interval by resampling is too narrow, that of Student's
        law with their degrees of freedom is not."""
        if not np.isfinite(self.error):
            return self.low
        return min(self.low, self.value - float(stats.t.isf(0.05, self.freedom)) * self.error)

    def below(self, chance: float) -> bool:
        """Whether it lies below 0 by more than this chance allows, and by its interval."""
        least = float(stats.t.isf(chance, self.freedom)) * self.error if np.isfinite(self.error) else 0.0
        return self.high < 0 and self.value + least < 0


class TwoSample(NamedTuple):
    """Areas before and after; change: of what they are above 0.5 (None: nothing was added). patches: to a
    decision; control: the area for the injected row noise at that number, below `CONTROL_AREA` where no
    number reaches it."""

    before: Area
    after: Area
    change: Area | None
    patches: int
    control: float


Pair = tuple[tuple[Fields, ...], tuple[Fields, ...]]
"""Fields of the frames that train, and of those that are judged."""


def area(real: np.ndarray, fake: np.ndarray) -> float:
    """Area under the curve of two sets of scores."""
    ranks = stats.rankdata(np.concatenate([real, fake]))
    return float((ranks[: real.size].sum() - real.size * (real.size + 1) / 2) / (real.size * fake.size))


def judge(real: Pair, fake: Pair, seed: int) -> Scored | None:
    """Trains the network on the first of both pairs and scores the second, on the other half of the image,
    either way round; None for frames too few or small."""

    def half(parity: int) -> tuple[np.ndarray, ...] | None:
        a, b = cut(real[0], parity, seed), cut(fake[0], parity, seed + 1)
        c, d = cut(real[1], 1 - parity, seed + 2), cut(fake[1], 1 - parity, seed + 3)
        if min(len(p.values) for p in (a, b, c, d)) < 2:
            return None
        network = train(a, b)
        return network.scores(c), network.scores(d), c.frame, d.frame

    parts = [part for part in each(half, (0, 1)) if part is not None]
    if len(parts) < 2:
        return None
    told, plain, frame, other = (np.concatenate(column) for column in zip(*parts, strict=True))
    shown = [f for f in real[1] if len(f.contrasts)]
    recording, strata = (np.repeat(v, [f.frames for f in shown]) for v in _places(shown))
    return Scored(told, plain, frame, other, recording, strata)


def _places(fields: list[Fields]) -> tuple[list[int], list[int]]:
    """Recording and stratum of each; those alone in their stratum are taken together."""
    own = [stratum(f) for f in fields]
    lone = [sum(f.frames for f, t in zip(fields, own, strict=True) if t == s) == 1 for s in own]
    return [f.number for f in fields], [-9 if one else s for s, one in zip(own, lone, strict=True)]


def grouped(scores: np.ndarray, frame: np.ndarray, size: int, rng: np.random.Generator):
    """Mean scores of groups of `size` patches of one frame, at random, and the frame of every group."""
    order = np.lexsort((rng.random(scores.size), frame))
    values, frames = [], []
    for chosen in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        number = max(chosen.size // size, 1)
        values += [float(scores[part].mean()) for part in np.array_split(chosen, number)]
        frames += [int(frame[chosen[0]])] * number
    return np.array(values), np.array(frames)


def compared(scored: Scored, size: int, seed: int) -> Compared:
    """Decisions on `size` patches, pair by pair, averaged over a few groupings."""
    rng = np.random.default_rng(seed)
    same = scored.recording[:, None] == scored.recording
    share = np.zeros(same.shape)
    for _ in range(_GROUPINGS if size > 1 else 1):
        (real, a), (fake, b) = (
            grouped(scored.real, scored.real_frame, size, rng),
            grouped(scored.fake, scored.fake_frame, size, rng),
        )
        for i, j in np.argwhere(same):
            share[i, j] += area(real[a == i], fake[b == j])
    share /= _GROUPINGS if size > 1 else 1
    count = scored.recording.size
    return Compared(share, same * 1.0, np.bincount(a, minlength=count), np.bincount(b, minlength=count))


def weighted_area(pairs: Compared, real: np.ndarray, fake: np.ndarray) -> float:
    """Area under the curve within recordings, averaged over the recorded decisions; real, fake: weight of
    every frame."""
    below = pairs.share @ (fake * pairs.fake) / (pairs.same @ (fake * pairs.fake))
    return float(np.average(below, weights=real * pairs.real))


def decided(scored: Scored, size: int, seed: int) -> float:
    """Area under the curve of decisions on `size` patches."""
    equal = np.ones(scored.recording.size)
    return weighted_area(compared(scored, size, seed), equal, equal)


def resampled(scored: list[Scored], size: int, seed: int) -> np.ndarray:
    """Areas of several networks `[n, R]` under the same resampling of frames, within each recording or, of
    recordings of one frame, each kind: there with the draws that they are compared with."""
    rng = np.random.default_rng(seed)
    pairs = [compared(s, size, seed) for s in scored]
    strata = scored[0].strata
    alike = [np.flatnonzero(strata == s) for s in np.unique(strata)]
    several = [a for a in alike if strata[a[0]] >= 0]
    out = np.zeros((len(scored), _RESAMPLED))
    for k in range(_RESAMPLED):
        real, fake = redrawn(rng, alike, strata.size), redrawn(rng, several, strata.size)
        out[:, k] = [weighted_area(p, real, fake) for p in pairs]
    return out


def redrawn(rng: np.random.Generator, strata: list[np.ndarray], size: int) -> Float[np.ndarray, "t"]:
    """Weights of frames drawn again within strata: of n frames n - 1, each weighing n / (n - 1), which is
    without bias for the variance however few they are (Rao & Wu 1988)."""
    weight = np.ones(size)
    for s in strata:
        if s.size > 1:
            weight[s] = np.bincount(rng.integers(0, s.size, s.size - 1), minlength=s.size)
            weight[s] *= s.size / (s.size - 1)
    return weight


def with_row_noise(rng: np.random.Generator, fields: tuple[Fields, ...], sigma: float) -> tuple[Fields, ...]:
    """The fields with row noise of `sigma` DN added: its contrasts between frames are as strong as itself."""
    out = []
    for f in fields:
        weight = f.weight.astype(np.float32)

        def rows(count: int, height: int = f.mean.shape[0]) -> np.ndarray:
            return (sigma * rng.standard_normal((count, height, 1))).astype(np.float32)

        static = None if f.static is None else f.static + rows(1)[0] * weight
        out.append(f._replace(contrasts=f.contrasts + rows(len(f.contrasts)) * weight, static=static))
    return tuple(out)


def decision_size(control: Scored, seed: int) -> tuple[int, float]:
    """Patches to a decision, doubled until the control is told by more than chance, and its area then; one
    where none tells it of which a frame gives `_DECISIONS`."""
    most = int(np.bincount(control.real_frame).max()) // _DECISIONS
    alone = decided(control, 1, seed)
    for size in (2**n for n in range(most.bit_length())):
        reached = alone if size == 1 else decided(control, size, seed)
        if reached >= CONTROL_AREA and np.quantile(resampled([control], size, seed), 0.05) > 0.5:
            return size, reached
    return 1, alone


def controlled(control: tuple[Pair, Pair], sigma: float | None, seed: int) -> tuple[int, float]:
    """Patches to a decision and the area of the control: two draws of the baseline, to the first of which row
    noise of `sigma` DN is added; one patch and nan without any."""
    if sigma is None:
        return 1, float("nan")
    rng = np.random.default_rng(seed)
    injected = tuple(with_row_noise(rng, f, sigma) for f in control[0])
    told = judge(injected, control[1], seed)  # type: ignore[arg-type]
    assert told is not None
    return decision_size(told, seed)


def areas_of(scored: list[Scored], size: int, seed: int) -> tuple[list[Area], Area]:
    """Areas of several simulators with their intervals, and the change of what they are above 0.5 between the
    first and the last, all under the same resampling of frames. Below 0.5 is chance: what a classifier learnt
    of one half of the frames does not hold for the other."""
    drawn = resampled(scored, size, seed)
    values = [decided(s, size, seed) for s in scored]
    low, high = np.quantile(drawn, (0.05, 0.95), axis=1)
    areas = [
        Area(v, float(a), float(b), float(d.std()), freedom(scored[0]))
        for v, a, b, d in zip(values, low, high, drawn, strict=True)
    ]
    moved = np.maximum(drawn[-1], 0.5) - np.maximum(drawn[0], 0.5)
    value = max(values[-1], 0.5) - max(values[0], 0.5)
    least, most = (float(q) for q in np.quantile(moved, (0.05, 0.95)))
    change = Area(value, least, most, float(moved.std()), areas[0].freedom)
    return areas, change


def freedom(scored: Scored) -> int:
    """Frames less strata: degrees of freedom of what resampling frames tells."""
    return max(scored.strata.size - np.unique(scored.strata).size, 1)


def differs(area: Area, log_alpha: float) -> bool:
    """Whether the recordings are told from the draws, at an error rate: by a t law of the area's own scatter
    over frames; by no less than `_LEAST_AREA`, which a baseline fitted on few frames loses by itself."""
    limit = float(stats.t.isf(np.exp(log_alpha), area.freedom)) * max(area.error, 1e-3)
    return area.value - 0.5 > max(limit, _LEAST_AREA)


def two_sample(
    seed: int,
    real: Pair,
    before: Pair,
    after: Pair | None,
    control: tuple[Pair, Pair],
    control_sigma: float | None,
) -> TwoSample | None:
    """Recordings against draws of the simulator before and after (None: nothing was added to it).

    control: as `controlled` takes it. None where there are too few frames.
    """
    first = judge(real, before, seed)
    if first is None:
        return None
    size, reached = controlled(control, control_sigma, seed)
    second = None if after is None else judge(real, after, seed)
    areas, change = areas_of([first] if second is None else [first, second], size, seed)
    return TwoSample(areas[0], areas[-1], None if second is None else change, size, reached)
