"""A small network that knows no physics: patches of standardised residuals, fixed filters, one trained layer.

The filters are cosines over the patch and along its lines, squared, averaged and logarithmed. Their answers
are counted from those of the draws that train, recording by recording, and the linear layer is trained in
closed form (ridge): one for all recordings, from which that of each departs as far as its patches show that
it must. What a simulator lacks in a bright frame need not be what it lacks in a long dark one.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cannoise_jax.discovery.frames.draws import spread_codes
from cannoise_jax.recordings.packing import SITES
from cannoise_jax.signatures.fields import Fields

SIDE = 32
"""Pixels along a side of a patch."""
_BATCH = 512
"""Patches at once, of one size so that the program is compiled once."""
_RIDGE = 10.0
"""Added to the diagonal of the correlation of the features, of some hundred patches."""
_LIMIT = 8.0
"""Bound of pixels and of the filters' answers, in standard deviations: no single hot pixel decides."""


class Patches(NamedTuple):
    """Standardised patches, the frame each comes from, counted through all recordings, and its recording."""

    values: Float[np.ndarray, "n s s"]
    frame: np.ndarray
    recording: np.ndarray


def cut(fields: tuple[Fields, ...], parity: int, seed: int) -> Patches:
    """Non-overlapping patches of every other site of a checkerboard; recordings of one frame and no modelled
    mean are left out. The level of a lit frame is the lamp's, and taken out of each colour."""
    values, frame, recording, number = [], [], [], 0
    for f in fields:
        if not len(f.contrasts):
            continue
        stack = spread_codes(f, np.random.default_rng((seed, f.number)))
        if f.lit:
            stack = _without_level(stack)
        t, h, w = stack.shape
        ny, nx = h // SIDE, w // SIDE
        tiles = stack[:, : ny * SIDE, : nx * SIDE].reshape(t, ny, SIDE, nx, SIDE).transpose(0, 1, 3, 2, 4)
        sites = (np.add.outer(np.arange(ny), np.arange(nx)) % 2) == parity
        chosen = tiles[:, sites]
        values.append(np.clip(chosen.reshape(-1, SIDE, SIDE), -_LIMIT, _LIMIT))
        frame.append(np.repeat(np.arange(t) + number, chosen.shape[1]))
        recording.append(np.full(frame[-1].size, f.number))
        number += t
    if not values:
        return Patches(np.zeros((0, SIDE, SIDE), np.float32), np.zeros(0, int), np.zeros(0, int))
    return Patches(np.concatenate(values), np.concatenate(frame), np.concatenate(recording))


def _without_level(stack: Float[np.ndarray, "t h w"]) -> Float[np.ndarray, "t h w"]:
    for at in SITES:
        part = stack[:, *at]
        part -= part.mean((1, 2), keepdims=True)
    return stack


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


class Network(NamedTuple):
    """The trained layer: weights of every recording, and where the answers of its draws lie."""

    recordings: np.ndarray
    centre: Float[np.ndarray, "r k"]
    spread: Float[np.ndarray, "k"]
    weights: Float[np.ndarray, "r k"]

    def answers(self, patches: Patches) -> Float[np.ndarray, "n k"]:
        """Answers of the filters, counted from the draws of the recording, within bounds."""
        row = np.searchsorted(self.recordings, patches.recording)
        gone = (all_features(patches.values) - self.centre[row]) / self.spread
        return np.clip(gone, -_LIMIT, _LIMIT)

    def scores(self, patches: Patches) -> Float[np.ndarray, "n"]:
        """Scores, larger where a patch looks more like the recordings than like the draws."""
        row = np.searchsorted(self.recordings, patches.recording)
        return np.einsum("nk,nk->n", self.answers(patches), self.weights[row])


def train(real: Patches, fake: Patches) -> Network:
    """Linear discriminant of recordings and draws.

    A recording's own gap between both counts against the mean gap by 1 - expected / seen (positive-part
    James-Stein): of its squared distance from that mean, and of what patches alike in all recordings would
    show by chance.
    """
    numbers = np.unique(fake.recording)
    plain = all_features(fake.values)
    centre = np.stack([plain[fake.recording == n].mean(0) for n in numbers])
    within = plain - centre[np.searchsorted(numbers, fake.recording)]
    network = Network(numbers, centre, np.maximum(within.std(0), 1e-6), np.zeros_like(centre))
    within = np.clip(within / network.spread, -_LIMIT, _LIMIT)
    correlation = np.einsum("nk,nl->kl", within, within) / len(within)
    inverse = np.linalg.inv(correlation + _RIDGE * np.eye(len(correlation)))
    told = network.answers(real)
    gaps = np.stack([told[real.recording == n].mean(0) for n in numbers])
    count, drawn = (np.array([np.sum(p.recording == n) for n in numbers]) for p in (real, fake))
    shared = np.average(gaps, axis=0, weights=count)
    expected = np.einsum("kl,lk->", inverse, correlation) * (1 / count + 1 / drawn)
    seen = np.einsum("rk,kl,rl->r", gaps - shared, inverse, gaps - shared)
    own = np.maximum(1 - expected / np.maximum(seen, 1e-30), 0)
    weights = np.einsum("rk,kl->rl", shared + own[:, None] * (gaps - shared), inverse)
    return network._replace(weights=weights)
