"""Errors of the reference, in the unit of their mechanism, and what would pass for one."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, prepare_split, split_recordings
from cannoise_jax.discovery.proof import adequacy
from cannoise_jax.discovery.proof.own_part import own_part
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


def rows_read_lower(share):
    """Every pixel of a scene loses a share of the mean light of its row."""
    return lambda rng: (
        lambda dn, signal, kind, t: dn - share * signal.mean(1, keepdims=True) if kind == "scene" else dn
    )


@pytest.mark.parametrize("alter", [rows_read_lower(0.01), rows_read_lower(-0.01)], ids=["lower", "higher"])
def test_rows_that_follow_their_light_are_told_from_a_wrong_scale(alter):
    capture = capture_set(7, alter, kinds="sdf")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    rows, scale = (
        next(s for s in prepared.signatures if s.name == n) for n in ("row_light", "description_scale")
    )
    score, wrong = rows.score(prepared.fields), scale.score(prepared.fields)
    assert score is not None and score.log_p < -20 and score.gain > 2 * wrong.gain
    assert rows.mechanism is None and scale.name in rows.covers
    left = rows.score(rows.absorb(prepared.fields, score))
    assert left is not None and left.log_p > -5


def test_a_wrong_scale_is_of_rows_columns_and_all_else_alike():
    def wrong(rng):
        return lambda dn, signal, kind, t: dn + (0.01 * signal if kind == "scene" else 0)

    capture = capture_set(7, wrong, kinds="sdf")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    rows, scale = (
        next(s for s in prepared.signatures if s.name == n) for n in ("row_light", "description_scale")
    )
    score = scale.score(prepared.fields)
    assert score is not None and score.log_p < -20
    assert score.parameters["scale"][0] == pytest.approx(0.01, abs=0.001)
    assert rows.score(prepared.fields).log_p > -5


@pytest.mark.slow
def test_crosstalk_keeps_its_name_beside_columns(monkeypatch):
    """The camera model holds the blur of the scenes: drawn once more as an error of the references it would
    be there twice, and against the name."""

    def alter(rng):
        columns = 2.0 * rng.standard_normal(96)
        kernel = np.array([[0, 0.0075, 0], [0.0075, 0.97, 0.0075], [0, 0.0075, 0]])
        lit = ("scene", "flat")
        return lambda dn, signal, kind, t: (
            columns + (ndimage.convolve(dn, kernel, mode="mirror") if kind in lit else dn)
        )

    left = []

    def doubt(full, each, *args):
        left.append(own_part(each))
        return own_doubt(full, each, *args)

    own_doubt = adequacy.doubt
    monkeypatch.setattr(adequacy, "doubt", doubt)
    found = diagnose(capture_set(11, alter, size=(64, 96)))
    most = max(left, key=lambda part: part.before)
    assert most.before > 1e5 and most.after < 1e-3 * most.before
    assert {"crosstalk", "column_fpn"} <= set(found.findings) and "smear" not in found.findings
    (step,) = (s for s in found.fitted.steps if s.named.mechanism == "crosstalk")
    assert step.named.score.amplitude == pytest.approx(0.03, rel=0.1)
