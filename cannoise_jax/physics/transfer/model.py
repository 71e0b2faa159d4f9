"""From photon transfer and the estimators to a camera model: which mechanisms are there, and how strong.

A mechanism enters the model when its 90 % interval leaves out zero, chance shows as much less than three
times in ten thousand (`Estimate.chance`: for the root of a variance that of the variance, for a wave that of
the strongest of all frequencies), and it is large enough to matter: an additive one 2 % of the noise of a
pixel (0.04 % of its variance) at the setting that shows it best, others as `_LEAST` lists. Where several
explain the same data only one enters: pink or white row noise by whether rows far apart are alike, and the
place of white rows by whether several are read together and even and odd columns apart; heavy tails, a spread
of read noise over the pixels and telegraph pixels by which of them, or which together, explain the values of
the pixels best (`estimators.loudness`). What belongs to the light, or is in the baseline already, is reported
but does not enter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.ranges import clipped
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.black import black_level
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimators import ESTIMATORS
from cannoise_jax.physics.transfer.estimators.lines import columns_apart, row_groups
from cannoise_jax.physics.transfer.estimators.loudness import LOUD, explanation
from cannoise_jax.physics.transfer.estimators.maps import pixel_read_noise_map
from cannoise_jax.physics.transfer.estimators.noise import telegraph_sites
from cannoise_jax.physics.transfer.estimators.pick import darkest, darks_by_exposure, row_offsets
from cannoise_jax.physics.transfer.estimators.spectra import chance_beside_half, power_law_correlation
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.maps import with_measured_maps, without_charge, without_repetition
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.vocabulary import VOCABULARY

Verdict = Literal[
    "in the model",
    "not significant",
    "too small to matter",
    "not measurable",
    "explained by",
    "reported only",
]

_IN_BASELINE = ("gain_error", "read_noise_error", "quantization")
_CHANCE = 3e-4
_GAUSSIAN = 0.135  # Tukey's lambda of a Gaussian
_LEAST_SHARE = 0.02
"""Of a pixel's noise in the dark: what an additive mechanism must have, rms or peak."""
_LEAST = {
    "prnu": 1e-3,
    "column_gain": 3e-4,
    "green_imbalance": 1e-3,
    "nonlinearity": 3e-3,
    "crosstalk": 5e-3,
    "in_camera_denoising": 0.01,
    "pixel_read_noise_map": 0.03,
    "heavy_tails": 0.02,
}
"""Least strength of the others, in their own unit: a tenth of what cameras usually have, and what moves the
variance or a correlation of the noise by half a per cent."""
# The second enters only where the first does not.
_RIVALS = (
    ("row_pink_noise", "row_noise"),
    ("hot_pixels", "amp_glow"),
)


class Finding(NamedTuple):
    """What is known of one mechanism. because: the reason of the verdict. point: its place in the grammar,
    where that differs from the usual one."""

    mechanism: str
    estimates: Estimates
    verdict: Verdict
    because: str = ""
    point: Point | None = None


def find_mechanisms(statistics: Sequence[FrameStatistics], baseline: Baseline) -> tuple[Finding, ...]:
    """All estimators on the recordings of one setting, in the order of the vocabulary."""
    found: dict[str, Finding] = {}
    for id in VOCABULARY:
        if id in ESTIMATORS and id not in _IN_BASELINE:
            found[id] = _judged(id, ESTIMATORS[id](statistics, baseline), statistics, baseline)
    for first, second in _RIVALS:
        if found[first].verdict == "in the model" and found[second].verdict == "in the model":
            found[second] = found[second]._replace(verdict="explained by", because=first)
    dark = darkest(statistics)
    if dark is not None:
        found |= _causes({id: found[id] for id in LOUD}, dark, statistics)
        if found["row_noise"].verdict == "in the model":
            found["row_noise"] = placed(found["row_noise"], dark)
            found["banding"] = _beside_rows(found["banding"], found["row_noise"].point, dark)
    return tuple(found.values())


def _causes(
    found: Mapping[str, Finding], dark: FrameStatistics, statistics: Sequence[FrameStatistics]
) -> dict[str, Finding]:
    """The findings that make single values loud, those left out that others explain; where several stay, with
    the estimates of all together."""
    rivals = {
        id: f for id, f in found.items()
        if f.verdict == "in the model" and not isinstance(f.estimates, NotMeasurable)
    }  # fmt: skip
    if len(rivals) < 2:
        return {}
    cause = explanation(dark, {id: f.estimates for id, f in rivals.items()})  # type: ignore[misc]
    together = " and ".join(cause.mechanisms)
    out = {}
    for id, finding in rivals.items():
        if id not in cause.mechanisms:
            out[id] = finding._replace(verdict="explained by", because=together)
        elif len(cause.mechanisms) > 1:
            estimates: Estimates = cause.estimates[id]
            if id == "pixel_read_noise_map":  # measured whatever the tails, but not over telegraph pixels
                estimates = finding.estimates
                if "rts" in cause.mechanisms:
                    jumps = {name: e.value for name, e in cause.estimates["rts"].items()}
                    estimates = pixel_read_noise_map(statistics, without=telegraph_sites(dark, **jumps) > 0)
            out[id] = finding._replace(estimates=estimates, because=f"({together} together)")
    return out


