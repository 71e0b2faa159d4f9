"""Errors of the reference, in the unit of their mechanism, and what would pass for one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.report.document import finding
from cannoise_jax.discovery.report.not_found import detectable
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.recordings.recording import CaptureSet
from tests.discovery.capture import capture_set
from tests.discovery.looks import SIGNATURES


def blurred(capture: CaptureSet, share: float) -> CaptureSet:
    """The set with references that give `share` of every pixel to its four neighbours of the same colour."""

    def blur(clean):
        p = np.pad(clean, 2, mode="reflect")
        mean = (p[:-4, 2:-2] + p[4:, 2:-2] + p[2:-2, :-4] + p[2:-2, 4:]) / 4
        return (clean + share * (mean - clean)).astype(np.float32)

    recordings = (
        r if r.clean is None else dataclasses.replace(r, clean=blur(r.clean)) for r in capture.recordings
    )
    return CaptureSet(capture.camera, tuple(recordings))


def test_a_blurred_reference_is_wrong_by_so_many_dn():
    sharp = capture_set(1, kinds="sd")
    soft = blurred(sharp, 0.1)
    span = 16383.0 - 200.0
    wrong = [
        span * float(np.sqrt(np.mean((a.clean - b.clean) ** 2)))
        for a, b in zip(sharp.recordings, soft.recordings, strict=True)
        if a.clean is not None
    ]
    found = diagnose(soft, compare=False, mechanisms=("reference_error", "misregistration"))
    entries = [finding(found, s, p) for s, p in zip(found.fitted.steps, found.proofs, strict=True)]
    entry = next(e for e in entries if "blur" in e["parameters"])
    assert entry["mechanism"] == "reference_error" and entry["amplitude"]["unit"] == "DN"
    assert entry["amplitude"]["value"] == pytest.approx(max(wrong), rel=0.3)
    low, high = entry["amplitude"]["ci90"]
    assert 0 < high - low < entry["amplitude"]["value"]
    assert abs(entry["parameters"]["blur"]["value"]) == pytest.approx(0.1, abs=0.03)


def test_the_smallest_blur_that_is_seen_is_in_dn_too():
    found = diagnose(capture_set(2, kinds="sd"), compare=False, mechanisms=("reference_error",))
    score = found.fitted.first.scores["reference_blur"]
    smallest = detectable(found, "reference_error")
    assert smallest is not None and smallest[1] == "DN"
    assert smallest[0] > 5 * score.shift
    assert SIGNATURES["reference_blur"].quoted(score, "in_camera_denoising") == score


def test_a_bent_response_is_no_wrong_scale():
    """A curve through zero lowers the slope of dim scenes: once it is known, their scale is right."""

    def alter(rng):
        return lambda dn, signal, kind, t: dn - 0.02 * signal**2 / 16183.0

    capture = capture_set(8, alter, kinds="sd", size=(96, 128))
    first = prepare_split(capture, split_recordings(capture))
    fitted = stepwise(first.fields, first.signatures, frozenset(e.id for e in registered()), np.log(0.01))
    assert [s.named.mechanism for s in fitted.steps] == ["nonlinearity"]
