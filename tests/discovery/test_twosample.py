"""The two-sample test: blind to equal laws, not to others, and its intervals mean what they say."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.battery import prepare_split, split_recordings
from cannoise_jax.discovery.draws import spread_codes
from cannoise_jax.discovery.twosample import area, cut, decided, grouped, judge, resampled, two_sample
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


def test_patches_of_a_decision_grow_until_the_control_is_told(plain):
    weak = two_sample(0, plain[0], plain[1], None, (plain[2], plain[1]), 0.3)
    assert weak.patches > 1


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
    scored = judge(pair(45, row_offsets(1.5)), plain[0], 0)
    drawn = resampled([scored], 2, 0)[0]
    assert abs(drawn.mean() - decided(scored, 2, 0)) < 0.03 and 0.005 < drawn.std() < 0.1


def test_codes_are_spread_over_their_step(plain):
    field = plain[0][0][0]
    values = spread_codes(field, np.random.default_rng(0)) * field.sigma
    lattice = (values + field.mean) / field.step
    assert np.unique(np.round(np.abs(lattice - np.round(lattice)), 2)).size > 40
