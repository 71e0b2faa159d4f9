"""Levels of the darks: black level and dark current."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.discovery.fields import Fields, channel_index
from cannoise_jax.discovery.statistics.means import Described
from cannoise_jax.discovery.statistics.score import (
    Probe,
    Score,
    chi2_log_sf,
    student_log_p,
    unchanged,
)

_DARK = ("dark", "bias")


def dark_levels(fields: tuple[Fields, ...]) -> list[tuple[Fields, np.ndarray, float]]:
    """Of every dark: its level per channel, DN, and the standard error of one."""
    out = []
    for f in fields:
        if f.kind in _DARK:
            channel = channel_index(f.mean.shape)
            level = np.array([float(f.mean[channel == c].mean()) for c in range(4)])
            out.append((f, level, float(np.median(f.sigma)) / np.sqrt(f.frames * f.mean.size / 4)))
    return out


def jitter_freedom(fields: tuple[Fields, ...], jitter: float, error: float) -> float:
    """Degrees of freedom of a standard error made of pixel noise, which is known, and of frame jitter."""
    frames = sum(len(f.contrasts) for f in fields if f.kind in _DARK)
    share = jitter / max(jitter + error, 1e-30)
    return frames / max(share, 1e-3) ** 2


def frame_jitter(fields: tuple[Fields, ...]) -> float:
    """Variance of the frame offsets of the darks beyond pixel noise, DN^2; 0 when there is none to be
    seen."""
    excess, number = 0.0, 0
    for f in fields:
        if f.kind in _DARK and len(f.contrasts):
            u = np.einsum("nij,ij->n", f.contrasts, f.weight.astype(np.float32))
            i = float(np.sum(f.weight.astype(np.float64) ** 2))
            excess += float(np.sum((u / i) ** 2 - 1 / i))
            number += len(u)
    return max(excess / number, 0.0) if number else 0.0


def channel_score(
    fields: tuple[Fields, ...], *, probe: str, described: Described, common: bool, jitter: float
):
    """Black level against the stated one: what channels share (bookkeeping) or differ in (channel offset)."""
    levels = dark_levels(fields)
    if not levels:
        return None
    shortest = min((f.exposure_s or 0.0) for f, _, _ in levels)
    chosen = [(f, level, e) for f, level, e in levels if (f.exposure_s or 0.0) == shortest]
    weight = np.array([1 / e**2 for _, _, e in chosen])
    error = float(1 / np.sqrt(weight.sum()))
    difference = np.average([level for _, level, _ in chosen], axis=0, weights=weight) - described.black
    frames = sum(f.frames for f, _, _ in chosen)
    if common:
        # A level stated to the nearest code may be off by half a code; the frame offsets scatter the mean.
        slack = described.tolerance
        spread = np.sqrt(error**2 / 4 + jitter / frames)
        value = float(difference.mean())
        z = np.sign(value) * max(abs(value) - slack, 0.0) / spread
        return Score(
            probe,
            student_log_p(z, jitter_freedom(fields, jitter / frames, error**2 / 4)),
            0.5 * z**2,
            5.0,
            abs(value),
            float(spread),
            float(spread),
            1,
            {"black_level_error": (value, "DN", float(spread))},
            {"axis": "channel", "channel": "all"},
            value,
        )
    contrast = difference - difference.mean()
    slack = described.tolerance if np.ptp(described.black) > 0 else 0.0
    reduced = np.sign(contrast) * np.maximum(np.abs(contrast) - slack, 0)
    chi2 = float(np.sum((reduced / error) ** 2))
    rms = float(np.sqrt(np.mean(contrast**2)))
    spread = error / 2
    return Score(
        probe,
        chi2_log_sf(chi2, 3),
        chi2 / 2,
        7.0,
        float(np.sqrt(max(rms**2 - 0.75 * error**2, 0))),
        spread,
        spread,
        1,
        {f"offset_{c}": (float(contrast[c]), "DN", error) for c in range(4)},
        {"axis": "channel", "channel": int(np.argmax(np.abs(contrast)))},
        contrast,
    )


def dark_current_score(fields: tuple[Fields, ...], *, probe: str, jitter: float) -> Score | None:
    """Level of the darks against their exposure."""
    levels = [(f, level, e) for f, level, e in dark_levels(fields) if f.exposure_s is not None]
    if len({f.exposure_s for f, _, _ in levels}) < 2:
        return None
    t = np.array([f.exposure_s for f, _, _ in levels], float)
    y = np.array([level.mean() for _, level, _ in levels])
    v = np.array([e**2 / 4 + jitter / f.frames for f, _, e in levels])
    centre = np.average(t, weights=1 / v)
    i = float(np.sum((t - centre) ** 2 / v))
    slope = float(np.sum((t - centre) * y / v)) / i
    gain = float(np.mean(fields[0].gain))
    z = slope * np.sqrt(i)
    # Frame offsets leave few degrees of freedom for their own variance.
    error = float(1 / np.sqrt(i)) / gain
    return Score(
        probe,
        student_log_p(z, jitter_freedom(fields, jitter, levels[0][2] ** 2 * levels[0][0].frames / 4), 1),
        0.5 * z**2 if z > 0 else 0.0,
        5.0,
        max(slope / gain, 0.0),
        error,
        error,
        1,
        {"dark_current": (slope / gain, "e-/s", error)},
        {"axis": "frame", "recordings": [f.name for f, _, _ in levels]},
        slope,
    )


def probes(described: Described, jitter: float) -> tuple[Probe, ...]:
    """The probes of this signature, for what the files of one capture set say."""
    frozen = {"time": "frozen", "enters": "readout"}
    return (
        Probe(
            "black_level",
            "bookkeeping",
            {**frozen, "varies_over": "channel", "scales": "additive", "law": "common"},
            partial(channel_score, probe="black_level", described=described, common=True, jitter=jitter),
            unchanged,
            ("black_level", "reference_scale", "description_scale"),
            rare=True,
        ),
        Probe(
            "black_channels",
            "channel_offset",
            {**frozen, "varies_over": "channel", "scales": "additive", "law": "contrast"},
            partial(channel_score, probe="black_channels", described=described, common=False, jitter=jitter),
            unchanged,
            ("black_channels",),
        ),
        Probe(
            "dark_level",
            "dark_current",
            {**frozen, "enters": "pixel", "varies_over": "frame", "scales": "exposure", "law": "mean"},
            partial(dark_current_score, probe="dark_level", jitter=jitter),
            unchanged,
            ("dark_level",),
        ),
    )
