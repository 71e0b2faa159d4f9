"""What bin/blind asks of the analysis: reports, p-values, gain of the true model, fingerprint of the code."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import jax
import numpy as np

import cannoise_jax
from cannoise_jax.discovery import declare
from cannoise_jax.discovery.battery import prepare, split_frames
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.locate import Located, locate
from cannoise_jax.discovery.name import BLURS
from cannoise_jax.discovery.prove import held_out_gain
from cannoise_jax.discovery.report import document
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.vocabulary import VOCABULARY

ALPHA = 0.01


def diagnosed(
    capture: CaptureSet, without: tuple[str, ...], version: str, compare: bool = True
) -> dict[str, Any]:
    """The report of a whole diagnosis, with the p-value of the battery's first pass."""
    key = jax.random.key(0)
    found = diagnose(capture, "poisson-gaussian", key, alpha=ALPHA, without=without, compare=compare)
    report = document(found, key=0, version=version)
    return {**report, **smallest_p(found.fitted.first)}


def located(capture: CaptureSet, without: tuple[str, ...]) -> dict[str, Any]:
    """Declare, calibrate and locate alone: what the battery rejects, and its smallest family-wise p."""
    ids = declare.registered(without)
    prepared = prepare(capture, [split_frames(r.count)[0] for r in capture.recordings], False)
    first = locate(prepared.fields, prepared.probes)
    mechanism = {p.name: p.mechanism if p.mechanism in ids else "unknown" for p in prepared.probes}
    rejected = [(s, mechanism[s.probe]) for s in first.significant(math.log(ALPHA))]
    findings = [
        {
            "mechanism": name,
            "class": "sensor" if name == "unknown" else VOCABULARY[name].kind,
            "outcome": "UNKNOWN_STRUCTURE" if name == "unknown" else "FOUND",
            "candidates": [{"mechanism": name, "probability": 1.0}],
            "probe": s.probe,
            "p_value": math.exp(max(first.log_p[s.probe], -700.0)),
        }
        for s, name in rejected
    ]
    return {"findings": findings, **smallest_p(first)}


def unweighted_p(capture: CaptureSet) -> float | None:
    """Smallest family-wise p of the battery where every pixel of a recording weighs the same."""
    prepared = prepare(capture, [split_frames(r.count)[0] for r in capture.recordings], False)
    flat = []
    for f in prepared.fields:
        common = np.sqrt(np.mean(f.sigma[f.usable] ** 2)) if f.usable.any() else 1.0
        ratio = (f.sigma / common).astype(np.float32)
        flat.append(
            f._replace(
                contrasts=f.contrasts * ratio,
                static=None if f.static is None else f.static * ratio,
                sigma=np.full_like(f.sigma, common),
            )
        )
    return smallest_p(locate(tuple(flat), prepared.probes))["battery_p_value"]


def smallest_p(first: Located) -> dict[str, float | None]:
    """The smallest p-value of a pass of the battery, family-wise and of its one test alone."""
    if not first.log_p:
        return {"battery_p_value": None, "battery_raw_p": None}
    return {
        "battery_p_value": math.exp(max(min(first.log_p.values()), -700.0)),
        "battery_raw_p": math.exp(max(min(s.log_p for s in first.scores.values()), -700.0)),
    }


def true_gain(capture: CaptureSet, mechanism: str, amplitude: float) -> float | None:
    """Held-out gain, nats, of the mechanism at its true population amplitude: maps, offsets, phases and
    frequencies from the very frames held out, the same composite score. None where no probe looks for it.

    A mechanism that blurs the scenes too gets the best gain of the probe of blur beside its own."""
    held = [split_frames(r.count)[1] for r in capture.recordings]
    if not any(held):
        return None
    prepared = prepare(capture, held, False)
    scores = [p.score(prepared.fields) for p in prepared.probes if p.mechanism == mechanism]
    gains = [
        held_out_gain(s._replace(amplitude=amplitude if s.amplitude >= 0 else -amplitude), s)
        for s in scores
        if s is not None
    ]
    blurs = [
        s.gain
        for p in prepared.probes
        if BLURS.get(p.name, ("",))[0] == mechanism and (s := p.score(prepared.fields)) is not None
    ]
    return max(gains) + sum(blurs) if gains else None


def fingerprint() -> str:
    """SHA-256 over the source of everything that an analysis runs."""
    root = Path(cannoise_jax.__file__).parent
    digest = hashlib.sha256()
    for part in ("vocabulary.py", "recordings", "physics", "evaluation", "discovery"):
        for path in sorted((root / part).rglob("*.py")) or [root / part]:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
