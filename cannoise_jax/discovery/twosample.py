"""A two-sample test that knows no physics: can a small network tell recordings from draws of the simulator?

The network sees patches of 32 x 32 residuals, standardised by the baseline for both simulators: a fixed
bank of cosine filters over the patch and along its lines, squared, averaged and logarithmed, and one linear
layer that is trained in closed form (ridge). It is trained on the frames that looked and one half of the
image and measured on the other halves of both, for both halves of the image; nothing of it differs before
and after. An area of 0.5 under the curve: it cannot tell.

One patch holds little: a decision is the mean score of several patches of one frame. How many is fixed by a
control, row noise of four times the smallest detectable effect added to draws of the baseline: the number
is doubled until the network tells those from plain draws with an area of 0.6, or a frame has no more.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import stats

from cannoise_jax.discovery.draws import spread_codes
from cannoise_jax.discovery.fields import Fields, stratum

SIDE = 32
CONTROL_AREA = 0.6
_BATCH = 512
_RIDGE = 10.0
_GROUPINGS = 4
_RESAMPLED = 400


class Patches(NamedTuple):
    """Standardised patches, and the frame each comes from."""

    values: Float[np.ndarray, "n s s"]
    frame: np.ndarray


class Scored(NamedTuple):
    """What the network says of unseen patches of the recordings and of the draws, with their frames; strata:
    of every frame, within which frames are drawn again."""

    real: np.ndarray
    fake: np.ndarray
    real_frame: np.ndarray
    fake_frame: np.ndarray
    strata: np.ndarray


class Area(NamedTuple):
    """Area under the curve with its 90 % interval by resampling frames."""

    value: float
    low: float
    high: float


class TwoSample(NamedTuple):
    """Areas before and after; change: of their distance from 0.5 (None: nothing
    was added). patches: to a decision; control: the area
    for the injected row noise at that number."""

    before: Area
    after: Area
    change: Area | None
    patches: int
    control: float


Pair = tuple[tuple[Fields, ...], tuple[Fields, ...]]
"""Fields of the frames that train, and of those that are judged."""


def cut(fields: tuple[Fields, ...], parity: int, seed: int) -> Patches:
    """Non-overlapping patches of every other site of a checkerboard; recordings of one frame and no modelled
    mean are left out."""
    values, frame, number = [], [], 0
    for f in fields:
        if not len(f.contrasts):
            continue
        stack = spread_codes(f, np.random.default_rng((seed, f.number)))
        t, h, w = stack.shape
        ny, nx = h // SIDE, w // SIDE
        tiles = stack[:, : ny * SIDE, : nx * SIDE].reshape(t, ny, SIDE, nx, SIDE).transpose(0, 1, 3, 2, 4)
        sites = (np.add.outer(np.arange(ny), np.arange(nx)) % 2) == parity
        chosen = tiles[:, sites]
        values.append(np.clip(chosen.reshape(-1, SIDE, SIDE), -8, 8))
        frame.append(np.repeat(np.arange(t) + number, chosen.shape[1]))
        number += t
    if not values:
        return Patches(np.zeros((0, SIDE, SIDE), np.float32), np.zeros(0, int))
    return Patches(np.concatenate(values), np.concatenate(frame))


def cosines(length: int, number: int) -> np.ndarray:
    """The first cosine functions on `length` points, of norm 1: `[length, number]`."""
    x = (np.arange(length) + 0.5) / length
    basis = np.cos(np.pi * x[:, None] * np.arange(number))
    return (basis / np.linalg.norm(basis, axis=0)).astype(np.float32)


@jax.jit
def features(x: Float[Array, "b s s"]) -> Float[Array, "b k"]:
    """Answers of the fixed filters: energies of 5 x 5 cosines, of line means and their steps, and moments."""
    small = cosines(5, 5)
    bank = np.einsum("ia,jb->ijab", small, small).reshape(5, 5, 1, 25)
    local = jax.lax.conv_general_dilated(
        x[..., None], bank, (2, 2), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )
    line = cosines(SIDE, 4)
    parts = [jnp.mean(local**2, (1, 2))]
    for lines in (jnp.einsum("bij,jk->bik", x, line), jnp.einsum("bij,ik->bjk", x, line)):
        steps = jnp.diff(lines[..., 0], axis=1)
        parts += [jnp.mean(lines**2, 1), jnp.mean(steps**2, 1, keepdims=True) / 2]
    moments = (jnp.abs(x), x**2, x**4 / 3)
    parts += [jnp.mean(m, (1, 2))[:, None] for m in moments]
    parts.append(SIDE**2 * jnp.mean(x, (1, 2))[:, None] ** 2)
    return jnp.log1p(jnp.concatenate(parts, -1))


def all_features(values: np.ndarray) -> np.ndarray:
    """`features` in batches of one compiled size."""
    padded = np.zeros((-(-len(values) // _BATCH) * _BATCH, SIDE, SIDE), np.float32)
    padded[: len(values)] = values
    parts = [np.asarray(features(padded[i : i + _BATCH])) for i in range(0, len(padded), _BATCH)]
    return np.concatenate(parts)[: len(values)].astype(np.float64)


def read_out(real: np.ndarray, fake: np.ndarray) -> np.ndarray:
    """Weights of the linear layer; the scores of `fake` have standard deviation 1."""
    within = np.concatenate([real - real.mean(0), fake - fake.mean(0)])
    spread = np.maximum(within.std(0), 1e-6)
    within = within / spread
    correlation = np.einsum("nk,nl->kl", within, within) / len(within)
    gap = (real.mean(0) - fake.mean(0)) / spread
    weights = np.linalg.solve(correlation + _RIDGE * np.eye(len(gap)), gap) / spread
    return weights / max(float((fake @ weights).std()), 1e-9)


def area(real: np.ndarray, fake: np.ndarray) -> float:
    """Area under the curve of two sets of scores."""
    ranks = stats.rankdata(np.concatenate([real, fake]))
    return float((ranks[: real.size].sum() - real.size * (real.size + 1) / 2) / (real.size * fake.size))


def judge(real: Pair, fake: Pair, seed: int) -> Scored | None:
    """Trains the network on the first of both pairs and scores the second, on the other half of the image,
    either way round; None for frames too few or small.

    Scores are counted, recording by recording, from those of the draws that trained it, on the half of the
    image that did not: what tells one recording from another says nothing about the simulator.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    trained, judged = recording_of(fake[0]), recording_of(real[1])
    for parity in (0, 1):
        a, b = cut(real[0], parity, seed), cut(fake[0], parity, seed + 1)
        c, d = cut(real[1], 1 - parity, seed + 2), cut(fake[1], 1 - parity, seed + 3)
        e = cut(fake[0], 1 - parity, seed + 4)
        if min(len(p.values) for p in (a, b, c, d, e)) < 2:
            return None
        weights = read_out(all_features(a.values), all_features(b.values))
        told, plain, usual = (all_features(p.values) @ weights for p in (c, d, e))
        for number in np.unique(judged):
            mine = usual[trained[e.frame] == number]
            for scores, frame in ((told, c.frame), (plain, d.frame)):
                there = judged[frame] == number
                scores[there] = (scores[there] - mine.mean()) / max(float(mine.std()), 1e-9)
        parts.append((told, plain, c.frame, d.frame))
    told, plain, frame, other = (np.concatenate(column) for column in zip(*parts, strict=True))
    strata = np.concatenate([np.full(f.frames, stratum(f)) for f in real[1] if len(f.contrasts)])
    return Scored(told, plain, frame, other, strata)


