"""What bin/blind asks of the analysis: reports, p-values, gain of the true model, fingerprint of the code."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

import cannoise_jax
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.contrasts import Stack
from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings, splits_of
from cannoise_jax.discovery.proof.gains import held_out_gain
from cannoise_jax.discovery.proof.heldout import score_frames
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.search import declare
from cannoise_jax.discovery.search.fit import charge, second_look
from cannoise_jax.discovery.search.locate import Located, locate
from cannoise_jax.discovery.search.name import UNKNOWN, mechanism_of
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.fields import Fields, channel_index
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.score import p_of

ALPHA = 0.01
"""False-alarm rate of a run, that of `diagnose`."""


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
    allowed = frozenset(entry.id for entry in declare.registered(without))
    splits = splits_of(capture)
    prepared = splits.looking
    first = locate(prepared.fields, prepared.signatures)
    mechanism = {s.name: mechanism_of(s, allowed) for s in prepared.signatures}
    rejected = [
        (mechanism[n], n, charge(first.log_p[n], SHARED.looking))
        for n in first.significant(math.log(ALPHA * SHARED.looking))
    ]
    if not rejected:
        late = second_look(
            [],
            first,
            lambda: splits.together.fields,
            prepared.signatures,
            allowed=allowed,
            tests=first.tests,
            log_alpha=math.log(ALPHA),
        )
        if late is not None:
            named, log_p = late
            rejected = [(named.mechanism, named.signature.name, log_p)]
    findings = [
        {
            "mechanism": name,
            "class": "sensor" if name == UNKNOWN else VOCABULARY[name].kind,
            "outcome": "UNKNOWN_STRUCTURE" if name == UNKNOWN else "FOUND",
            "candidates": [{"mechanism": name, "probability": 1.0}],
            "signature": signature,
            "p_value": p_of(log_p),
        }
        for name, signature, log_p in rejected
    ]
    return {"findings": findings, **smallest_p(first)}


def unweighted_p(capture: CaptureSet) -> float | None:
    """Smallest family-wise p of the battery where every pixel of a recording weighs the same."""

    def common(f: Fields, stacked: Stack) -> np.ndarray:
        level = np.sqrt(np.mean(f.sigma[f.usable] ** 2)) if f.usable.any() else 1.0
        return np.full_like(f.sigma, level)

    return _lesser_p(capture, common)


def unrefitted_p(capture: CaptureSet) -> float | None:
    """Smallest family-wise p of the battery where noise is standardised by the shot and read of the files,
    taken at their word; None where they state none."""
    if not all(r.shot and r.read for r in capture.recordings):
        return None

    def stated(f: Fields, stacked: Stack) -> np.ndarray:
        r = stacked.recording
        span = r.white_level - np.asarray(r.black_level)
        channel = channel_index(f.mean.shape)
        gain, read = (np.asarray(v)[channel] * (span**k)[channel] for v, k in ((r.shot, 1), (r.read, 2)))
        return np.sqrt(gain * f.signal + read + f.step**2 / 12).astype(np.float32)

    return _lesser_p(capture, stated)


def _lesser_p(capture: CaptureSet, law: Callable[[Fields, Stack], np.ndarray]) -> float | None:
    """Smallest family-wise p of the battery under another standard deviation of the noise, DN."""
    prepared = prepare_split(capture, split_recordings(capture))
    changed = []
    for f, stacked in zip(prepared.fields, prepared.stacks, strict=True):
        sigma = law(f, stacked)
        ratio = (f.sigma / sigma).astype(np.float32)
        changed.append(
            f._replace(
                contrasts=f.contrasts * ratio,
                static=None if f.static is None else f.static * ratio,
                sigma=sigma,
            )
        )
    return smallest_p(locate(tuple(changed), prepared.signatures))["battery_p_value"]


def smallest_p(first: Located) -> dict[str, float | None]:
    """The smallest p-value of a pass of the battery, family-wise and of its one test alone."""
    if not first.log_p:
        return {"battery_p_value": None, "battery_raw_p": None}
    return {
        "battery_p_value": p_of(min(first.log_p.values())),
        "battery_raw_p": p_of(min(s.log_p for s in first.scores.values())),
    }


def true_gain(capture: CaptureSet, mechanism: str, amplitude: float) -> float | None:
    """Held-out gain, nats, of the mechanism at its true population amplitude. Where it has a likelihood, maps
    and offsets come from the frames that looked, as those of a finding; else phases and frequencies come from
    the frames held out. None where no signature looks for it.

    A mechanism that blurs the scenes too gets the best gain of the signature of blur beside its own."""
    splits = splits_of(capture)
    if not splits.can_prove:
        return None
    first, prepared = splits.looking, splits.held_back
    found = {s.name: s.score(first.fields) for s in first.signatures if s.mechanism == mechanism}
    gains, bare = [], None
    for signature in (s for s in prepared.signatures if s.mechanism == mechanism and not s.reads_as):
        score, looked = signature.score(prepared.fields), found.get(signature.name)
        if score is None:
            continue
        strength = amplitude if score.amplitude >= 0 else -amplitude
        law = None
        if looked is not None:
            law = signature.predict(first.fields, signature.at(looked, strength))
        if law is None:
            gains.append(held_out_gain(score.replace(amplitude=strength), score))
            continue
        bare = bare or score_frames(first, prepared, splits.chosen, [])
        with_it = score_frames(first, prepared, splits.chosen, [law])
        gains.append(float(with_it.log_prob.sum() - bare.log_prob.sum()))
    blurs = [
        score.gain
        for s in prepared.signatures
        if mechanism in s.reads_as[1:] and (score := s.score(prepared.fields)) is not None
    ]
    return max(gains) + sum(blurs) if gains else None


def fingerprint(*more: str) -> str:
    """SHA-256 over the source of everything that an analysis runs, and of more files of the package."""
    root = Path(cannoise_jax.__file__).parent
    digest = hashlib.sha256()
    for part in (
        "vocabulary.py",
        "recordings",
        "physics",
        "mechanisms",
        "signatures",
        "evaluation",
        "discovery",
        *more,
    ):
        for path in sorted((root / part).rglob("*.py")) or [root / part]:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()
