"""Tails to one side of what stands out: told with their size, and from what lies on both sides."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.signatures.deferred import Deferred, put_back, shifted_out, taken_back
from cannoise_jax.signatures.tails import tail_score
from tests.discovery.drawn import standing_out
from tests.discovery.looks import SIGNATURES, white
from tests.discovery.planted import with_tails
from tests.discovery.test_signature_laws import UNLIKELY, off_by

BOTH = pytest.mark.parametrize("axis", [0, 1])


@BOTH
def test_a_tail_is_found_with_its_size_and_its_error(axis):
    scores = [tail_score(with_tails(axis, 0.1, seed), axis=axis) for seed in range(20)]
    values, errors = zip(*((s.amplitude, s.error) for s in scores), strict=True)
    assert max(s.log_p for s in scores) < -12 and off_by(values, errors) > UNLIKELY
    assert abs(np.mean(values) - 0.1) < 2 * np.mean(errors)
    assert all(s.parameters["fraction"][0] > 0 and s.parameters["length_px"][0] < 0.6 for s in scores)


@BOTH
def test_nothing_is_said_of_the_other_axis(axis):
    scores = [tail_score(with_tails(axis, 0.1, seed), axis=1 - axis) for seed in range(10)]
    assert min(s.log_p for s in scores if s is not None) > np.log(1e-3)


def many(seed, share, dense=0.02):
    """Darks with hundreds of hot pixels, or few, of which each leaves a share to the next one down."""
    rng, size = np.random.default_rng([5, seed]), (96, 128)
    hot = np.where(rng.random(size) < dense, 20 + rng.exponential(60.0, size), 0.0)
    late = (1 - share) * hot + share * np.roll(hot, 1, 0)
    fields = white(rng, kinds=("dark",), frames=6, size=size)
    return tuple(f._replace(static=(f.static + late).astype(np.float32)) for f in fields)


def test_what_is_said_to_be_detectable_is_detected():
    """The sum of the signs of n differences is at most the root of n: few pixels exclude nothing."""
    assert all(tail_score(many(seed, 0.0, dense=0.0018), axis=0) is None for seed in range(4))
    seen = []
    for seed in range(8):
        least = tail_score(many(seed, 0.0), axis=0).mde
        assert 0 < least < 0.2
        told = tail_score(many(seed, least), axis=0)
        seen.append(told is not None and told.log_p < -9)
    assert sum(seen) >= 3


def turned(fields):
    return tuple(
        f._replace(contrasts=f.contrasts[:, ::-1].copy(), static=f.static[::-1].copy()) for f in fields
    )


def test_a_tail_the_other_way_has_the_other_sign():
    score = tail_score(turned(with_tails(0, 0.1)), axis=0)
    assert score.log_p < -12 and score.parameters["fraction"][0] == pytest.approx(-0.1, abs=0.02)


def spread(x, share):
    beside = sum(np.roll(x, by, axis) for axis in (-1, -2) for by in (-1, 1))
    return ((1 - share) * x + share / 4 * beside).astype(np.float32)


def in_pairs(x, rng):
    """Every pixel that stands out has another one below or above, by chance."""
    far = np.where(np.abs(x) > 6, x, 0)
    side = rng.integers(0, 2, x.shape[-2:])
    return (x + 0.4 * np.where(side, np.roll(far, 1, -2), np.roll(far, -1, -2))).astype(np.float32)


@pytest.mark.parametrize("by", ["spread", "pairs", "columns", "slope"])
def test_what_lies_on_both_sides_is_no_tail(by):
    p = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        fields = standing_out(seed)
        size = fields[0].static.shape
        level = {"columns": 8 * rng.standard_normal(size[1]), "slope": np.linspace(0, 60, size[0])[:, None]}
        laid = {"spread": partial(spread, share=0.2), "pairs": partial(in_pairs, rng=rng)}
        more = laid.get(by, partial(np.add, level.get(by, 0.0)))
        moved = tuple(f._replace(static=more(f.static).astype(np.float32)) for f in fields)
        p += [np.exp(s.log_p) if (s := tail_score(moved, axis=axis)) else 1.0 for axis in (0, 1)]
    assert len(p) > 12 and stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-4


def test_charge_is_put_back_where_it_was():
    rng = np.random.default_rng(0)
    x = rng.random((3, 20, 30)) * 100
    for by in (
        Deferred(0, 0.2, 2.0, 0.5, (0.0, 0.02)),
        Deferred(1, -0.3, 5.0, 0.0),
        Deferred(1, 0.1, 0.2, 1.0),
    ):
        out = shifted_out(x, by)
        assert np.abs(out - x).max() > 1 and np.allclose(put_back(out, by), x, atol=1e-3)


def test_nothing_is_left_of_a_tail_that_is_taken_back():
    fields = with_tails(0, 0.1)
    score = tail_score(fields, axis=0)
    left = tail_score(taken_back(fields, score), axis=0)
    assert left.log_p > np.log(1e-3) or left.amplitude < 0.01


def test_a_report_says_to_which_side():
    signature, score = SIGNATURES["tail_row"], tail_score(with_tails(1, 0.1), axis=1)
    entry = {
        "amplitude": {"value": score.amplitude, "ci90": score.interval90},
        "parameters": {name: {"value": value} for name, (value, _, _) in score.parameters.items()},
    }
    said, (low, high) = signature.says(entry)
    assert "with the pixels on the right" in said and "farther" not in said and low < 0.1 < high
    entry["parameters"] |= {"fraction": {"value": np.float64(-0.1)}, "growth": {"value": 0.5}}
    said, _ = signature.says(entry)
    assert "on the left" in said and "more the farther it was shifted" in said