def recording_of(fields: tuple[Fields, ...]) -> np.ndarray:
    """The recording of every frame, in the order of `cut`."""
    return np.concatenate([np.full(f.frames, f.number) for f in fields if len(f.contrasts)])


def grouped(scores: np.ndarray, frame: np.ndarray, size: int, rng: np.random.Generator):
    """Mean scores of groups of `size` patches of one frame, at random, and the frame of every group."""
    order = np.lexsort((rng.random(scores.size), frame))
    values, frames = [], []
    for chosen in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1):
        number = max(chosen.size // size, 1)
        values += [float(scores[part].mean()) for part in np.array_split(chosen, number)]
        frames += [int(frame[chosen[0]])] * number
    return np.array(values), np.array(frames)


def decided(scored: Scored, size: int, seed: int) -> float:
    """Area under the curve of decisions on `size` patches, averaged over a few groupings."""
    rng = np.random.default_rng(seed)
    return float(
        np.mean(
            [
                area(
                    grouped(scored.real, scored.real_frame, size, rng)[0],
                    grouped(scored.fake, scored.fake_frame, size, rng)[0],
                )
                for _ in range(_GROUPINGS)
            ]
        )
    )


def resampled(scored: list[Scored], size: int, seed: int) -> np.ndarray:
    """Areas of several networks `[n, R]` under the same resampling of frames, within each recording or,
    of recordings of one frame, each kind."""
    rng = np.random.default_rng(seed)
    groups = [
        (grouped(s.real, s.real_frame, size, rng), grouped(s.fake, s.fake_frame, size, rng)) for s in scored
    ]
    strata = scored[0].strata
    alike = [np.flatnonzero(strata == s) for s in np.unique(strata)]
    out = np.zeros((len(scored), _RESAMPLED))
    for k in range(_RESAMPLED):
        real_weight = np.bincount(_redrawn(rng, alike), minlength=strata.size)
        fake_weight = np.bincount(_redrawn(rng, alike), minlength=strata.size)
        for n, (real, fake) in enumerate(groups):
            out[n, k] = _weighted_area(real[0], real_weight[real[1]], fake[0], fake_weight[fake[1]])
    return out


def _redrawn(rng: np.random.Generator, strata: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([rng.choice(s, s.size) for s in strata])


def _weighted_area(real, real_weight, fake, fake_weight) -> float:
    order = np.argsort(fake)
    below = np.concatenate([[0.0], np.cumsum(fake_weight[order])])
    left = below[np.searchsorted(fake[order], real, "left")]
    right = below[np.searchsorted(fake[order], real, "right")]
    total = real_weight.sum() * below[-1]
    return float(np.sum(real_weight * (left + right) / 2) / max(total, 1))


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


def two_sample(
    seed: int,
    real: Pair,
    before: Pair,
    after: Pair | None,
    control: tuple[Pair, Pair],
    control_sigma: float | None,
) -> TwoSample | None:
    """Recordings against draws of the simulator before and after (None: nothing was added to it).

    control: two draws of the baseline, to the first of which row noise of `control_sigma` DN is added. None
    where there are too few frames.
    """
    first = judge(real, before, seed)
    if first is None:
        return None
    size, reached = 1, float("nan")
    if control_sigma is not None:
        rng = np.random.default_rng(seed)
        injected = tuple(with_row_noise(rng, f, control_sigma) for f in control[0])
        told = judge(injected, control[1], seed)  # type: ignore[arg-type]
        assert told is not None
        most = int(np.bincount(told.real_frame).max())
        reached = decided(told, size, seed)
        while reached < CONTROL_AREA and 2 * size <= most:
            size *= 2
            reached = decided(told, size, seed)
    second = None if after is None else judge(real, after, seed)
    both = [first] if second is None else [first, second]
    drawn = resampled(both, size, seed)
    values = [decided(s, size, seed) for s in both]
    low, high = np.quantile(drawn, (0.05, 0.95), axis=1)
    areas = [Area(v, float(a), float(b)) for v, a, b in zip(values, low, high, strict=True)]
    change = None
    if second is not None:
        moved = np.abs(drawn[1] - 0.5) - np.abs(drawn[0] - 0.5)
        value = abs(values[1] - 0.5) - abs(values[0] - 0.5)
        change = Area(value, *(float(q) for q in np.quantile(moved, (0.05, 0.95))))
    return TwoSample(areas[0], areas[-1], change, size, reached)