def _beside_rows(wave: Finding, rows: Point | None, dark: FrameStatistics) -> Finding:
    """A line, unless rows whose even and odd columns differ make such lines themselves."""
    apart = rows is not None and rows.interleave == 2
    if not apart or wave.verdict != "in the model" or isinstance(wave.estimates, NotMeasurable):
        return wave
    chance = chance_beside_half(dark, wave.estimates["frequency"].value, rows.group)  # type: ignore[union-attr]
    return wave._replace(verdict="explained by", because="row_noise") if chance > _CHANCE else wave


def placed(finding: Finding, dark: FrameStatistics) -> Finding:
    """Row noise with its place in the grammar, where rows are read together or even and odd columns apart."""
    groups, apart = row_groups(dark), columns_apart(dark)
    if (groups is None and not apart) or isinstance(finding.estimates, NotMeasurable):
        return finding
    count, phase = groups or (1, 0)
    said = [f"{count} rows at a time"] if groups else []
    said += ["even and odd columns apart"] if apart else []
    # The mean of a row holds half of the variance of two that have nothing in common.
    sigma = finding.estimates["sigma_dn"].scaled(2**0.5 if apart else 1.0)
    point = Point(
        "readout", "signal", "row", "redrawn", group=count, phase=phase, interleave=2 if apart else 1
    )
    return finding._replace(estimates={"sigma_dn": sigma}, because=f"({', '.join(said)})", point=point)


def sensor_model(transfers: Sequence[PhotonTransfer], findings: Sequence[Finding]) -> SensorModel:
    """The camera model: the baseline of every measured ISO, and the mechanisms found at the first of them,
    with the frozen maps of the unit that was recorded (`transfer_maps`).

    Raises BadInput where no setting has a baseline, with what to record.
    """
    measured = [(t, t.baseline) for t in transfers if isinstance(t.baseline, Baseline)]
    if not measured:
        missing = next(t.baseline for t in transfers if isinstance(t.baseline, NotMeasurable))
        raise BadInput(f"{transfers[0].camera}: no baseline can be measured: {missing.record}")
    (first, base), isos = measured[0], [t.iso for t, _ in measured]
    model = SensorModel.poisson_gaussian(
        np.array([b.gain for _, b in measured]),
        np.array([b.read_noise_e for _, b in measured]),
        base.black_level,
        base.white_level,
        first.cfa,
        iso=tuple(iso if iso is not None else 100.0 for iso in isos),
        code_step=base.code_step,
        camera=first.camera,
    )
    for finding in findings:
        if finding.verdict != "in the model" or isinstance(finding.estimates, NotMeasurable):
            continue
        record = registry.mechanism(finding.mechanism)
        values: dict[str, Any] = clipped(record, {n: e.value for n, e in finding.estimates.items()})
        law = dataclasses.replace(
            record.scaling,
            reference_iso=float(np.asarray(model.iso)[0]),
            reference_temperature_c=_temperature(first.statistics) if record.scaling.doubling_c else None,
            **(_exposures(first.statistics) if record.scaling.exposure else {}),
        )
        model = model.with_mechanism(finding.mechanism, scaling=law, point=finding.point, **values)
    model = without_repetition(with_measured_maps(model, first.statistics, base), first.statistics)
    exposures = [black_level(t.statistics).seconds or 0.0 for t, _ in measured]
    return without_charge(model, exposures, first.statistics[0].recording.size)


def _temperature(statistics: Sequence[FrameStatistics]) -> float | None:
    """The temperature at which thermal charge was measured: of the longest recording that states one, C."""
    known = [s.recording for s in statistics if s.recording.temperature_c is not None]
    return max(known, key=lambda r: r.exposure_s or 0.0).temperature_c if known else None


def _exposures(statistics: Sequence[FrameStatistics]) -> dict[str, float]:
    """The range of exposures of the darks, seconds; empty where none is known."""
    known = [s.recording.exposure_s or 0.0 for s in darks_by_exposure(statistics)]
    return {"exposure_low_s": min(known), "exposure_high_s": max(known)} if known else {}


