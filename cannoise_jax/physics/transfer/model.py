"""From photon transfer and the estimators to a camera model: which mechanisms are there, and how strong.

A mechanism enters the model when its 90 % interval leaves out zero, chance shows as much less than three
times in ten thousand (`Estimate.chance`: for the root of a variance that of the variance, for a wave that of
the strongest of all frequencies), and it is large enough to matter: an additive one 2 % of the noise of a
pixel (0.04 % of its variance) at the setting that shows it best, others as their `Estimator.least` says.
Where several explain the same data only one enters: pink or white row noise by whether rows far apart are
alike, and the place of white rows by whether several are read together and even and odd columns apart; heavy
tails, a spread of read noise over the pixels and telegraph pixels by which of them, or which together,
explain the values of the pixels best (`estimators.loudness`). What belongs to the light, or is in the
baseline already, is reported but does not enter.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from cannoise_jax.physics.core.grammar import Point, point_parameters
from cannoise_jax.physics.core.ranges import clipped
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.black import black_level
from cannoise_jax.physics.transfer.doubling import NAME, doubling_of
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates, NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE, Each, Estimator, Measurable
from cannoise_jax.physics.transfer.estimators.loudness import explanation
from cannoise_jax.physics.transfer.estimators.pick import darkest, darks_by_exposure
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.maps import with_measured_maps, without_charge, without_repetition
from cannoise_jax.physics.transfer.one_sensor import of_one_sensor
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer
from cannoise_jax.physics.transfer.regions import drifting_halves
from cannoise_jax.physics.transfer.smoothed import smoothed
from cannoise_jax.physics.transfer.table import aligned, format_outcome, setting_of
from cannoise_jax.recordings.recording import BadInput, Recording, iso_numbers

Verdict = Literal[
    "in the model",
    "not significant",
    "too small to matter",
    "not there",
    "not looked for",
    "explained by",
    "reported only",
]

_LEAST_SHARE = 0.02
"""Of a pixel's noise in the dark: what an additive mechanism must have, rms or peak."""


class Finding(NamedTuple):
    """What is known of one mechanism. because: the reason of the verdict. point: its place in the grammar,
    where that differs from the usual one."""

    entry: Measurable
    estimates: Estimates
    verdict: Verdict
    because: str = ""
    point: Point | None = None

    @property
    def mechanism(self) -> str:
        """Its name."""
        return self.entry.record.id

    @property
    def estimator(self) -> Estimator:
        """How it was measured."""
        if self.entry.estimator is None:
            raise ValueError(f"{self.mechanism}: has no estimator")
        return self.entry.estimator

    @property
    def measured(self) -> Mapping[str, Estimate] | None:
        """The estimates, where the mechanism is in the model."""
        outcome = self.estimates
        return None if self.verdict != "in the model" or isinstance(outcome, NotMeasurable) else outcome


def find_mechanisms(
    statistics: Sequence[FrameStatistics], baseline: Baseline, entries: Iterable[Measurable],
    each: Each = iter,
) -> tuple[Finding, ...]:  # fmt: skip
    """What the estimators of all entries say of the recordings of one setting, in their order. each: goes
    through them, one by one as they are measured."""
    asked = [e for e in entries if e.estimator is not None and not e.estimator.in_baseline]
    why = smoothed(statistics) or drifting_halves(darkest(statistics))
    blurred = NotMeasurable(why) if why else None
    taken_out = [_judged(e, statistics, baseline) for e in asked if e.estimator and e.estimator.without]
    left = less_known(statistics, baseline, taken_out)
    found = {f.mechanism: f for f in taken_out}
    found = {
        id: found.get(id)
        or _judged(e, left if e.estimator and e.estimator.frozen else statistics, baseline, blurred)
        for id, e in ((e.record.id, e) for e in each(asked))
    }
    for id, finding in found.items():
        for rival in finding.estimator.gives_way_to:
            if finding.measured and rival in found and found[rival].measured:
                found[id] = finding._replace(verdict="explained by", because=rival)
    found |= _of_the_light(found, statistics, baseline)
    dark = darkest(statistics)
    if dark is not None:
        found |= _causes(found, dark, statistics, baseline)
        found = {id: placed(finding, dark) for id, finding in found.items()}
        elsewhere = {id: f.point for id, f in found.items() if f.point is not None}
        found = {id: _beside(finding, elsewhere, dark) for id, finding in found.items()}
    return tuple(found.values())


