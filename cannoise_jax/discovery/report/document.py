"""Report: the document of a diagnosis, and its page."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from cannoise_jax.discovery.compare.reports import DIAGNOSIS
from cannoise_jax.discovery.frames.faults import fault_lines
from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report import light, outcome
from cannoise_jax.discovery.report.card import card
from cannoise_jax.discovery.report.excess import too_much
from cannoise_jax.discovery.report.not_found import absorbed_by, detectable, still_differs
from cannoise_jax.discovery.report.wording import sentence
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search.declare import kinds
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step, part_of
from cannoise_jax.physics.core.places import place
from cannoise_jax.physics.transfer.estimate import Z90
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.score import Score, p_of


def plain(value: Any) -> Any:
    """The value in types that JSON has; NaN and infinity become null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, (np.integer, int)) and not isinstance(value, bool):
        return int(value)
    if isinstance(value, (np.floating, float)):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    return value


def document(
    diagnosis: Result,
    *,
    key: int,
    version: str,
    seconds: float | None = None,
    peak_memory_mb: float | None = None,
) -> dict[str, Any]:
    """The report as plain data; no NaN or infinity, what does not apply is None.

    schema, version, key, alpha (family-wise), camera, simulator: of the run.
    inputs: file, kind, frames, frames_used, settings (iso, exposure_s, temperature_c, reference) and sha256
      of every recording, and the files of one that was made from single files, each with its own: then sha256
      is that of all, end to end.
    faults: why recordings bear no measurement, or contradict what is stated of them, a line each.
    verdict: see `verdict`.
    baseline: of the simulator that is handed back; not_measured: what of it was not, a line each; gate: how
      it was chosen.
    shadows: of flats, which count as light, see `light.shadowed`.
    too_much: mechanisms that the simulator has more of than the recordings, or whose single pixels it has too
      weak: sign, simulated and recorded, value, unit and ci90 of each, and a sentence.
    remains: what differs whatever its name, see `outcome`; remainder_share: of the whole gain.
    testable: ids; not_testable: mechanism and needs, what to record.
      Every id that the run may name is in exactly one of them, and every testable one in findings or
      not_found.
    findings: by held-out gain, largest first, see `finding`.
    not_found: mechanism and smallest_detectable, the amplitude (value, unit) that this run finds with
      probability 0.5, None where it is no strength or its unit is not told; ambiguous marks members of an
      ambiguous finding's group, too_much what the simulator has too much of, part_of what is the slow part of
      a finding, absorbed_by findings that took away what spoke for it, and still_differs lines of `remains`
      that are of its kind (then nothing excludes it).
    before, after: see `quality`; two_sample: see `two_sample`.
    seconds, peak_memory_mb: of the process, given by the caller.
    """
    steps = diagnosis.fitted.steps
    listed_n = listed_steps(diagnosis)
    findings = [finding(diagnosis, steps[n], diagnosis.proofs[n]) for n in listed_n]
    share, rest = outcome.shares(diagnosis, listed_n)
    for entry, n, part in zip(findings, listed_n, share, strict=True):
        entry.update(share=part, in_simulator=outcome.entered(diagnosis, n))
    parts = {steps[n].named.mechanism: steps[m].named.mechanism for n, m in part_of(steps).items()}
    named = {f["mechanism"] for f in findings}
    listed = {c["mechanism"] for f in findings for c in f["candidates"] if f["outcome"] == "AMBIGUOUS"}
    missing = []
    baseline = outcome.baseline(diagnosis)
    gain_known = any(b["gain_measured"] for b in baseline)
    excess = {e.mechanism for e in diagnosis.excess}
    counted = {s.mechanism for s in diagnosis.first.signatures if s.counted}
    of_gain = {id for id in diagnosis.testable if "e-" in diagnosis.terms[id].unit} - counted
    for id in diagnosis.testable:
        if id in named:
            continue
        absorbed = absorbed_by(diagnosis, id)
        differs = [] if absorbed else still_differs(diagnosis, id)
        # Without a gain there are no electrons.
        unknown = id in of_gain and not gain_known
        limit = None if absorbed or differs or unknown or id in excess else detectable(diagnosis, id)
        smallest = None if limit is None else {"value": limit[0], "unit": limit[1]}
        missing.append(
            {
                "mechanism": id,
                "smallest_detectable": smallest,
                **({"ambiguous": True} if id in listed else {}),
                **({"too_much": True} if id in excess else {}),
                **({"part_of": parts[id]} if id in parts else {}),
                **({"absorbed_by": absorbed} if absorbed and id not in parts else {}),
                **({"still_differs": differs} if differs and id not in parts else {}),
            }
        )
    inputs = []
    lines = zip(kinds(diagnosis.capture), diagnosis.capture.recordings, diagnosis.splits, strict=True)
    for line, recording, (look, show) in lines:
        used = len(look) + len(show)
        inputs.append({**line, "frames_used": used, **digests(recording)})
    # A name that a signature of another mechanism may give was looked for, too.
    also = [id for id in diagnosis.ids if id in named and id not in diagnosis.testable]
    return plain(
        {
            "schema": DIAGNOSIS,
            "version": version,
            "key": key,
            "alpha": diagnosis.alpha,
            "camera": diagnosis.capture.camera,
            "simulator": diagnosis.simulator,
            "inputs": inputs,
            "faults": fault_lines(diagnosis.faults),
            "verdict": diagnosis.verdict,
            "baseline": baseline,
            "not_measured": outcome.not_measured(diagnosis),
            "shadows": light.shadowed(diagnosis),
            "too_much": [too_much(e, diagnosis.terms[e.mechanism]) for e in diagnosis.excess],
            "testable": [*diagnosis.testable, *also],
            "not_testable": [
                {"mechanism": id, "needs": needs} for id, needs in diagnosis.not_testable if id not in also
            ],
            "findings": findings,
            "remainder_share": rest if diagnosis.gated and diagnosis.gated.remainder else None,
            "not_found": missing,
            "before": quality(diagnosis, 0),
            "after": quality(diagnosis, 1),
            "two_sample": two_sample(diagnosis),
            "gate": outcome.gate(diagnosis),
            "remains": outcome.remains(diagnosis),
            "seconds": seconds,
            "peak_memory_mb": peak_memory_mb,
        }
    )


