"""How well a simulator describes frames that it has not seen: the same measures before and after.

All compare recordings with draws of the simulator at equal settings, both seen through the same baseline:
histogram divergence with its floor, probability integral transform, spectra of row and column means,
neighbour covariances, photon-transfer curve, a composite score per frame, and a two-sample test.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.draws import as_fields, draw_like, spread_codes
from cannoise_jax.discovery.heldout import Scored
from cannoise_jax.discovery.patch_network import SIDE
from cannoise_jax.discovery.prove import Proof, Proofs, frame_interval
from cannoise_jax.discovery.sides import Drawings, Sides
from cannoise_jax.discovery.twosample import TwoSample, two_sample
from cannoise_jax.evaluation.kl import kl_divergence, kl_floor
from cannoise_jax.physics.likelihood.composite import Profile, composite_score, profile, ruler
from cannoise_jax.signatures.covariance import LAGS, lag_sums
from cannoise_jax.signatures.fields import Fields, frame_fields, stratum
from cannoise_jax.signatures.line_sums import line_power

_PIT_BINS = 20
_PIT_MOST = 40_000
_LEVEL_BINS = 8
"""Bins of like signal."""
_LEARNED = 400_000
"""Drawn pixels of each recording from which the composite score learns, at least."""
_LEAST_USABLE = 0.05
"""Share of the pixels that must not lie at a rail for a recording to be compared."""


class Curves(NamedTuple):
    """What draws or recordings look like under the baseline.

    row_spectrum, column_spectrum: mean power of the means of rows and columns by cycles per frame; white
    noise: 1. covariance: correlation of a pixel with the one (dy, dx) away, `covariance.LAGS` in order.
    signal, variance: DN and DN^2, points of the photon-transfer curve.
    """

    row_spectrum: Float[np.ndarray, "f"]
    column_spectrum: Float[np.ndarray, "g"]
    covariance: Float[np.ndarray, "l"]
    signal: Float[np.ndarray, "p"]
    variance: Float[np.ndarray, "p"]


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


def compare_models(
    key: Key[Array, ""],
    first: Prepared,
    second: Prepared,
    sides: Sides,
    control_sigma: float | None,
    composite: bool,
) -> Quality | None:
    """A simulator before and after against the frames held back; the network of the two-sample test
    learns on the others.

    control_sigma: row noise that is added to draws of the baseline for the control, DN. composite: whether to
    score the frames by it too. None where no recording shows new noise in both splits.
    """
    plain, extended, control = sides.plain, sides.extended, sides.control
    shown = [
        {f.number for f in p.fields if len(f.contrasts) and f.usable.mean() > _LEAST_USABLE}
        for p in (first, second)
    ]
    names = shown[0] & shown[1]
    if not names:
        return None
    halves = [_only(p, names) for p in (first, second)]
    draws = [plain, control, *([extended] if extended else []), *([] if sides.calibrated else [control])]
    drawn = [
        [draw_like(d(own), half) for half, own in zip(halves, jax.random.split(k), strict=True)]
        for d, k in zip(draws, jax.random.split(key, len(draws)), strict=True)
    ]
    known = set.intersection(*(set(frames) for pair in drawn for frames in pair))
    halves = [_only(p, known) for p in halves]
    if not known:
        return None
    fields = [tuple(as_fields(p, f) for p, f in zip(halves, pair, strict=True)) for pair in drawn]
    real = (halves[0].fields, halves[1].fields)
    tested = None
    if min(real[0][0].mean.shape) >= 2 * SIDE:
        last = fields[2] if extended else None
        seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
        quiet = fields[0] if sides.calibrated else fields[-1]
        tested = two_sample(seed, real, fields[0], last, (fields[1], quiet), control_sigma)  # type: ignore[arg-type]
    judged = []
    for n, draw in ((0, plain), (2, extended)):
        if draw is not None:
            scores = composite_scores(jax.random.fold_in(key, n), halves[1], draw) if composite else None
            judged.append(_side(real[1], fields[n][1], first.span, scores))
    return Quality(judged[0], judged[-1], curves(real[1]), tested, halves[1])


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


def composite_scores(key: Key[Array, ""], half: Prepared, draw: Drawings) -> Float[np.ndarray, "t"]:
    """Composite score of every frame held back, nats per pixel, learned from draws of the simulator: batches
    of as many frames as each recording has, for the mean of a batch is taken out of it."""
    batches: list[tuple[Fields, ...]] = []
    while short := {f.number for f in half.fields if len(batches) * f.frames * f.mean.size < _LEARNED}:
        k = len(batches)
        part = _only(half, short)
        batches.append(as_fields(part, draw_like(draw(jax.random.fold_in(key, k)), part)))
    out = []
    for f in half.fields:
        same = [g for batch in batches for g in batch if g.number == f.number]
        out.append(_composite(f, same))
    return np.concatenate(out)


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
        rest = composite_scores(jax.random.fold_in(key, 2), half, without)
        gain, low, high = frame_interval(full, Scored(rest * pixels, alike, pixels))
        out.append(Proof(proof.score, gain, low, high, int(pixels.sum()), "composite"))
    return Proofs(tuple(out), None, None)


def _average(profiles: list[Profile]) -> Profile:
    """One profile of several batches of equal size."""
    return Profile(
        np.log(np.mean([np.exp(p.log_bins) for p in profiles], axis=0)),
        np.log(np.mean([np.exp(p.log_codes) for p in profiles], axis=0)),
        np.mean([p.correlations for p in profiles], axis=0),
        np.mean([p.mean_squares for p in profiles], axis=0),
    )


def curves(fields: tuple[Fields, ...]) -> Curves:
    """Spectra, covariances and photon-transfer points of residual fields."""
    spectra = {}
    for axis in ("row", "column"):
        size = fields[0].mean.shape[0 if axis == "row" else 1]
        total, number = np.zeros(size // 2 + 1), 0
        for f in fields:
            if len(f.contrasts) and f.mean.shape == fields[0].mean.shape:
                total += line_power(f, f.contrasts, axis)
                number += len(f.contrasts)
        spectra[axis] = total[1:] / max(number, 1)
    score, information = lag_sums(fields, "white")
    points = [point for f in fields for point in _levels(f)]
    signal, variance = np.array(points).T if points else (np.zeros(0), np.zeros(0))
    covariance = score / np.maximum(information, 1e-30)
    assert covariance.size == len(LAGS)
    return Curves(spectra["row"], spectra["column"], covariance, signal, variance)


def _levels(field: Fields) -> list[tuple[float, float]]:
    """Mean signal and mean temporal variance of pixels of like signal, DN."""
    if not len(field.contrasts) or not field.usable.any():
        return []
    chosen = field.usable
    signal = field.signal[chosen]
    variance = (field.contrasts**2).mean(0)[chosen] * field.sigma[chosen] ** 2
    if field.kind != "scene":
        return [(float(signal.mean()), float(variance.mean()))]
    edges = np.quantile(signal, np.linspace(0, 1, _LEVEL_BINS + 1)[1:-1])
    which = np.searchsorted(edges, signal)
    return [
        (float(signal[which == b].mean()), float(variance[which == b].mean()))
        for b in range(_LEVEL_BINS)
        if (which == b).any()
    ]
