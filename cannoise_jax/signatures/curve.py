"""The photon-transfer curve: gain and read noise against what was stated, its shape, and its end."""

from __future__ import annotations

from functools import partial
from typing import Literal

import numpy as np

from cannoise_jax.signatures.handed import Addition
from cannoise_jax.signatures.recorded import GroupBaseline, Recorded, Stated
from cannoise_jax.signatures.score import (
    OF_A_CURVE,
    ONE_PARAMETER,
    Score,
    chi2_log_sf,
    normal_log_p,
)
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    FILES,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NO_STRENGTH,
    NOT_SIMULATED,
    Axes,
    Signature,
    unchanged,
)

VARIANCE_CURVE = "variance curve"
"""Law of a variance that follows no straight line over the signal."""


def stated_score(
    fields,
    *,
    kind: str,
    baselines: tuple[GroupBaseline, ...],
    stated: tuple[Stated | None, ...],
    charge: tuple[float, ...],
) -> Score | None:
    """Fitted gain or read noise per channel against the stated one, log ratio. charge: variance of dark
    charge in the fitted read noise that is not in the stated one, DN^2."""
    u = i = 0.0
    dof = 0
    for baseline, said, more in zip(baselines, stated, charge, strict=True):
        if said is None:
            continue
        value, error, other, doubt = baseline.gain, baseline.gain_stderr, said.gain, said.gain_stderr
        if kind == "read":
            # Never less than a tenth of it: the charge is a fit as well.
            least = (0.1 * baseline.read_noise) ** 2
            value = np.sqrt(np.maximum(baseline.read_noise**2 - more, least))
            error = baseline.read_stderr * baseline.read_noise / value
            other, doubt = said.read_noise, said.read_stderr
        for c in range(4):
            if error[c] <= 0 or other[c] <= 0:
                continue
            relative = float(np.hypot(error[c] / value[c], doubt[c] / other[c]))
            difference = float(np.log(value[c] / other[c]))
            dof += 1
            u += difference / relative**2
            i += 1 / relative**2
    if not dof:
        return None
    z = u / np.sqrt(i)
    amplitude, spread = float(np.expm1(u / i)), float(1 / np.sqrt(i))
    return Score(
        log_p=normal_log_p(z),
        gain=0.5 * z**2,
        penalty=ONE_PARAMETER,
        amplitude=abs(amplitude),
        error=spread,
        shift=spread,
        power=1,
        parameters={"relative_error": (amplitude, "1", spread)},
        where={"axis": "signal", "range": [0.0, 1.0]},
        too_much=amplitude < 0,
    )


_FEWEST = 3
"""Levels of light from which on a straight line through that of the darks can be missed by their order."""


def curve_score(fields, *, baselines: tuple[GroupBaseline, ...], step: float) -> Score | None:
    """Temporal variance against signal: what a straight line per channel leaves. Amplitude: rms relative
    departure of the variance from it, beyond chance."""
    chi2, dof, at, worst = 0.0, 0, 0.0, 0.0
    squares: list[float] = []
    errors: list[float] = []
    for baseline in baselines:
        for c in range(4):
            levels = [
                p for p in baseline.levels if p.channel == c and p.signal > 4 * step and not p.full and p.sure
            ]
            if len(levels) < _FEWEST:
                continue
            model = (
                baseline.read_noise[c] ** 2
                + step**2 / 12
                + baseline.gain[c] * np.array([p.signal for p in levels])
            )
            off = np.array([p.variance for p in levels]) / model - 1
            error = np.array([p.error / p.variance for p in levels])
            z = off / error
            squares += (off**2).tolist()
            errors += (error**2).tolist()
            chi2 += float(np.sum(z**2))
            dof += len(levels) - 1
            k = int(np.argmax(np.abs(z)))
            if abs(z[k]) > abs(worst):
                worst, at = float(z[k]), levels[k].signal
    if dof < 2:
        return None
    gain = 0.5 * max(chi2 - dof, 0.0)
    return Score(
        log_p=chi2_log_sf(chi2, dof),
        gain=gain,
        penalty=OF_A_CURVE,
        amplitude=float(np.sqrt(max(float(np.mean(squares) - np.mean(errors)), 0.0))),
        error=float(np.sqrt(np.mean(errors) / 2 / len(errors))),
        shift=float(np.sqrt(np.mean(errors) * np.sqrt(2 / dof))),
        power=2,
        parameters={},
        where={"axis": "signal", "range": [float(at), float(at)], "sign": float(np.sign(worst))},
    )


