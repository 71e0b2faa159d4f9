"""Frames that look and frames held back: independent contrasts, and strengths that selection cannot touch."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.frames.blocks import leave_out
from cannoise_jax.discovery.frames.splits import prepare_split, split_frames, split_recordings
from cannoise_jax.discovery.proof.gains import strength_beyond
from cannoise_jax.discovery.search.locate import NotJudgedWarning, locate
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.fields import contrast_matrix, frame_fields
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.score import Score, sidak
from tests.discovery.capture import capture_set
from tests.discovery.looks import SIGNATURES


@pytest.mark.parametrize("frames, before", [(1, 3), (2, 6), (4, 12), (3, 1)])
def test_contrasts_of_held_back_frames_are_orthonormal_to_those_that_looked(frames, before):
    looked = np.pad(contrast_matrix(before), ((0, 0), (0, frames)))
    matrix = np.concatenate([looked, contrast_matrix(frames, before)])
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(before + frames - 1), atol=1e-12)
    np.testing.assert_allclose(matrix.sum(1), 0, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 8, 16, 100])
def test_every_frame_looks_or_proves_and_never_both(count):
    look, show = split_frames(count)
    assert sorted(look + show) == list(range(count)) and not set(look) & set(show)
    assert count < 3 or len(look) > len(show) > 0


@pytest.mark.parametrize("count", [16, 32])
@pytest.mark.parametrize("period", [2, 3, 4, 5, 6, 7])
def test_no_period_hides_from_the_frames_that_look(count, period):
    look = np.array(split_frames(count)[0])
    seen = np.bincount(look % period, minlength=period) / np.bincount(np.arange(count) % period)
    assert seen.min() > 0.3
    if period in (2, 4):
        np.testing.assert_allclose(seen, 0.75)


def test_recordings_of_two_frames_look_and_prove_in_turn():
    splits = split_recordings(capture_set(50, kinds="df", frames=2))
    assert {tuple(map(tuple, s)) for s in splits} <= {((0, 1), ()), ((), (0, 1))}
    assert splits[0] == ([0, 1], [])


def test_a_dark_of_every_gain_setting_looks():
    pairs = capture_set(54, kinds="ddff", frames=2).recordings
    at = {iso: [dataclasses.replace(r, iso=iso) for r in pairs] for iso in (100.0, 400.0, 1600.0)}
    capture = CaptureSet("pairs", tuple(r for iso in at for r in at[iso]))
    splits = list(zip(capture.recordings, split_recordings(capture), strict=True))
    assert {r.iso for r, (look, _) in splits if r.kind == "dark" and look} == set(at)
    for kind in ("dark", "flat"):
        assert any(held for r, (_, held) in splits if r.kind == kind)


def test_darks_of_one_frame_look_and_prove_in_turn():
    one = capture_set(55, kinds="d", frames=1).recordings[0]
    splits = split_recordings(CaptureSet("short", (one,) * 4))
    assert [bool(look) for look, _ in splits] == [True, False, True, False]


def test_a_single_frame_does_not_keep_a_pair_of_its_kind_from_looking():
    short, long = capture_set(55, kinds="d", frames=2).recordings
    bias = dataclasses.replace(short, kind="bias")
    single = dataclasses.replace(long, frames=long.frames[:1], exposure_s=1.0)
    splits = split_recordings(CaptureSet("night", (bias, single, long)))
    assert [look for look, _ in splits] == [[0, 1], [0], [0, 1]]


def test_one_frame_held_back_shows_its_noise_and_what_stays():
    capture = capture_set(51, kinds="df", frames=4)
    splits = split_recordings(capture)
    held = prepare_split(capture, splits, held_back=True)
    for f in held.fields:
        assert f.frames == 1 and f.before == 3 and len(f.contrasts) == 1 and f.static is not None
        new, still = f.contrasts[0][f.usable], f.static[f.usable]
        assert np.mean(new**2) == pytest.approx(1, abs=0.05)
        assert np.mean(still**2) == pytest.approx(1, abs=0.05)
        apart = frame_fields(f, static=False)[0][f.usable]
        np.testing.assert_allclose(apart, new, atol=1e-5)


def test_leaving_out_held_back_frames_equals_never_having_had_them():
    capture = capture_set(52, kinds="d", frames=8)
    held = prepare_split(capture, [([0, 1, 2, 4, 5, 6], [3, 7])] * len(capture.recordings), held_back=True)
    alone = prepare_split(capture, [([0, 1, 2, 4, 5, 6], [7])] * len(capture.recordings), held_back=True)
    left = leave_out(held.fields, [(n, 0) for n in range(len(held.fields))])
    for a, b in zip(left, alone.fields, strict=True):
        assert a.frames == b.frames == 1
        # Each was standardised by its own fit.
        np.testing.assert_allclose(a.contrasts * a.sigma, b.contrasts * b.sigma, atol=2e-3 * b.sigma.mean())


def variance_score(total: float, frames: int, number: int) -> Score:
    """Estimate of a pattern's variance from the sum of squared means over `frames` of noise 1."""
    value = max(total / number - 1 / frames, 0.0)
    least = np.sqrt(2 / number) / frames
    error = np.sqrt(2 / number) * (1 / frames + value)
    amplitude, shift = np.sqrt(value), np.sqrt(least)
    spread = error / (2 * max(amplitude, shift))
    return Score(
        log_p=0.0, gain=0.0, penalty=0.0, amplitude=amplitude, error=spread, shift=shift, power=2,
        parameters={"amplitude": (amplitude, "DN", spread)}, where={"axis": "row"},
    )  # fmt: skip