def _of_the_light(
    found: Mapping[str, Finding], statistics: Sequence[FrameStatistics], baseline: Baseline
) -> dict[str, Finding]:
    """Shares of the light that a response which bends has changed, as they are before it."""
    bends = next((f for f in found.values() if f.estimator.straight and f.measured), None)
    if bends is None or bends.estimator.straight is None or bends.measured is None:
        return {}
    factor = bends.estimator.straight(statistics, baseline, bends.measured)
    return {
        id: f._replace(
            estimates={n: e.scaled(factor) for n, e in f.measured.items()}, because="(of a straight response)"
        )
        for id, f in found.items()
        if f.estimator.of_light and f.measured
    }


def less_known(
    statistics: Sequence[FrameStatistics], baseline: Baseline, findings: Iterable[Finding]
) -> Sequence[FrameStatistics]:
    """The recordings less what some findings add to them."""
    for finding in findings:
        if finding.estimator.without is not None and finding.measured is not None:
            statistics = finding.estimator.without(statistics, baseline, finding.measured)
    return statistics


def _causes(
    found: Mapping[str, Finding],
    dark: FrameStatistics,
    statistics: Sequence[FrameStatistics],
    baseline: Baseline,
) -> dict[str, Finding]:
    """The findings that make single values loud, those left out that others explain; where several stay, with
    the estimates of all together."""
    rivals = {
        f.estimator.law: f for f in found.values() if f.estimator.law is not None and f.measured is not None
    }
    if len(rivals) < 2:
        return {}
    starts = {law: f.measured or {} for law, f in rivals.items()}
    cause = explanation(dark, starts, gain=baseline.gain)
    together = " and ".join(rivals[law].mechanism for law in cause.laws)
    loud = [
        sites(dark, gain=baseline.gain, **{name: e.value for name, e in cause.estimates[law].items()}) > 0
        for law in cause.laws
        if (sites := rivals[law].estimator.loud)
    ]
    out = {}
    for law, finding in rivals.items():
        if law not in cause.laws:
            out[finding.mechanism] = finding._replace(verdict="explained by", because=together)
        elif len(cause.laws) > 1:
            estimates: Estimates = cause.estimates[law]
            if spares := finding.estimator.spares:
                spared = (
                    spares(statistics, baseline, without=np.any(loud, axis=0)) if loud else finding.estimates
                )
                # Where the others leave too few pixels, the fit of all together is what there is.
                estimates = estimates if isinstance(spared, NotMeasurable) else spared
            out[finding.mechanism] = finding._replace(estimates=estimates, because=f"({together} together)")
    return out


def placed(finding: Finding, dark: FrameStatistics) -> Finding:
    """The finding with its place in the grammar, where that is not the usual one."""
    where, measured = finding.estimator.placed, finding.measured
    seen = where(measured, dark) if where and measured else None
    if seen is None:
        return finding
    return finding._replace(estimates=seen.estimates, because=seen.because, point=seen.point)


def _beside(finding: Finding, elsewhere: Mapping[str, Point], dark: FrameStatistics) -> Finding:
    """The finding, unless a mechanism at a place of its own makes what it sees."""
    same, measured = finding.estimator.beside, finding.measured
    if same and measured:
        for id, point in elsewhere.items():
            if same(measured, point, dark):
                return finding._replace(verdict="explained by", because=id)
    return finding