_CURVE = 12
"""Points of a curve, of four channels together, from which on it can be missed: darks and two levels."""


def saturation_score(
    fields, *, baselines: tuple[GroupBaseline, ...], step: float, span: float
) -> Score | None:
    """Collapse of the temporal variance at the highest signals, below the converter's own rail."""
    full = [p for b in baselines for p in b.levels if p.full]
    if not any(len(b.levels) >= _CURVE for b in baselines):
        return None
    z, value = 0.0, 1.0
    if full:
        baseline = baselines[0]
        low = min(full, key=lambda p: p.signal)
        model = [
            baseline.read_noise[p.channel] ** 2 + step**2 / 12 + baseline.gain[p.channel] * p.signal
            for p in full
        ]
        z = min((p.variance / m - 1) / np.sqrt(2 / p.pixels) for p, m in zip(full, model, strict=True))
        value = low.signal / span
    log_p = min(0.0, normal_log_p(z) + np.log(12)) if full else 0.0
    gain = 0.5 * z**2 * max(len(full), 1)
    return Score(
        log_p=log_p,
        gain=gain,
        penalty=OF_A_CURVE,
        amplitude=float(value),
        error=0.02 * value,
        shift=1.0,
        power=1,
        parameters={"full_well": (value, "1", 0.02 * value)},
        where={"axis": "signal", "range": [float(value), 1.0]},
    )


def _files(**fields) -> Signature:
    """A signature of the photon-transfer curve, which nothing that is taken out of the fields changes."""
    return Signature(
        reads=FILES,
        absorb=unchanged,
        predict=NO_LAW,
        pattern=NO_PATTERN,
        place=NO_PLACE,
        least=NO_CLOSED_FORM,
        **fields,
    )


def bent(recorded: Recorded, *, name: str, covers: tuple[str, ...]) -> Signature:
    """A variance that does not follow a straight line."""
    return _files(
        name=name,
        axes=Axes("photons", "signal", "redrawn", "signal", VARIANCE_CURVE),
        score=partial(curve_score, baselines=recorded.baselines, step=recorded.step),
        covers=covers,
        simulate=NOT_SIMULATED,
        detectable=BY_SHIFT,
    )


def ceiling(recorded: Recorded, *, name: str, parameter: str, covers: tuple[str, ...]) -> Signature:
    """Pixels that are full below the converter's own rail."""
    return _files(
        name=name,
        axes=Axes("pixel", "signal", "frozen", "signal", "ceiling"),
        score=partial(saturation_score, baselines=recorded.baselines, step=recorded.step, span=recorded.span),
        covers=covers,
        rare=True,
        simulate=lambda found: Addition({parameter: found.score.amplitude * found.span / found.gain}),
        detectable=NO_STRENGTH,
    )


def restated(
    recorded: Recorded, kind: Literal["gain", "read"], *, name: str, covers: tuple[str, ...]
) -> tuple[Signature, ...]:
    """A gain or read noise other than the stated one; nothing where none is judged."""
    if recorded.stated is None:
        return ()
    return (
        _files(
            name=name,
            axes=Axes("readout", "signal", "redrawn", "signal" if kind == "gain" else "additive", "variance"),
            score=partial(
                stated_score,
                kind=kind,
                baselines=recorded.baselines,
                stated=recorded.stated,
                charge=recorded.charge,
            ),
            covers=covers,
            simulate=NOT_SIMULATED,
            detectable=BY_SHIFT,
            restates=kind,
            beyond=recorded.fitted_too,
        ),
    )
