"""The photon-transfer curve: gain and read noise against what was stated, its shape, and its end."""

from __future__ import annotations

from functools import partial

import numpy as np

from cannoise_jax.discovery.calibrate import Baseline
from cannoise_jax.discovery.statistics.score import (
    Probe,
    Score,
    chi2_log_sf,
    normal_log_p,
    unchanged,
)


def stated_score(
    fields, *, probe: str, kind: str, baselines: tuple[Baseline, ...], stated: tuple, doubt: float
) -> Score | None:
    """Fitted gain or read noise per channel against the stated one, log ratio; doubt: variance of the
    difference over that of the fit, above 1 where the stated value is itself a fit."""
    u = i = 0.0
    dof = 0
    for baseline, (gain, read) in zip(baselines, stated, strict=True):
        if gain is None:
            continue
        value, error, other = (
            (baseline.gain, baseline.gain_error, gain)
            if kind == "gain"
            else (baseline.read_dn, baseline.read_error, read)
        )
        for c in range(4):
            if error[c] <= 0 or other[c] <= 0:
                continue
            relative = np.sqrt(doubt) * error[c] / value[c]
            difference = float(np.log(value[c] / other[c]))
            dof += 1
            u += difference / relative**2
            i += 1 / relative**2
    if not dof:
        return None
    z = u / np.sqrt(i)
    amplitude, spread = float(np.expm1(u / i)), float(1 / np.sqrt(i))
    return Score(
        probe,
        normal_log_p(z),
        0.5 * z**2,
        5.0,
        abs(amplitude),
        spread,
        spread,
        1,
        {"relative_error": (amplitude, "1", spread)},
        {"axis": "signal", "range": [0.0, 1.0]},
    )


def curve_score(fields, *, probe: str, baselines: tuple[Baseline, ...], step: float) -> Score | None:
    """Temporal variance against signal: what a straight line per channel leaves."""
    chi2, dof, at, worst = 0.0, 0, 0.0, 0.0
    for baseline in baselines:
        for c in range(4):
            levels = [
                p for p in baseline.levels if p.channel == c and p.signal > 4 * step and not p.full and p.sure
            ]
            if len(levels) < 4:
                continue
            model = (
                baseline.read_dn[c] ** 2
                + step**2 / 12
                + baseline.gain[c] * np.array([p.signal for p in levels])
            )
            z = (np.array([p.variance for p in levels]) / model - 1) / np.array(
                [p.error / p.variance for p in levels]
            )
            chi2 += float(np.sum(z**2))
            dof += len(levels) - 1
            k = int(np.argmax(np.abs(z)))
            if abs(z[k]) > abs(worst):
                worst, at = float(z[k]), levels[k].signal
    if dof < 2:
        return None
    gain = 0.5 * max(chi2 - dof, 0.0)
    return Score(
        probe,
        chi2_log_sf(chi2, dof),
        gain,
        7.0,
        float(np.sqrt(max(chi2 / dof - 1, 0))),
        0.0,
        1.0,
        2,
        {},
        {"axis": "signal", "range": [float(at), float(at)], "sign": float(np.sign(worst))},
    )


def saturation_score(
    fields, *, probe: str, baselines: tuple[Baseline, ...], step: float, span: float
) -> Score | None:
    """Collapse of the temporal variance at the highest signals, below the converter's own rail."""
    full = [p for b in baselines for p in b.levels if p.full]
    if not any(len(b.levels) >= 20 for b in baselines):
        return None
    z, value = 0.0, 1.0
    if full:
        baseline = baselines[0]
        low = min(full, key=lambda p: p.signal)
        model = [
            baseline.read_dn[p.channel] ** 2 + step**2 / 12 + baseline.gain[p.channel] * p.signal
            for p in full
        ]
        z = min((p.variance / m - 1) / np.sqrt(2 / p.pixels) for p, m in zip(full, model, strict=True))
        value = low.signal / span
    log_p = min(0.0, normal_log_p(z) + np.log(12)) if full else 0.0
    gain = 0.5 * z**2 * max(len(full), 1)
    return Score(
        probe,
        log_p,
        gain,
        7.0,
        float(value),
        0.02 * value,
        1.0,
        1,
        {"full_well": (value, "1", 0.02 * value)},
        {"axis": "signal", "range": [float(value), 1.0]},
    )


def probes(
    baselines: tuple[Baseline, ...], stated: tuple | None, step: float, span: float, fitted_too: bool = False
) -> tuple[Probe, ...]:
    """The probes of this signature; `stated` gain and read noise per gain setting, None: not judged."""
    out = [
        Probe(
            "variance_curve",
            None,
            {
                "enters": "photons",
                "varies_over": "signal",
                "time": "redrawn",
                "scales": "signal",
                "law": "variance curve",
            },
            partial(curve_score, probe="variance_curve", baselines=baselines, step=step),
            unchanged,
            ("variance_curve",),
        ),
        Probe(
            "saturation",
            "saturation",
            {
                "enters": "pixel",
                "varies_over": "signal",
                "time": "frozen",
                "scales": "signal",
                "law": "ceiling",
            },
            partial(saturation_score, probe="saturation", baselines=baselines, step=step, span=span),
            unchanged,
            (
                "saturation",
                "variance_curve",
                "skewness",
                "curvature",
                "kurtosis",
                "reference_shift",
                "reference_blur",
                "reference_spread",
                "reference_scale",
                "description_scale",
                "scene_static",
            ),
            rare=True,
        ),
    ]
    if stated is not None:
        for kind, name in (("gain", "gain_error"), ("read", "read_noise_error")):
            out.append(
                Probe(
                    f"stated_{kind}",
                    name,
                    {
                        "enters": "readout",
                        "varies_over": "signal",
                        "time": "redrawn",
                        "scales": "signal" if kind == "gain" else "additive",
                        "law": "variance",
                    },
                    partial(
                        stated_score,
                        probe=f"stated_{kind}",
                        kind=kind,
                        baselines=baselines,
                        stated=stated,
                        doubt=1.5 if fitted_too else 1.0,
                    ),
                    unchanged,
                    (f"stated_{kind}",),
                )
            )
    return tuple(out)