def _no_baseline(transfers: Sequence[PhotonTransfer]) -> str:
    """What to record, at the setting that most flats were taken at."""

    def flats(t: PhotonTransfer) -> int:
        return sum(s.recording.kind == "flat" for s in t.statistics)

    at = max(transfers, key=flats)
    missing = at.baseline.record if isinstance(at.baseline, NotMeasurable) else ""
    others = [setting_of(t) for t in transfers if t is not at and t.iso is not None]
    where = f" at {setting_of(at)} (others: {', '.join(others)})" if others and at.iso is not None else ""
    return f"{at.camera}: no baseline can be measured{where}: {missing}"


def sensor_model(transfers: Sequence[PhotonTransfer], findings: Sequence[Finding]) -> SensorModel:
    """The camera model: the baseline of every measured ISO, and the mechanisms found at the first of them,
    with the frozen maps of the unit that was recorded (`transfer.maps`).

    Raises BadInput where no setting has a baseline, with what to record.
    """
    measured = [(t, of_one_sensor(t, t.baseline)) for t in transfers if isinstance(t.baseline, Baseline)]
    if not measured:
        raise BadInput(_no_baseline(transfers))
    for finding in findings:
        if (corrects := finding.estimator.corrects) and finding.measured:
            measured = [(t, corrects(b, t.statistics, finding.measured)) for t, b in measured]
    (first, base), isos = measured[0], [t.iso for t, _ in measured]
    numbers = iso_numbers(isos)
    model = SensorModel.poisson_gaussian(
        np.array([b.gain for _, b in measured]),
        np.array([b.read_noise_e for _, b in measured]),
        np.array([b.black_level for _, b in measured]),
        base.white_level,
        first.cfa,
        iso=tuple(numbers[iso] for iso in isos),
        code_step=base.code_step,
        camera=first.camera,
    )
    for finding in findings:
        if finding.measured is None:
            continue
        record = finding.entry.record
        values: dict[str, Any] = clipped(record, {n: e.value for n, e in finding.measured.items()})
        law = dataclasses.replace(
            record.scaling,
            reference_iso=float(np.asarray(model.iso)[0]),
            reference_temperature_c=measured_at(r.recording for r in first.statistics)
            if record.scaling.doubling_c
            else None,
            **(_exposures(first.statistics) if record.scaling.exposure else {}),
            **(doubling_of(first.outcomes(NAME)) if record.scaling.doubling_c else {}),
        )
        if finding.point is None:
            model = model.with_mechanism(record, scaling=law, **values)
        else:
            model = model.with_mechanism(record.id, scaling=law, point=finding.point, **values)
    estimators = {finding.mechanism: finding.estimator for finding in findings}
    left = less_known(first.statistics, base, findings)
    model = with_measured_maps(model, first.statistics, left, base, estimators)
    model = without_repetition(model, first.statistics, estimators)
    exposures = [black_level(t.statistics).seconds or 0.0 for t, _ in measured]
    return without_charge(model, exposures, first.statistics[0].recording.size)


def measured_at(recordings: Iterable[Recording]) -> float | None:
    """The temperature at which thermal charge was measured: of the longest recording that states one, C."""
    known = [r for r in recordings if r.temperature_c is not None]
    return max(known, key=lambda r: r.exposure_s or 0.0).temperature_c if known else None


def _exposures(statistics: Sequence[FrameStatistics]) -> dict[str, float]:
    """The range of exposures of the darks, seconds; empty where none is known."""
    known = [s.recording.exposure_s or 0.0 for s in darks_by_exposure(statistics)]
    return {"exposure_low_s": min(known), "exposure_high_s": max(known)} if known else {}