def listed_steps(diagnosis: Result) -> list[int]:
    """Places of the steps that the report lists, by held-out gain."""
    gains = [-np.inf if p.gain is None else p.gain for p in diagnosis.proofs]
    aside = part_of(diagnosis.fitted.steps)
    return sorted((n for n in range(len(gains)) if n not in aside), key=lambda n: -gains[n])


def digests(recording: Recording) -> dict[str, Any]:
    """SHA-256 of all files of a recording, end to end (None: not all are files), and of each of several."""
    paths = recording.sources or ((recording.path,) if recording.path else ())
    whole, files = hashlib.sha256(), []
    for path in paths:
        own = hashlib.sha256() if Path(path).is_file() else None
        if own is not None:
            with open(path, "rb") as file:
                while block := file.read(1 << 22):
                    own.update(block)
                    whole.update(block)
        files.append({"file": path, "sha256": own.hexdigest() if own else None})
    known = bool(files) and all(f["sha256"] for f in files)
    out = {"sha256": whole.hexdigest() if known else None}
    return {**out, "files": files} if recording.sources else out


def quality(diagnosis: Result, which: int) -> dict[str, Any]:
    """The simulator before (0) or after (1) on the frames held back.

    `score` says what `nll_nats_per_pixel` is: minus the mean log-probability of the codes ('likelihood'),
    or, where a finding has no likelihood, minus the composite score of `physics.likelihood.composite`; the
    same for before and after.
    """
    q = diagnosis.quality
    side = None if q is None else (q.before, q.after)[which]
    areas = None if q is None or q.two_sample is None else (q.two_sample.before, q.two_sample.after)[which]
    nll: float | None = (diagnosis.proven.before, diagnosis.proven.after)[which]
    score: str | None = "likelihood"
    if diagnosis.proven.after is None:
        nll, score = None, None
        if side is not None and side.composite is not None:
            nll, score = -float(side.composite.mean()), "composite"
    return {
        "kl": side.kl if side else None,
        "kl_floor": side.kl_floor if side else None,
        "nll_nats_per_pixel": nll,
        "score": score,
        "two_sample_auc": areas.value if areas else None,
        "two_sample_auc_ci90": [areas.low, areas.high] if areas else None,
    }


def two_sample(diagnosis: Result) -> dict[str, Any] | None:
    """How far the area under the curve came nearer to 0.5, patches to a decision, and the control."""
    q = diagnosis.quality
    if q is None or q.two_sample is None:
        return None
    t = q.two_sample
    return {
        "distance_change": t.change.value if t.change else None,
        "distance_change_ci90": [t.change.low, t.change.high] if t.change else None,
        "patches_per_decision": t.patches,
        "control_auc": t.control,
    }


