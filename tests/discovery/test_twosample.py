"""The two-sample test: blind to equal laws, not to others, and its intervals mean what they say."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.frames.draws import spread_codes
from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.proof.patch_network import Patches, all_features, cut, train
from cannoise_jax.discovery.proof.twosample import (
    Scored,
    area,
    decided,
    decision_size,
    grouped,
    judge,
    resampled,
    two_sample,
)
from tests.discovery.capture import capture_set, row_offsets


def pair(seed, alter=None):
    capture = capture_set(seed, alter, kinds="df")
    splits = split_recordings(capture)
    return tuple(prepare_split(capture, splits, held_back=held).fields for held in (False, True))


@pytest.fixture(scope="module")
def plain():
    return [pair(seed) for seed in (41, 42, 43)]


def test_equal_laws_cannot_be_told_and_row_noise_can(plain):
    quiet = two_sample(0, plain[0], plain[1], None, (plain[2], plain[1]), None)
    assert quiet.before.low <= 0.5 <= quiet.before.high
    assert quiet.change is None and quiet.after == quiet.before
    noisy = pair(44, row_offsets(3.0))
    told = two_sample(0, noisy, plain[0], plain[1], (plain[2], plain[0]), 3.0)
    assert told.before.value > 0.7 and told.control > 0.6 and told.patches == 1
    # "After" is judged by the same law as "before": plain draws, too.
    assert abs(told.change.value) < 0.1 and told.change.low <= 0 <= told.change.high


def scored(rng, shift=0.0, recordings=(3, 1, 1, 1, 2, 1, 1), patches=48, frame=0.0, recording=0.0):
    """Scores as the network gives them: apart by `shift`, with offsets of every frame and of every recording,
    those of the latter alike for the recordings and the draws."""
    number = np.repeat(np.arange(len(recordings)), recordings)
    several = np.array(recordings)[number] > 1
    offset = recording * rng.standard_normal(len(recordings))[number]
    where = np.repeat(np.arange(number.size), patches)
    told, plain = (
        (offset + frame * rng.standard_normal(number.size))[where] + rng.standard_normal(where.size)
        for _ in range(2)
    )
    return Scored(told + shift, plain, where, where, number, np.where(several, number, -1))


def test_patches_of_a_decision_grow_until_the_control_is_told():
    rng = np.random.default_rng(1)
    assert decision_size(scored(rng, 0.6), 0)[0] == 1
    size, reached = decision_size(scored(rng, 0.3), 0)
    assert 1 < size <= 12 and reached >= 0.6


@pytest.mark.slow
def test_where_no_number_of_patches_tells_the_control_each_decides_alone():
    """Few large decisions reach 0.6 by chance in many sets: that is no control."""
    rng = np.random.default_rng(2)
    out = [decision_size(scored(rng, patches=256), 0) for _ in range(20)]
    assert np.mean([size == 1 for size, _ in out]) >= 0.8
    assert all(reached < 0.6 for size, reached in out if size == 1)


@pytest.mark.slow
@pytest.mark.parametrize("size", [1, 8])
def test_intervals_hold_the_area_of_equal_laws_with_few_judged_frames(size):
    rng = np.random.default_rng(3)
    held = []
    for seed in range(80):
        low, high = np.quantile(resampled([scored(rng, frame=0.2)], size, seed), (0.05, 0.95))
        held.append(low <= 0.5 <= high)
    assert 0.8 < np.mean(held) < 0.97


def test_what_tells_one_recording_from_another_does_not_blur_the_area():
    rng = np.random.default_rng(4)
    apart, together = (decided(scored(rng, 0.5, recording=r), 4, 0) for r in (20.0, 0.0))
    assert apart == pytest.approx(together, abs=0.06) and apart > 0.75


def test_a_recording_that_errs_the_other_way_is_told_too():
    """Noise too strong in one recording and too weak in another."""
    rng = np.random.default_rng(5)

    def patches(scales):
        values = [s * rng.standard_normal((60, 32, 32)) for s in scales]
        which = np.repeat(np.arange(len(scales)), 60)
        return Patches(np.concatenate(values).astype(np.float32), which, which)

    network = train(patches((1.05, 0.95)), patches((1.0, 1.0)))
    told, plain = (network.scores(patches(s)) for s in ((1.05, 0.95), (1.0, 1.0)))
    for part in (slice(0, 60), slice(60, 120)):
        assert area(told[part], plain[part]) > 0.8


def test_recordings_that_agree_share_their_weights():
    rng = np.random.default_rng(6)
    which = np.repeat(np.arange(6), 40)

    def patches(scale):
        return Patches((scale * rng.standard_normal((240, 32, 32))).astype(np.float32), which, which)

    weights = train(patches(1.05), patches(1.0)).weights
    mean = weights.mean(0)
    for w in weights:
        assert np.dot(w, mean) > 0.8 * np.linalg.norm(w) * np.linalg.norm(mean)
    assert all_features(patches(1.0).values).shape == (240, weights.shape[1])


def test_training_and_judged_patches_share_no_pixel(plain):
    fields = plain[0][0]
    marked = tuple(
        f._replace(contrasts=np.ones_like(f.contrasts) * (1 + np.arange(f.mean.size).reshape(f.mean.shape)))
        for f in fields
    )
    a, b = ({float(v) for v in np.unique(cut(marked, parity, 0).frame)} for parity in (0, 1))
    assert a == b  # every frame gives patches to both regions
    sizes = [len(cut(fields, parity, 0).values) for parity in (0, 1)]
    assert sum(sizes) == sum(f.frames for f in fields) * (96 // 32) * (128 // 32)


def test_area_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(1)
    a, b = rng.integers(0, 5, 40).astype(float), rng.integers(0, 5, 30).astype(float)
    naive = np.mean([(x > y) + 0.5 * (x == y) for x in a for y in b])
    assert area(a, b) == pytest.approx(naive)


def test_groups_are_means_within_one_frame():
    scores, frame = np.arange(12.0), np.repeat([0, 1, 2], 4)
    values, frames = grouped(scores, frame, 4, np.random.default_rng(0))
    assert values.tolist() == [1.5, 5.5, 9.5] and frames.tolist() == [0, 1, 2]
    values, frames = grouped(scores, frame, 2, np.random.default_rng(0))
    assert values.size == 6 and values.mean() == pytest.approx(5.5)


def test_resampled_areas_scatter_about_the_measured_one(plain):
    told = judge(pair(45, row_offsets(1.5)), plain[0], 0)
    drawn = resampled([told], 2, 0)[0]
    assert abs(drawn.mean() - decided(told, 2, 0)) < 0.03 and 0.005 < drawn.std() < 0.1


def test_codes_are_spread_over_their_step(plain):
    field = plain[0][0][0]
    values = spread_codes(field, np.random.default_rng(0)) * field.sigma
    lattice = (values + field.mean) / field.step
    assert np.unique(np.round(np.abs(lattice - np.round(lattice)), 2)).size > 40
