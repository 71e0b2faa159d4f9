"""What came of it, as plain data: the baseline, the shares of the findings, the gate, and what still
differs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.discovery.compare.report import difference_document
from cannoise_jax.discovery.frames.faults import at_iso
from cannoise_jax.discovery.proof.gate import Gated
from cannoise_jax.discovery.proof.judged import CALIBRATED
from cannoise_jax.discovery.proof.tried import Tried
from cannoise_jax.discovery.report.not_found import asked_of_a_curve
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search.model import adds
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.mechanisms.pedestal import LEVELS, PEDESTAL
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_draws import closed_moments
from cannoise_jax.physics.core.settings import Settings, black_levels
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.physics.transfer.faults import Faults
from cannoise_jax.physics.transfer.multiplied import multiplied
from cannoise_jax.recordings.recording import DARK
from cannoise_jax.signatures.curve import VARIANCE_CURVE
from cannoise_jax.signatures.whole_spread import spread_of_all

_KNOWN = 0.5
"""Relative error of a read noise that only flats tell, up to which it counts as measured."""
_BENT = (
    "the gain is that of a straight line, and the variance of the flats bends: it may be off by some per "
    "cent: record three or more exposures of one steady lamp, which tell the curve"
)
_UNLIKE = (
    "the gain is that of a straight line, and may be off by some per cent: the variance of the flats bends, "
    "and their means over the exposure do not bear that out as one smooth curve. Either it bends by itself, "
    "or the lamp was not steady enough, which more exposures of one steady lamp would tell"
)
_OF_PIXELS = ("readout", "pixel", "redrawn", "add")
"""Where the noise of single pixels enters, and how."""
_SURE = 3.0
"""Standard errors of the mean gain of the sites from which on noise counts as growing with the light."""


def grown_gain(diagnosis: Result) -> float:
    """The gain beside the findings over that of the fitted baseline, at which strengths in electrons were
    measured; 1 where the baseline is that of a simulator, which may state any."""
    if diagnosis.simulator != CALIBRATED:
        return 1.0
    model = diagnosis.model
    fitted = np.array([b.gain for b in diagnosis.first.baselines])
    numbers = [diagnosis.first.isos[b.iso] for b in diagnosis.first.baselines]
    at = [int(np.argmin(np.abs(np.asarray(model.iso) - number))) for number in numbers]
    if not (fitted > 0).all():
        return 1.0
    return float(np.mean(np.asarray(model.gain_dn_per_e)[at] / fitted))


def baseline(diagnosis: Result) -> list[dict[str, Any]]:
    """Gain (DN/e-), read noise (e-) and black level (DN) by mosaic site, of the simulator that is handed
    back, for every ISO that it has, and by how much the darks of each exposure lie beyond that and what was
    found (DN), where they do. Noise of pixels without a name is read noise here. shot_noise: whether noise
    grows with the light: where it does not, as a bolometer's, the gain is not measured, and read noise in
    electrons is none. gain_measured, read_noise_measured, black_cut_off: see `Measured`. The ISO is None
    where no file states one, and not the stand-in by which a camera model knows that gain."""
    model = diagnosis.model
    grows = {
        diagnosis.first.isos[b.iso]: bool(b.gain.sum() > _SURE * np.linalg.norm(b.gain_stderr))
        for b in diagnosis.first.baselines
    }
    gain, black = np.asarray(model.gain_dn_per_e), black_levels(model)
    read = np.sqrt(np.asarray(model.read_noise_e) ** 2 + unnamed_read(model) / np.maximum(gain, 1e-30) ** 2)
    stated = {float(np.float32(number)): iso for iso, number in diagnosis.first.isos.items()}
    told = measured(diagnosis)
    isos = np.asarray(model.iso).tolist()
    known = [told.get(stated.get(iso, iso), Measured()) for iso in isos]
    # Of a gain that was not measured nobody knows whether noise grows with the light.
    shot = [
        not seen.gain_measured or next((v for m, v in grows.items() if np.isclose(m, iso)), True)
        for seen, iso in zip(known, isos, strict=True)
    ]
    return [
        {
            "iso": stated.get(iso, iso),
            **known[n]._replace(gain_measured=known[n].gain_measured and shot[n])._asdict(),
            "gain_dn_per_e": gain[n],
            "read_noise_e": read[n],
            "read_noise_dn": gain[n] * read[n],
            "shot_noise": shot[n],
            "black_dn": black[n],
            "black_beyond": [
                {
                    "exposure_s": f.parameters["exposure_s"],
                    "beyond_dn": [f.parameters[name] for name in LEVELS],
                }
                for f in model.mechanisms
                if f.record is PEDESTAL
            ],
        }
        for n, iso in enumerate(isos)
    ]


def unnamed_read(model: SensorModel) -> Float[np.ndarray, "g 4"]:
    """Variance of the noise of pixels in the dark that has no name, DN^2, by gain setting and site: of other
    tails, or alike in neighbours, it was measured within the read noise, and taken out of it."""

    def of_pixels(point: Point) -> bool:
        alike = (point.stage, point.over, point.time, point.combine) == _OF_PIXELS
        return alike and point.signal == 0

    own = (f for f in model.mechanisms if f.mechanism.startswith(UNKNOWN))
    unnamed = tuple(f for f in own if of_pixels(f.record.point))
    if not unnamed:
        return np.zeros((np.size(model.iso), 4))
    bare, noisy = (replace(model, mechanisms=some) for some in ((), unnamed))
    dark = np.zeros((2, 2), np.float32)
    variance = [
        [np.ravel(closed_moments(one, dark, Settings(float(iso)))[1]) for one in (noisy, bare)]
        for iso in np.asarray(model.iso)
    ]
    return np.array([more - less for more, less in variance])


class Measured(NamedTuple):
    """Whether gain and read noise of one ISO were measured, and whether darks are cut off at code 0, which
    then show no black level."""

    gain_measured: bool = True
    read_noise_measured: bool = True
    black_cut_off: bool = False


def measured(diagnosis: Result) -> dict[float | None, Measured]:
    """What of the baseline of every ISO was measured: it has what the files state, or a gain of one, or what
    can be made of recordings with faults, for the rest. Nothing of a simulator that was handed over."""
    if diagnosis.simulator != CALIBRATED:
        return {}
    dark = {r.iso for r in diagnosis.capture.recordings if r.kind in DARK and r.count > 1}
    out: dict[float | None, Measured] = {}
    for b in diagnosis.first.baselines:
        known = b.read_stderr > 0
        sure = bool(np.all(known & (b.read_stderr < _KNOWN * b.read_noise)))
        wrong = diagnosis.faults.get(b.iso, Faults())
        gain = bool(np.any(b.gain_stderr > 0)) and not wrong.moves
        read = not wrong.cut_off and (b.iso in dark or (sure and not wrong.moves))
        out[b.iso] = Measured(gain, read, bool(wrong.cut_off))
    return out


def not_measured(diagnosis: Result) -> list[str]:
    """A line for every ISO of which the baseline was not measured: what, and what to record, unless a fault
    of the recordings says it; one where no straight line tells the gain, and one where it holds the excess
    noise of a multiplier."""
    out, known = [], measured(diagnosis)
    for iso, (gain, read, _) in known.items():
        wrong, at = diagnosis.faults.get(iso, Faults()), at_iso(iso)
        if not gain and not wrong.moves:
            stated = any(r.shot for r in diagnosis.capture.recordings if r.iso == iso)
            what = "that of the files stands" if stated else "1 DN/e- stands"
            out.append(
                f"the gain{at} was not measured, {what} in its place: record two or more flats of an even "
                "light, dimmer than the white level"
            )
        if not read and not wrong.cut_off:
            out.append(f"the read noise{at} was not measured: record two or more darks of a short exposure")
    laws = {s.named.signature.axes.law for s in diagnosis.fitted.steps if s.named.mechanism == UNKNOWN}
    if VARIANCE_CURVE in laws and any(m.gain_measured for m in known.values()):
        out.append(_UNLIKE if asked_of_a_curve(diagnosis) else _BENT)
    # A random gain that was found is in the gain that is told.
    named = any(s.named.signature.of_gain and s.named.mechanism != UNKNOWN for s in diagnosis.fitted.steps)
    if not named and (line := multiplied(diagnosis.capture.recordings)):
        out.append(line)
    return out


def shares(diagnosis: Result, listed: list[int]) -> tuple[list[float | None], float]:
    """Share of the whole gain on frames held back of every finding (None: not measured), and of the
    remainder.

    Of the findings together and the remainder by the composite score where both were tried; among the
    findings by what each gains.
    """
    rest = 0.0
    if diagnosis.gated is not None and diagnosis.gated.remainder:
        alone = (
            t.score.value for t in diagnosis.gated.tried if t.score and t.steps and "remainder" not in t.what
        )
        whole = score_of(diagnosis.gated)
        rest = float(np.clip(1 - max(next(alone, 0.0), 0.0) / whole, 0.0, 1.0)) if whole > 0 else 0.0
    gains = [diagnosis.proofs[n].gain for n in listed]
    known = sum(max(g, 0.0) for g in gains if g is not None)
    each = [None if g is None else (1 - rest) * max(g, 0.0) / known if known > 0 else 0.0 for g in gains]
    return each, rest


def score_of(gated: Gated) -> float:
    """Composite score of the simulator that is handed back less that of the one that was judged, nats a
    pixel."""
    one, two = gated.before.side.composite, gated.after.side.composite
    return 0.0 if one is None or two is None else float(two.mean() - one.mean())


def entered(diagnosis: Result, n: int) -> bool | None:
    """Whether a finding is in the simulator that is handed back, which cannot hold all that is found; None
    where none was chosen by draws."""
    step = diagnosis.fitted.steps[n]
    if diagnosis.gated is None:
        return None if diagnosis.entered else False
    return step in diagnosis.gated.steps and adds(step, diagnosis.first)


def gate(diagnosis: Result) -> dict[str, Any] | None:
    """What was tried beside the simulator that was judged, and what entered; None: nothing was measured.

    worse: whether what is handed back is worse than what was judged, by a measure of which the interval
    says so.
    """
    if diagnosis.gated is None:
        return None
    tried = diagnosis.gated.tried
    return {
        "tried": [_tried(t) for t in tried],
        "remainder": diagnosis.gated.remainder,
        "worse": any(t.entered and t.worse for t in tried),
    }


def _tried(t: Tried) -> dict[str, Any]:
    return {
        "what": t.what,
        "findings": t.steps,
        "score_nats_per_pixel": None if t.score is None else _interval(t.score),
        "area_distance_change": None if t.area is None else _interval(t.area),
        "entered": t.entered,
    }


def _interval(change: Any) -> dict[str, Any]:
    return {"value": change.value, "ci90": [change.low, change.high]}


def remains(diagnosis: Result) -> dict[str, Any] | None:
    """What differs before and after by the layer that knows no names, largest share first; None: not looked.

    pixels: of all frames that were looked at; left: nats that are left of those before (above 1: more than
    before); nearer: log score of the noise after less before, nats a pixel.
    """
    found = diagnosis.remains
    if found is None:
        return None
    nearer = found.nearer
    return {
        "held_back": found.held_back,
        "pixels": sum(s.size[0] * s.size[1] * s.frames for s in found.before.bank.seen.values()),
        "before": [difference_document(d) for d in found.before.differences],
        "after": [difference_document(d) for d in found.after.differences],
        "left": found.left,
        "nearer": None
        if nearer is None
        else {"value": nearer.gain, "ci90": [nearer.low, nearer.high], "contrasts": nearer.units},
    }


def of_all_pixels(step: Step, sigma: float, unit: str) -> dict[str, Any]:
    """Of a map of pixels, `sigma_of_all`: its standard deviation with the pixels that are no part of its law,
    where that is larger. sigma: that of the others."""
    of = step.named.signature.map_of
    wide = spread_of_all(step.before, of[1], sigma) if of and of[0] == "pixel" else None
    if wide is None:
        return {}
    value, error = wide
    ends = [max(value - Z90 * error, 0.0), value + Z90 * error]
    return {"sigma_of_all": {"value": value, "unit": unit, "ci90": ends}}
