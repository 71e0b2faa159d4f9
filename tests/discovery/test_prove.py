"""Held-out gains: right against known parameters, honest about few frames, without leaks between splits."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.blocks import frame_blocks, leave_out
from cannoise_jax.discovery.frames.splits import prepare_split, split_frames, split_recordings
from cannoise_jax.discovery.proof.gains import frame_interval, held_out_gain
from cannoise_jax.discovery.proof.heldout import Predicted, Scored, score_frames
from cannoise_jax.discovery.proof.prove import (
    Proof,
    Proofs,
    others_out,
    refuted,
    standing,
    without_doubted_gain,
)
from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt, Named
from cannoise_jax.discovery.search.steps import Fitted, Step
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.fields import frame_fields
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.waves import wave_score
from tests.discovery.capture import SIZE, capture_set, column_pattern, frame_offsets, row_offsets
from tests.discovery.looks import SIGNATURES, white


def halves(capture):
    splits = split_recordings(capture)
    chosen = [b for _, b in splits]
    return prepare_split(capture, splits), prepare_split(capture, splits, held_back=True), chosen


def gain(capture, *found):
    first, second, chosen = halves(capture)
    base = score_frames(first, second, chosen, [])
    full = score_frames(first, second, chosen, list(found))
    return frame_interval(full, base)


@pytest.mark.parametrize("sigma", [1.5, 45.0])
def test_gain_of_row_noise_is_that_of_the_exact_gaussian_likelihood(sigma):
    read = 4.5
    capture = capture_set(31, row_offsets(sigma), kinds="d")
    value, low, high = gain(capture, Predicted("additive", row=sigma))
    exact = 0.0
    for r in capture.recordings:
        x = np.asarray(r.frames, float)[split_frames(r.count)[1]] - 200.0
        w, total = x.shape[2], np.sqrt(read**2 + sigma**2 + 1 / 12)
        within = total**2 - sigma**2
        # Exact law of rows with a shared offset, against independent pixels of the same variance.
        means, squares = x.mean(2), (x**2).sum(2)
        shared = squares / within - w**2 * means**2 * sigma**2 / (within * (within + w * sigma**2))
        log_det = (w - 1) * np.log(within) + np.log(within + w * sigma**2)
        exact += float(np.sum(0.5 * (squares / total**2 + w * np.log(total**2) - shared - log_det)))
    assert value == pytest.approx(exact, rel=0.05)
    assert low < value < high and high - low < value


def test_doubt_about_a_pattern_is_no_gain_in_noise_with_tails():
    """Of single bright values, which the variance of most pixels does not hold, it is a better law alone."""

    def bright(rng):
        return lambda dn, *_: dn + (rng.random(dn.shape) < 0.01) * rng.exponential(20.0, dn.shape)

    first, second, chosen = halves(capture_set(41, bright, kinds="d", frames=12))
    law = Predicted("additive", 0.01 * np.random.default_rng(1).standard_normal(SIZE), 0.3)
    with_it, left_out, none = (score_frames(first, second, chosen, m) for m in ([law], [law.left_out], []))
    assert frame_interval(with_it, none)[1] > 0
    assert abs(frame_interval(with_it, left_out)[0]) < 3 < frame_interval(with_it, none)[0]
    assert Predicted("additive", row=1.0).left_out is None


def test_what_is_not_there_loses():
    value, _, high = gain(capture_set(32, kinds="d"), Predicted("additive", row=1.5))
    assert value < 0 and high < 0


def test_a_frozen_pattern_is_learned_in_one_half_and_predicts_the_other():
    found = diagnose(capture_set(33, column_pattern(1.0), kinds="d"), compare=False)
    (proof,) = found.proofs
    assert found.findings == ["column_fpn"] and proof.basis == "likelihood" and proof.confirmed
    assert proof.log_e == pytest.approx(proof.gain - 6)
    # A pattern of other columns, as strong, predicts nothing and is the worse for it.
    step = found.fitted.steps[0]
    first, second, chosen = halves(capture_set(33, column_pattern(1.0), kinds="d"))
    rng = np.random.default_rng(0)
    wrong = Predicted("additive", rng.standard_normal((1, step.before[0].mean.shape[1])), 0.1)
    base, full = (score_frames(first, second, chosen, law) for law in ([], [wrong]))
    assert frame_interval(full, base)[0] < 0


def test_likelihood_counts_codes_not_densities():
    """Minus the log-probability of codes is at least the entropy of the noise rounded to them."""
    first, second, chosen = halves(capture_set(34, kinds="d", step=16.0, read=3.0))
    scored = score_frames(first, second, chosen, [])
    nll = -scored.log_prob.sum() / scored.pixels.sum()
    codes = np.concatenate(
        [np.asarray(r.frames)[3::4].ravel() for r in capture_set(34, kinds="d", step=16.0).recordings]
    )
    share = np.unique(codes, return_counts=True)[1] / codes.size
    entropy = -np.sum(share * np.log(share))
    assert nll > 0 and nll == pytest.approx(entropy, abs=0.02)


def test_a_reference_of_the_own_frames_is_rebuilt_from_the_other_half():
    """A mean that holds the judged frames would make them look less noisy than they are."""
    capture = capture_set(35, kinds="s")
    own = tuple(
        dataclasses.replace(
            r,
            clean=((np.asarray(r.frames, np.float32).mean(0) - 200) / 16183).astype(np.float32),
            reference="burst_mean",
            reference_frames=r.count,
        )
        for r in capture.recordings
    )
    values = []
    for recordings in (capture.recordings, own):
        first, second, chosen = halves(CaptureSet("c", recordings))
        scored = score_frames(first, second, chosen, [])
        values.append(-scored.log_prob.sum() / scored.pixels.sum())
    # Three frames in the mean: a third of the noise is added to the difference, 0.5 log 4/3 nats.
    assert values[1] - values[0] == pytest.approx(0.5 * np.log(4 / 3), abs=0.03)


def test_interval_is_calibrated_on_frames_of_equal_law():
    rng = np.random.default_rng(0)
    recording = np.repeat(np.arange(6), [2, 2, 2, 4, 4, 4])
    covered = 0
    for _ in range(400):
        gains = rng.normal(3.0, 2.0, recording.size)
        scored = Scored(gains, recording, np.full(recording.size, 10))
        value, low, high = frame_interval(scored, scored._replace(log_prob=np.zeros(recording.size)))
        assert value == pytest.approx(gains.sum())
        covered += low <= 3.0 * recording.size <= high
    assert 0.85 < covered / 400 < 0.95


def test_one_frame_in_all_has_no_interval():
    one = Scored(np.array([1.0]), np.array([0]), np.array([10]))
    value, low, high = frame_interval(one, one._replace(log_prob=np.zeros(1)))
    assert value == 1 and np.isnan(low) and np.isnan(high)


def test_leaving_frames_out_equals_never_having_had_them():
    capture = capture_set(36, frame_offsets(0.5), kinds="d")
    fields = prepare(capture, [[0, 1, 2, 3], [0, 1]], False).fields
    left = leave_out(fields, [(0, 2), (1, 0), (1, 1)])
    assert len(left) == 1 and left[0].frames == 3
    frames = frame_fields(fields[0])[[0, 1, 3]]
    np.testing.assert_allclose(frame_fields(left[0]), frames, atol=1e-4)
    blocks = frame_blocks(fields, 3)
    assert sorted(frame for block in blocks for frame in block) == [(0, t) for t in range(4)] + [
        (1, 0),
        (1, 1),
    ]
    assert any({(1, 0), (1, 1)} <= set(block) for block in blocks)


def test_too_few_frames_confirm_nothing():
    capture = capture_set(37, row_offsets(6.0), kinds="d", frames=2)
    found = diagnose(CaptureSet(capture.camera, capture.recordings[:1]), compare=False)
    assert found.findings == ["row_noise"]
    for proof in found.proofs:
        assert not proof.confirmed


@pytest.mark.parametrize("found", [0.2, 0.9, 1.0, 1.1, 5.0])
@pytest.mark.parametrize("error", [0.0, 1e-40, 0.1, np.inf])
def test_held_out_gain_is_never_more_than_the_best_and_never_absurd(found, error):
    again = Score(
        log_p=-20.0, gain=40.0, penalty=7.0, amplitude=1.0, error=error, shift=0.5, power=2,
        parameters={}, where={"axis": "row"},
    )  # fmt: skip
    gain = held_out_gain(again.replace(amplitude=found), again)
    assert 40.0 - 0.5 * 50**2 <= gain <= 40.0
    if found == 1.0 and error > 0:
        assert gain == 40.0
    if error == 0.1:  # variances 0.2 apart in the amplitude's square per error of 2 * 1 * 0.1
        assert gain == pytest.approx(40 - 0.5 * np.clip((found**2 - 1) / 0.2, -50, 50) ** 2)
    if error == 0.0:
        assert gain == 33.0


def test_a_wave_is_proved_at_the_frequency_that_it_was_found_at():
    """In two frames a weak wave is not the strongest; where others tell its frequency it shows its own
    strength and not that of the noise."""
    rng = np.random.default_rng(3)
    y, x = np.indices((64, 96))
    amplitude, frequency = 0.065, (0.1, 0.231)
    turn = 2 * np.pi * (frequency[0] * y + frequency[1] * x)
    anywhere, there = [], []
    for seed in range(30):
        fields = white(np.random.default_rng(seed), kinds=("dark",), frames=3, sigma=1.0)
        phases = rng.uniform(0, 2 * np.pi, (2, 1, 1))
        fields = (
            fields[0]._replace(contrasts=fields[0].contrasts + np.float32(amplitude) * np.cos(turn + phases)),
        )
        found = wave_score(fields, time="redrawn")
        again = wave_score(fields, time="redrawn", near=frequency)
        anywhere.append(found.payload[:2])
        there.append(again.amplitude)
        assert np.hypot(again.payload[0] - frequency[0], again.payload[1] - frequency[1]) < 1.2 / 64
    lost = [np.hypot(a - frequency[0], b - frequency[1]) > 1.2 / 64 for a, b in anywhere]
    assert np.mean(lost) > 0.05  # the search of the whole plane goes astray
    assert np.mean(there) == pytest.approx(amplitude, rel=0.2)


@pytest.mark.parametrize("other, gains", [((0.104, 0.002), True), ((0.11, 0.002), False)])
def test_what_is_found_elsewhere_is_no_gain(other, gains):
    found = Score(
        log_p=-20.0, gain=25.0, penalty=3.0, amplitude=1.0, error=0.2, shift=0.3, power=2,
        parameters={}, where={"axis": "frequency"}, spot={"frequency": (0.1, 0.005)},
    )  # fmt: skip
    assert (held_out_gain(found, found.replace(spot={"frequency": other})) > 0) == gains


@pytest.mark.parametrize(
    ("name", "again", "gain", "gone"),
    [
        ("dsnu", (0.0, 0.4), 0.5, True),  # a map that is another one in them
        ("dsnu", (0.3, 0.4), 0.5, False),
        ("row_noise", (0.0, 0.1), -0.6, True),  # excluded: at most 0.16 of the 1.0 that was found
        ("row_noise", (0.0, 0.4), -0.6, False),  # too few frames to say
        ("row_noise", (0.0, 0.4), -4.0, True),  # they lose surely
        ("row_noise", (0.0, 0.1), 2.0, False),  # they gain by it
        ("row_noise", (0.3, 0.1), -0.6, False),  # they show some of it
        (UNKNOWN, (0.3, 0.1), -0.6, True),  # without a name, of which they show less than half
        (UNKNOWN, (0.8, 0.1), 2.0, False),
    ],
)
def test_what_the_frames_held_back_exclude_is_no_finding(name, again, gain, gone):
    found = Score(
        log_p=-20.0, gain=25.0, penalty=3.0, amplitude=1.0, error=0.2, shift=0.3, power=2,
        parameters={}, where={"axis": "row"},
    )  # fmt: skip
    rows = SIGNATURES["pixel_additive_static" if name == "dsnu" else "row_additive_temporal"]
    step = Step(Named(found, rows, name, ((name, 1.0),), False), (), -20.0)
    proof = Proof(found.replace(amplitude=again[0], error=again[1]), gain, gain - 1, gain + 1, 9)
    empty = Located({}, {}, 1.0)
    fitted, proofs = standing(Fitted((step,), (), empty, empty), Proofs((proof,), None, None))
    assert (len(fitted.steps), len(proofs.each)) == ((0, 0) if gone else (1, 1))
    assert not refuted(step._replace(late=True), proof)


@pytest.mark.parametrize(("name", "gone"), [("wave_frozen", True), ("wave_redrawn", False), ("comb", False)])
def test_a_pattern_that_stays_is_no_finding_where_frames_held_back_have_it_elsewhere(name, gone):
    found = Score(
        log_p=-20.0, gain=25.0, penalty=3.0, amplitude=1.0, error=0.2, shift=0.3, power=2,
        parameters={}, where={"axis": "frequency"}, spot={"frequency_y": (0.1, 0.005)},
    )  # fmt: skip
    step = Step(Named(found, SIGNATURES[name], name, ((name, 1.0),), False), (), -20.0)
    there, elsewhere = (found.replace(spot={"frequency_y": (f, 0.005)}) for f in (0.102, 0.12))
    assert not refuted(step, Proof(there, 0.0, -1.0, 1.0, 9))
    assert refuted(step, Proof(elsewhere, 0.0, -1.0, 1.0, 9)) == gone
    assert not refuted(step, Proof(elsewhere, 5.0, 2.0, 8.0, 9))
    assert not refuted(step, Proof(elsewhere, 4.0, -0.5, 8.0, 9))


@pytest.mark.parametrize(
    ("name", "low", "gone"),
    [("excess_noise", -1.0, True), ("excess_noise", 1.0, False), (UNKNOWN, 1.0, True)],
)
def test_what_the_gain_is_lowered_by_has_to_be_confirmed(name, low, gone):
    """A random gain of some 0.9 halves the gain of a camera, and no draw tells both apart."""
    found = Score(
        log_p=-6.0, gain=5.0, penalty=3.0, amplitude=0.9, error=0.3, shift=0.3, power=1,
        parameters={}, where={"axis": "signal"},
    )  # fmt: skip
    signature = SIGNATURES["excess_skewness"]
    step = Step(Named(found, signature, name, ((name, 1.0),), False), (), -6.0)
    proof = Proof(found, 2.2, low, 6.0, 9)
    assert refuted(step, proof) == gone and refuted(step._replace(late=True), proof) == gone


def test_a_random_gain_that_loses_its_name_goes_and_all_else_stays():
    found = Score(
        log_p=-6.0, gain=5.0, penalty=3.0, amplitude=0.9, error=0.3, shift=0.3, power=1,
        parameters={}, where={"axis": "signal"},
    )  # fmt: skip
    names = ("excess_skewness", "row_additive_temporal")
    steps = tuple(Step(Named(found, SIGNATURES[n], "x", (("x", 1.0),), False), (), -6.0) for n in names)
    proofs = Proofs((Proof(found, 2.2, 1.0, 6.0, 9),) * 2, None, None)
    fitted, doubt = Fitted(steps, (), Located({}, {}, 1.0), Located({}, {}, 1.0)), Doubt(1.0, ("it",))
    assert without_doubted_gain(fitted, proofs, (None, doubt)) is None
    left, told = without_doubted_gain(fitted, proofs, (doubt, doubt))
    assert left.steps == steps[1:] and len(told.each) == 1


@pytest.mark.parametrize("columns", [0.0, 1.0])
def test_an_offset_of_frames_keeps_its_strength_beside_noise_of_lines(columns):
    """Of a row all noise is taken out together, what its frame has included."""

    def alter(rng):
        def change(dn, signal, kind, t):
            rows = 1.5 * rng.standard_normal((dn.shape[0], 1))
            lines = rows + columns * rng.standard_normal((1, dn.shape[1]))
            return dn + lines + 2.0 * rng.standard_normal()

        return change

    capture = capture_set(31, alter, kinds="d", frames=16)
    first, _, _ = halves(capture)
    names = ["row_additive_temporal", *(["column_additive_temporal"] if columns else []), "frame_additive"]
    fields, steps = first.fields, []
    for name in names:
        signature = next(s for s in first.signatures if s.name == name)
        score = signature.score(fields)
        steps.append(Step(Named(score, signature, name, ((name, 1.0),), False), fields, -99.0))
        fields = signature.absorb(fields, score)
    proved = steps[-1].named.signature.score(others_out(tuple(steps), first.fields)(len(steps) - 1))
    assert proved.amplitude == pytest.approx(2.0, abs=3 * proved.error) and proved.error < 0.5