def finding(diagnosis: Result, step: Step, proof: Proof) -> dict[str, Any]:
    """One finding, fitted on the frames that did not select it (on the others where there are none).

    mechanism: the first candidate.
    class: sensor, capture or bookkeeping.
    outcome: FOUND, AMBIGUOUS (the candidates cannot be separated) or UNKNOWN_STRUCTURE (with `card`).
    candidates: mechanism and probability, descending, summing to 1, unknown included.
    where: axis, and what that axis has of index, bbox, channel, period_px and direction, range, period.
    amplitude and parameters: value, unit, ci90.
    p_value: family-wise.
    log_e_value: natural log, of findings with a likelihood.
    heldout_gain_nats: on heldout_pixels pixels of the other frames.
    heldout_basis: of the codes' likelihood, of the finding's own statistic, or the change of the composite
      score.
    heldout_gain_nats_per_pixel: value and ci90.
    confirmed: whether that interval of the finding's own evidence lies above zero, or does where no part of a
    recording counts for more than twice the typical one of it.
    sign: what of it the simulator has.
    share: of the whole gain; in_simulator: whether it is in the one that is handed back, see `outcome`.
    sentence: for a reader.
    """
    mechanism, steps = step.named.mechanism, diagnosis.fitted.steps
    # A few pixels may not show again in few frames: their strength is then that of the frames that looked.
    # Nor are the numbers of one wave joined to the place of another.
    # And what gains there at the strength that was found is no finding of strength zero.
    found, again = step.named.score, proof.score
    elsewhere = again is None or not again.error > 0 or not found.same_spot(again)
    if again is None or elsewhere or (proof.confirmed and not again.amplitude > 0):
        again = found
    # What has lost its name is measured as what it came nearest to.
    nearest = step.named.doubt.nearest if step.named.doubt else mechanism
    score = step.named.signature.quoted(again, nearest)
    term = diagnosis.terms[mechanism]
    name_is = (
        "UNKNOWN_STRUCTURE" if mechanism == UNKNOWN else "AMBIGUOUS" if step.named.ambiguous else "FOUND"
    )
    unit = diagnosis.terms[nearest].unit if nearest != UNKNOWN else _unit(score)
    grown = outcome.grown_gain(diagnosis)
    own_unit = 1.0 if step.named.signature.counted else _larger(unit, grown)
    value = score.amplitude / own_unit
    interval = [v / own_unit for v in score.interval90]
    per_pixel = None
    if proof.gain is not None and proof.pixels:
        per_pixel = {
            "value": proof.gain / proof.pixels,
            "ci90": [proof.low / proof.pixels, proof.high / proof.pixels],
        }
    out: dict[str, Any] = {
        "mechanism": mechanism,
        "class": "sensor" if term.kind == UNKNOWN else term.kind,
        "outcome": name_is,
        "candidates": [{"mechanism": m, "probability": p} for m, p in step.named.candidates],
        "where": _where(step.named.score),
        "amplitude": {"value": value, "unit": unit, "ci90": interval},
        "parameters": {
            n: {"value": v / own, "unit": u, "ci90": [limit / own for limit in limits]}
            for n, (v, u, e) in score.parameters.items()
            for own in (_larger(u, grown),)
            # The strength, said once more, has the interval of the strength.
            for limits in (
                score.interval90 if v == score.amplitude and u == unit else (v - Z90 * e, v + Z90 * e),
            )
        },
        "p_value": p_of(step.log_p),
        "log_e_value": proof.log_e,
        "heldout_gain_nats": proof.gain,
        "heldout_basis": proof.basis if proof.gain is not None else None,
        "heldout_pixels": proof.pixels or None,
        "heldout_gain_nats_per_pixel": per_pixel,
        "confirmed": proof.confirmed,
        "sign": "too much" if score.too_much else "too little",
    }
    moved = [n for n, slope in part_of(steps).items() if steps[slope] is step]
    for part in (steps[n].named.score for n in moved):
        own = {"value": part.amplitude, "unit": "DN", "ci90": list(part.interval90)}
        out["parameters"]["frame_offset"] = own
    out["parameters"].update(outcome.of_all_pixels(step, score.amplitude, unit))
    if mechanism == UNKNOWN:
        out["card"] = card(step, diagnosis.first.signatures, frozenset(diagnosis.ids), steps)
    out["sentence"] = sentence(out, step, proof, term)
    return out


def _larger(unit: str, grown: float) -> float:
    """By how much a strength in electrons was taken for too large where the gain has grown."""
    return grown if unit.startswith("e-") else 1.0


def _unit(score: Score) -> str:
    return next((u for _, u, _ in score.parameters.values()), "1")


def _where(score: Score) -> dict[str, Any]:
    return {**dict.fromkeys(place(score.where["axis"]).says), **score.where}