def format_findings(findings: Sequence[Finding]) -> str:
    """Plain text: one line per parameter, then what could not be measured."""
    from cannoise_jax.physics.transfer.table import aligned, format_outcome

    lines = [["mechanism", "parameter", "unit", "value [90 % interval]", ""]]
    missing: dict[str, list[str]] = {}
    for f in findings:
        if isinstance(f.estimates, NotMeasurable):
            missing.setdefault(f.estimates.record, []).append(f.mechanism)
            continue
        units = {p.name: p.unit for p in registry.mechanism(f.mechanism).parameters}
        for k, (name, estimate) in enumerate(f.estimates.items()):
            verdict = f"{f.verdict}{' ' if f.because else ''}{f.because}" if k == 0 else ""
            lines.append(
                [f.mechanism if k == 0 else "", name, units[name], format_outcome(estimate), verdict]
            )
    out = ["Mechanisms beyond Poisson-Gaussian", ""]
    out += [*aligned(lines), ""] if len(lines) > 1 else []
    if missing:
        out += ["Not measurable:", *(f"  {', '.join(ids)}: {why}" for why, ids in missing.items())]
    return "\n".join(out).rstrip()


def _judged(
    id: str, estimates: Estimates, statistics: Sequence[FrameStatistics], baseline: Baseline
) -> Finding:
    if isinstance(estimates, NotMeasurable):
        return Finding(id, estimates, "not measurable")
    if id == "channel_offset":
        return Finding(id, estimates, "reported only", "(the measured black level is in the baseline)")
    strength = next(iter(estimates.values()))
    if not _strong(id, strength):
        chance = id in ("banding", "flicker") and strength.significant
        said = "(of so many frequencies chance alone makes one as strong)" if chance else ""
        return Finding(id, estimates, "not significant", said)
    if VOCABULARY[id].kind != "sensor":
        return Finding(id, estimates, "reported only", "(not of the sensor)")
    if id == "row_pink_noise" and not _reaches_far(estimates["exponent"], statistics):
        return Finding(
            id, estimates, "not significant", "(rows are not alike over distance, as 1/f would be)"
        )
    if id == "heavy_tails" and strength.value > _GAUSSIAN:
        return Finding(id, estimates, "not significant", "(no heavier than a Gaussian)")
    if not _matters(id, estimates, statistics, baseline):
        return Finding(id, estimates, "too small to matter")
    return Finding(id, estimates, "in the model")


def _matters(
    id: str, estimates: Mapping[str, Estimate], statistics: Sequence[FrameStatistics], baseline: Baseline
) -> bool:
    """Whether the strength reaches what the module's docstring asks for."""
    strength = next(iter(estimates.values())).value
    if id in _LEAST:
        return abs(strength - (_GAUSSIAN if id == "heavy_tails" else 0.0)) >= _LEAST[id]
    record, dn = registry.mechanism(id), abs(strength)
    if record.scaling.exposure:  # e-/s
        longest = max((s.recording.exposure_s or 0.0 for s in darks_by_exposure(statistics)), default=0.0)
        dn *= longest * float(np.mean(baseline.gain))
    elif record.parameters[0].unit != "DN":
        return True
    if "fraction" in estimates:
        dn *= float(np.sqrt(estimates["fraction"].value))
    return dn >= _LEAST_SHARE * float(np.mean(baseline.read_noise))


def _strong(id: str, strength: Estimate) -> bool:
    if id in ("missing_codes", "saturation", "black_clipping"):
        return True
    if id == "heavy_tails":
        strength = strength.shifted(-_GAUSSIAN)
    return strength.significant and strength.by_chance < _CHANCE


def _reaches_far(exponent: Estimate, statistics: Sequence[FrameStatistics]) -> bool:
    """Whether rows two to six apart are at least half as alike as 1/f noise of this exponent makes them.

    A correlation with the next row only, as some readouts have, also draws the exponent away from zero.
    """
    dark = darkest(statistics)
    if dark is None or exponent.ci90[0] <= 0:
        return False
    rest = row_offsets(dark)
    rest = rest - rest.mean(0)
    height, power = rest.shape[1], np.mean(rest**2)
    lags = range(2, min(7, height // 2))
    seen = np.mean([np.mean(rest[:, k:] * rest[:, :-k]) / power for k in lags])
    model = power_law_correlation(2 * height, exponent.value)
    # Taking out frame means lowers all correlations alike.
    level = (2 * np.sum((height - np.arange(height)) * model[:height]) / height - 1) / height
    expected = np.mean([(model[k] - level) / (1 - level) for k in lags])
    return bool(seen > 0.5 * expected)
