"""Pixels whose level stands out in the darks: hot ones."""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy import special, stats

from cannoise_jax.discovery.fields import Fields
from cannoise_jax.discovery.statistics.patterns import pixel_sums
from cannoise_jax.discovery.statistics.score import Probe, Score
from cannoise_jax.discovery.statistics.shape import DARK

_SHARES = (2e-5, 1e-4, 5e-4, 2e-3)


def sparse_log_p(counts: np.ndarray, log_ratios: list[np.ndarray]) -> float:
    """log p that a few values follow another law: log_ratios holds, for several sizes of the effect, the log
    of its density over the null's at the values. The likelihood ratio averaged over sizes and shares has mean
    one under the null, so its inverse is a p-value (Markov)."""
    logs = [
        float(np.sum(counts * np.log1p(share * np.expm1(np.minimum(ratio, 600.0)))))
        for ratio in log_ratios
        for share in _SHARES
    ]
    return min(0.0, float(np.log(len(logs)) - special.logsumexp(logs)))


def hot_score(fields: tuple[Fields, ...], *, probe: str, scaling: str) -> Score | None:
    """A few pixels far above the others in the darks, at the same places in every frame."""
    sums = pixel_sums(fields, scaling, DARK)
    if sums is None:
        return None
    seen = sums.information > 0
    u = np.where(seen, sums.score / np.sqrt(np.where(seen, sums.information, 1.0)), 0.0).ravel()
    spread = max(1.4826 * float(np.median(np.abs(u - np.median(u)))), 1.0)
    number = int(np.sum(u > 4.6 * spread))
    ratios = []
    root = float(np.sqrt(np.median(sums.information[seen])))
    best, at, share = 0.0, 1.0, 0.0
    counts, edges = np.histogram(np.clip(u / spread, -20, 400), np.linspace(-20, 400, 8401))
    used = counts > 0
    counts, centre = counts[used], ((edges[1:] + edges[:-1]) / 2)[used]
    root /= spread
    for mean in np.exp(np.linspace(np.log(1.5), np.log(200), 14)):
        # Density of normal + exponential over the normal density.
        log_ratio = (
            0.5 / mean**2
            - centre / mean
            - np.log(mean)
            + stats.norm.logcdf(centre - 1 / mean)
            - stats.norm.logpdf(centre)
        )
        log_ratio = np.clip(log_ratio, -50, 600)
        ratios.append(log_ratio)
        f = 1e-3
        for _ in range(40):
            responsibility = f * np.exp(log_ratio) / (1 - f + f * np.exp(log_ratio))
            f = float(np.clip(np.sum(counts * responsibility) / counts.sum(), 1e-7, 0.2))
        gain = float(np.sum(counts * np.log1p(f * np.expm1(log_ratio))))
        if gain > best:
            best, at, share = gain, float(mean), f
    seconds = (
        float(np.max([f.exposure_s or 1.0 for f in fields if f.kind in DARK]))
        if scaling == "thermal"
        else 1.0
    )
    amplitude = at / root * np.sqrt(2 * share) * seconds
    events = max(share * u.size, 1.0)
    high = [int(k) for k in np.argsort(-u)[:8]]
    width = fields[0].mean.shape[1]
    return Score(
        probe,
        max(sparse_log_p(counts, ratios), -700.0),
        best,
        float(np.log(u.size)) + 2,
        float(amplitude),
        float(amplitude / np.sqrt(events)),
        float(seconds / root / np.sqrt(np.sqrt(u.size / 2))),
        2,
        {"fraction": (share, "1", float(np.sqrt(share / u.size)))},
        {"axis": "pixel", "index": [[k // width, k % width] for k in high], "pixels": number},
        scaling,
    )


def mask_hot(fields: tuple[Fields, ...], score: Score) -> tuple[Fields, ...]:
    """Takes the pixels whose level stands out in the darks out of every field."""
    out = np.zeros(fields[0].mean.shape, bool)
    for scaling in ("additive", "thermal"):
        sums = pixel_sums(fields, scaling, DARK)
        if sums is not None:
            out |= np.abs(sums.score / np.sqrt(np.maximum(sums.information, 1e-30))) > 4.0
    return without_pixels(fields, out)


def without_pixels(fields: tuple[Fields, ...], out: np.ndarray) -> tuple[Fields, ...]:
    """The fields without some of their pixels."""
    keep = ~out
    return tuple(
        f._replace(
            usable=f.usable & keep,
            contrasts=f.contrasts * keep,
            static=None if f.static is None else f.static * keep,
        )
        for f in fields
    )


def probes() -> tuple[Probe, ...]:
    """The probes of this signature."""
    pixel = {"enters": "readout", "varies_over": "pixel", "scales": "additive"}
    return (
        Probe(
            "hot_additive",
            "hot_pixels",
            {**pixel, "time": "frozen", "law": "sparse"},
            partial(hot_score, probe="hot_additive", scaling="additive"),
            mask_hot,
            ("hot_thermal",),
            rare=True,
        ),
        Probe(
            "hot_thermal",
            "hot_pixels",
            {**pixel, "time": "frozen", "scales": "exposure", "law": "sparse"},
            partial(hot_score, probe="hot_thermal", scaling="thermal"),
            mask_hot,
            ("hot_additive",),
            rare=True,
        ),
    )