def format_findings(findings: Sequence[Finding]) -> str:
    """Plain text: one line per parameter, then what the recordings rule out, and what they cannot show."""
    lines = [["mechanism", "parameter", "unit", "value [90 % interval]", ""]]
    missing: dict[str, list[str]] = {}
    absent: dict[str, list[str]] = {}
    for f in findings:
        if isinstance(f.estimates, NotMeasurable):
            where = absent if f.estimates.answered else missing
            where.setdefault(f.estimates.record, []).append(f.mechanism)
            continue
        parameters = point_parameters(f.point, 0.0) if f.point else f.entry.record.parameters
        units = {p.name: p.unit for p in parameters}
        for k, (name, estimate) in enumerate(f.estimates.items()):
            verdict = f"{f.verdict}{' ' if f.because else ''}{f.because}" if k == 0 else ""
            lines.append(
                [f.mechanism if k == 0 else "", name, units[name], format_outcome(estimate), verdict]
            )
    out = ["Mechanisms beyond Poisson-Gaussian", ""]
    out += [*aligned(lines), ""] if len(lines) > 1 else []
    for heading, told in (
        ("Not there:", absent),
        ("Not looked for, for want of these recordings:", missing),
    ):
        out += [heading, *(f"  {', '.join(ids)}: {why}" for why, ids in told.items()), ""] if told else []
    return "\n".join(out).rstrip()


def _judged(
    entry: Measurable, statistics: Sequence[FrameStatistics], baseline: Baseline,
    blurred: NotMeasurable | None = None,
) -> Finding:  # fmt: skip
    """The verdict on one mechanism. blurred: why noise of the frames is not white, where it is not."""
    estimator = entry.estimator
    assert estimator is not None
    estimates = blurred if blurred and estimator.white else estimator(statistics, baseline)
    if isinstance(estimates, NotMeasurable):
        return Finding(entry, estimates, "not there" if estimates.answered else "not looked for")
    if estimator.reported:
        return Finding(entry, estimates, "reported only", estimator.reported)
    strength = next(iter(estimates.values()))
    if why := _beyond_range(entry, *next(iter(estimates.items()))):
        return Finding(entry, NotMeasurable(why), "not looked for")
    if not _strong(estimator, strength):
        chance = estimator.searched and strength.significant
        said = "(of so many frequencies chance alone makes one as strong)" if chance else ""
        return Finding(entry, estimates, "not significant", said)
    if entry.term.kind != "sensor":
        return Finding(entry, estimates, "reported only", "(not of the sensor)")
    against = estimator.against(estimates, statistics) if estimator.against else ""
    if against:
        return Finding(entry, estimates, "not significant", against)
    if not _matters(entry, estimator, estimates, statistics, baseline):
        return Finding(entry, estimates, "too small to matter")
    return Finding(entry, estimates, "in the model")


def _beyond_range(entry: Measurable, name: str, strength: Estimate) -> str:
    """Why a strength says nothing, where its error is larger than all values that it can have."""
    span = next((p.high - p.low for p in entry.record.parameters if p.name == name), np.inf)
    few = f"{name} is uncertain by more than its whole range: record more frames, and steadier ones"
    return "" if strength.stderr <= span else few


def _matters(
    entry: Measurable,
    estimator: Estimator,
    estimates: Mapping[str, Estimate],
    statistics: Sequence[FrameStatistics],
    baseline: Baseline,
) -> bool:
    """Whether the strength reaches what the module's docstring asks for."""
    strength = next(iter(estimates.values())).value
    if estimator.least is not None:
        return abs(strength - estimator.neutral) >= estimator.least
    record, dn = entry.record, abs(strength)
    if record.scaling.exposure:  # e-/s
        longest = max((s.recording.exposure_s or 0.0 for s in darks_by_exposure(statistics)), default=0.0)
        dn *= longest * float(np.mean(baseline.gain))
    elif record.parameters[0].unit != "DN":
        return True
    if "fraction" in estimates:
        dn *= float(np.sqrt(estimates["fraction"].value))
    return dn >= _LEAST_SHARE * float(np.mean(baseline.read_noise))


def _strong(estimator: Estimator, strength: Estimate) -> bool:
    if estimator.exact:
        return True
    if estimator.neutral:
        strength = strength.shifted(-estimator.neutral)
    return strength.significant and strength.by_chance < BY_CHANCE