@pytest.mark.parametrize("ratio", [0.05, 0.3, 1.0, 5.0])
def test_strength_of_a_pattern_is_unbiased_and_covered_though_it_was_selected(ratio):
    """Sets whose looking frames show much count only; the held-back frames know nothing of that."""
    rng, number, truth = np.random.default_rng(53), 400, np.sqrt(ratio)
    covered, error, alone = [], [], []
    for _ in range(1500):
        pattern = truth * rng.standard_normal(number)
        looked = pattern + rng.standard_normal(number) / np.sqrt(3)
        held = pattern + rng.standard_normal(number)
        every = (3 * looked + held) / 4
        a, b, c = (
            variance_score(float(np.sum(x**2)), n, number) for x, n in ((looked, 3), (held, 1), (every, 4))
        )
        if a.amplitude**2 < 3.5 * a.shift**2:
            continue
        score = strength_beyond(a, c, b)
        error.append(score.amplitude**2 - ratio)
        alone.append(b.amplitude**2 - ratio)
        covered.append(abs(score.amplitude - truth) < 1.645 * score.error)
    assert len(covered) > 100 and 0.85 < np.mean(covered) < 0.96
    assert abs(np.mean(error)) < 0.25 * np.std(error) + 3 * np.std(error) / np.sqrt(len(error))
    assert np.std(error) <= 1.05 * np.std(alone)


def _scoring(name, log_p, rare=False, gain=1.0):
    """A signature whose score on any fields is this one."""
    score = Score(
        log_p=log_p, gain=gain, penalty=0.0, amplitude=1.0, error=1.0, shift=1.0, power=1,
        parameters={}, where={"axis": "row"},
    )  # fmt: skip
    return dataclasses.replace(SIGNATURES["frame_additive"], name=name, score=lambda fields: score, rare=rare)


@pytest.mark.parametrize("log_p, gain", [(-9.0, float("nan")), (float("nan"), 1.0), (-9.0, float("inf"))])
def test_a_score_that_is_no_number_is_left_out_alone_and_says_so(log_p, gain):
    with pytest.warns(NotJudgedWarning, match="wrong: its score is not a number"):
        found = locate((), (_scoring("right", -9.0), _scoring("wrong", log_p, gain=gain)))
    assert list(found.scores) == ["right"]
    assert found.log_p == locate((), (_scoring("right", -9.0),)).log_p


def test_a_rare_test_takes_little_of_the_error_rate_and_pays_for_it():
    found = locate((), (_scoring("a", -9.0), _scoring("b", -9.0), _scoring("c", -9.0, rare=True)))
    assert found.log_p["a"] == pytest.approx(sidak(-9.0, found.tests))
    assert found.log_p["c"] == pytest.approx(sidak(-9.0, found.tests / SHARED.rare))
    rng = np.random.default_rng(54)
    p = rng.uniform(size=(20000, 3))
    p[:, 2] = 1.0
    rejected = np.mean([min(sidak(np.log(v), found.tests) for v in row[:2]) < np.log(0.05) for row in p])
    assert rejected < 0.055 / SHARED.effective  # independent ones, which the battery's are not
