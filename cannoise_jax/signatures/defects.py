"""Pixels that the light does not reach, and pixels that the camera painted over.

Dead pixels stay at the black level in every lit recording. The part of the signal that they miss is all of
it, where a spread of responses misses a per cent: the two are many standard deviations of the spread apart.

A corrected pixel is the mean of some of its neighbours: minus that mean nothing but rounding is left of it,
in every contrast between frames. Normal noise leaves as much as the pixel itself holds, and more.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage, stats

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.hot import without_pixels
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.rare import sparse_log_p
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import LEAST_LOG_P, SHARE_OF_FEW, Score
from cannoise_jax.signatures.signature import CONTRASTS, COVERS_NOTHING, STATIC, Axes, Signature

LOST = 0.75
"""Share of the signal that a dead pixel misses at least: charge of its neighbours reaches it, and pixels that
are half covered miss a half."""
_CLEAR = 8.0
"""Standard deviations of the spread of the responses that this share must be."""
_RUN, _WIDE = 32, 3
"""Pixels of a dead row or column from which on it is one, and across it from which on it is none."""
_COARSE = 0.8
"""Noise, codes, below which rounding hides whether a pixel is the mean of its neighbours."""
_MOST_LISTED = 0.15
"""Share of the pixels beyond which a correction is a lattice: interpolation of the mosaic."""

KERNELS: dict[str, tuple[tuple[int, int], ...]] = {
    "four": ((-2, 0), (2, 0), (0, -2), (0, 2)),
    "row": ((0, -2), (0, 2)),
    "column": ((-2, 0), (2, 0)),
    "eight": tuple((y, x) for y in (-2, 0, 2) for x in (-2, 0, 2) if y or x),
    "left": ((0, -2),),
    "right": ((0, 2),),
    "median of eight": tuple((y, x) for y in (-2, 0, 2) for x in (-2, 0, 2) if y or x),
}
"""Neighbours of the same colour whose mean is put in a pixel's place."""
MONO_KERNELS: dict[str, tuple[tuple[int, int], ...]] = {
    "next_four": ((-1, 0), (1, 0), (0, -1), (0, 1)),
    "next_row": ((0, -1), (0, 1)),
    "next_column": ((-1, 0), (1, 0)),
    "next_eight": tuple((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x),
    "next_left": ((0, -1),),
}

MEANS = KERNELS | MONO_KERNELS
"""All of them; a camera model names one by its place here, from 1 on."""

_BESIDE_MEAN = {"median of eight": 0.09}
"""Variance of what is put there about the mean of the same neighbours, over that of a pixel."""


def _responses(fields: tuple[Fields, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Smallest share of the signal missed by each pixel over all lit recordings (below 0: a gain), how many
    recordings tell, and the sum of squares of what it misses in standard deviations."""
    size = fields[0].mean.shape
    least, seen, power = np.full(size, np.inf), np.zeros(size, int), np.zeros(size)
    for f in fields:
        if not f.lit or f.static is None:
            continue
        root = np.sqrt(f.frames) * f.signal / f.sigma
        tells = f.usable & (root * LOST > 10)
        share = -f.static / np.maximum(root, 1e-6)
        centre = median(share[tells]) if tells.any() else 0.0
        least = np.where(tells, np.minimum(least, share - centre), least)
        seen += tells
        power += np.where(tells, np.minimum(f.static, 0.0) ** 2, 0.0)
    return (least, seen, power) if seen.any() else None


def find_dead(fields: tuple[Fields, ...]) -> np.ndarray | None:
    """Pixels that miss most of the light wherever it fell; None where no recording tells."""
    found = _responses(fields)
    if found is None:
        return None
    least, seen, _ = found
    known = seen > 0
    spread = max(robust_std(least[known]), 1e-4)
    dead = known & (least > LOST) & (least > _CLEAR * spread)
    # An edge where the reference is off is dark along a line, dust over an area; a dead pixel stands alone.
    lines = _dead_lines(dead) if not any(f.kind == "scene" for f in fields) else np.zeros(dead.shape, bool)
    single = dead & ~lines
    around = ndimage.convolve(single.astype(np.int16), np.ones((5, 5), np.int16), mode="constant") - single
    return lines | single & (around <= max(3, 100 * float(single.mean())))


def _dead_lines(dead: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Those in straight runs along a row or column, no wider than a line and its neighbour: no shadow has two
    edges so near."""
    out = np.zeros(dead.shape, bool)
    for along in (0, 1):
        run = [1, 1]
        run[along] = min(_RUN, dead.shape[along])
        line = ndimage.binary_opening(dead, np.ones(run))
        run[1 - along] = _WIDE
        out |= line & ~ndimage.binary_opening(line, np.ones(run))
    return out


def dead_score(fields: tuple[Fields, ...]) -> Score | None:
    """A few pixels at the black level in every lit recording. Amplitude: their share."""
    dead = find_dead(fields)
    if dead is None:
        return None
    found = _responses(fields)
    assert found is not None
    pixels, number = int((found[1] > 0).sum()), int(dead.sum())
    share = number / pixels
    unit = 1.0 / pixels
    log_p = float(stats.poisson.logsf(number - 1, pixels * stats.norm.sf(_CLEAR) + 0.01)) if number else 0.0
    gain = float(np.sum(0.5 * found[2][dead] - np.log(pixels)))
    high = np.argwhere(dead)[:8]
    return Score(
        log_p=max(log_p, LEAST_LOG_P),
        gain=max(gain, 0.0),
        penalty=SHARE_OF_FEW,
        amplitude=share,
        error=float(np.sqrt(max(number, 1))) * unit,
        shift=unit,
        power=1,
        parameters={"fraction": (share, "1", float(np.sqrt(max(number, 1))) * unit)},
        where={"axis": "pixel", "index": high.tolist(), "pixels": number},
    )


def without_dead(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """The fields without the dead pixels."""
    dead = find_dead(fields)
    return fields if dead is None else without_pixels(fields, dead)


def _left_over(contrasts: Float[np.ndarray, "n h w"], kernel: tuple[tuple[int, int], ...]):
    """Every contrast minus the mean of some of its neighbours."""
    mean = sum(np.roll(contrasts, (-dy, -dx), (1, 2)) for dy, dx in kernel)
    return contrasts - np.float32(1 / len(kernel)) * mean


def _likelihood(fields: tuple[Fields, ...], name: str) -> np.ndarray | None:
    """Log likelihood ratio `[h, w]` of every pixel: the mean of these neighbours over a pixel of its own."""
    total, any_seen = np.zeros(fields[0].mean.shape), False
    kernel = {**KERNELS, **MONO_KERNELS}[name]
    for f in fields:
        codes = f.sigma / f.step
        if not len(f.contrasts) or median(codes) < _COARSE:
            continue
        # Noise of neighbours of another signal is another in units of their own.
        values = f.contrasts * (f.sigma / f.step)
        rest = _left_over(values, kernel)
        power = np.einsum("nij,nij->ij", rest, rest) / codes**2
        n = len(f.contrasts)
        typical = float(median(power[f.usable])) / (n * median_quotient(n)) if f.usable.any() else 0.0
        own = np.broadcast_to((1 / 12 + 0.02) / codes**2 + _BESIDE_MEAN.get(name, 0.0), power.shape)
        if typical < 0.1:
            continue
        log = 0.5 * n * np.log(typical / own) - 0.5 * power * (1 / own - 1 / typical)
        total += np.where(f.usable, np.clip(log, -60.0, 60.0), 0.0)
        any_seen = True
    if not any_seen:
        return None
    total[:2], total[-2:], total[:, :2], total[:, -2:] = -60, -60, -60, -60
    return total


def _kernels(mono: bool) -> dict[str, tuple[tuple[int, int], ...]]:
    return {**KERNELS, **MONO_KERNELS} if mono else KERNELS


_START = 0.005
"""Share of the pixels from which that of the corrected ones is fitted: from a tenth or ten times as many 30
rounds end at the same to 1e-14, on sets of 96 x 128 pixels."""


def find_corrected(fields: tuple[Fields, ...], mono: bool) -> tuple[str, float, np.ndarray] | None:
    """The neighbours that explain most pixels, their share of all, and the log likelihood ratio of each."""
    best: tuple[str, float, np.ndarray] | None = None
    most = -np.inf
    for name in _kernels(mono):
        ratio = _likelihood(fields, name)
        if ratio is None:
            continue
        share, against = _START, np.exp(-np.clip(ratio, -60, 60))
        for _ in range(30):
            chance = share / (share + (1 - share) * against)
            share = float(np.clip(np.mean(chance), 1e-7, 0.9))
        gain = float(np.sum(np.log1p(share * np.expm1(np.clip(ratio, -60, 300)))))
        if gain > most:
            most, best = gain, (name, share, ratio)
    return best


def corrected_score(fields: tuple[Fields, ...], *, mono: bool) -> Score[str] | None:
    """A few listed pixels that hold the mean of their neighbours. Amplitude: their share."""
    best = find_corrected(fields, mono)
    if best is None:
        return None
    name, share, ratio = best
    inner = np.minimum(ratio[2:-2, 2:-2].ravel(), 300.0)
    gain = float(np.sum(np.log1p(share * np.expm1(inner))))
    log_p = sparse_log_p(np.ones(inner.size), [inner]) + np.log(len(_kernels(mono)))
    # What the neighbours of another pixel explain as often is nothing that was put there.
    number = int((inner > 12).sum())
    if share > _MOST_LISTED or number < 3:
        log_p = 0.0
    error = float(np.sqrt(max(share, 1 / inner.size) / inner.size))
    return Score(
        log_p=float(np.clip(log_p, LEAST_LOG_P, 0.0)),
        gain=max(gain, 0.0),
        penalty=float(np.log(inner.size)),
        amplitude=share,
        error=error,
        shift=1 / inner.size,
        power=1,
        parameters={"fraction": (share, "1", error)},
        where={
            "axis": "pixel",
            "index": np.argwhere(ratio > 12)[:8].tolist(),
            "pixels": number,
            "from": name,
        },
        payload=name,
    )


def without_corrected(fields: tuple[Fields, ...], score: Score[str]) -> tuple[Fields, ...]:
    """The fields without the pixels that were painted over."""
    ratio = _likelihood(fields, score.payload)
    return fields if ratio is None else without_pixels(fields, ratio > 2.0)


_SURELY = 5.0
"""Log likelihood ratio, nats, from which a camera model has a pixel as the mean of its neighbours."""


def dead(*, name: str, lifted_by: tuple[str, ...]) -> Signature:
    """Pixels that miss most of the light."""

    def pattern(fields: tuple[Fields, ...], score: Score[str], rng: np.random.Generator) -> np.ndarray | None:
        found = find_dead(fields)
        return None if found is None else found.astype(np.float32)

    return plain(
        name=name,
        axes=Axes("photons", "pixel", "frozen", "signal", "sparse"),
        reads=STATIC | {"signal"},
        score=dead_score,
        absorb=without_dead,
        covers=COVERS_NOTHING,
        pattern=pattern,
        simulate=carried(lambda s: {"fraction": s.amplitude}, "dead"),
        lifted_by=lifted_by,
        rare=True,
    )


def corrected(recorded: Recorded, *, name: str, lifted_by: tuple[str, ...]) -> Signature:
    """Pixels that are the mean of their neighbours."""

    def pattern(fields: tuple[Fields, ...], score: Score[str], rng: np.random.Generator) -> np.ndarray | None:
        ratio = _likelihood(fields, score.payload)
        kernel = 1 + list(MEANS).index(score.payload)
        return None if ratio is None else kernel * (ratio > _SURELY).astype(np.float32)

    return plain(
        name=name,
        axes=Axes("digital", "pixel", "frozen", "all noise", "sparse"),
        reads=CONTRASTS,
        score=partial(corrected_score, mono=recorded.mono),
        absorb=without_corrected,
        covers=COVERS_NOTHING,
        pattern=pattern,
        simulate=carried(lambda s: {"fraction": s.amplitude}, "sites"),
        lifted_by=lifted_by,
        rare=True,
    )
