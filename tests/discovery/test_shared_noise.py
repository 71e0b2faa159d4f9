"""Tails of every pixel by itself come back as their law has them; noise that neighbours share has none."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.shared_noise import shared, shared_lines
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.signatures.shape import lambda_of
from tests.discovery.capture import capture_set


def alone(law):
    """Noise of a law in every pixel by itself."""
    return lambda rng: lambda dn, *_: dn + 12 * law(rng, dn.shape)


def stronger(shape):
    """Noise as strong in whole blocks or rows as these draw."""

    def alter(rng):
        def change(dn, *_):
            cells = [-(-n // s) for n, s in zip(dn.shape, shape, strict=True)]
            loud = np.exp(0.3 * rng.standard_normal(cells))
            loud = np.kron(loud, np.ones(shape))[: dn.shape[0], : dn.shape[1]]
            return dn + 12 * loud * rng.standard_normal(dn.shape)

        return change

    return alter


def tukey(shape):
    return lambda rng, size: (
        stats.tukeylambda.ppf(rng.random(size), shape) / np.sqrt(stats.tukeylambda.stats(shape, moments="v"))
    )


def student(freedom):
    return lambda rng, size: rng.standard_t(freedom, size) / np.sqrt(freedom / (freedom - 2))


def step_of(alter, seed=3):
    """The finding of heavy tails in darks that are altered so."""
    capture = capture_set(seed, alter, read=0.3, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = (s for s in prepared.signatures if s.axes.law == "heavy tails")
    score = signature.score(prepared.fields)
    named = Named(score, signature, "heavy_tails", (("heavy_tails", 1.0),), False)
    return Step(named, prepared.fields, score.log_p)


@pytest.mark.parametrize("shape", [0.05, -0.05, -0.1])
def test_the_shape_of_the_law_that_is_drawn_comes_back(shape):
    score = step_of(alone(tukey(shape))).named.score
    truth = float(stats.tukeylambda.stats(shape, moments="k"))
    assert abs(score.amplitude - truth) < 3 * score.error + 0.05 * truth
    assert lambda_of(truth) == pytest.approx(shape, abs=1e-3)


def test_very_long_tails_have_a_strength_that_samples_show():
    values = [step_of(alone(student(4)), seed).named.score for seed in (1, 2)]
    assert all(2 < v.amplitude < 19.3 and v.error > 0.02 * v.amplitude for v in values)


@pytest.mark.parametrize("alter", [alone(tukey(-0.1)), alone(student(5))])
def test_tails_of_single_pixels_stay(alter):
    assert shared(step_of(alter)) is None


@pytest.mark.parametrize(("shape", "where"), [((8, 8), "rows"), ((1, 128), "rows"), ((96, 2), "columns")])
def test_noise_that_neighbours_share_is_told(shape, where):
    said = shared(step_of(stronger(shape)))
    assert said is not None and said.left > 0.3
    assert where in said.against[0] or shape == (8, 8)


def louder(together):
    """Columns at the left that are louder, of an offset that each row has there and that dies away, or each
    pixel by itself."""

    def alter(rng):
        def change(dn, *_):
            across = 8 * np.exp(-np.arange(dn.shape[1]) / 12)
            row = rng.standard_normal((dn.shape[0], 1)) if together else rng.standard_normal(dn.shape)
            return dn + 8 * rng.standard_normal(dn.shape) + row * across

        return change

    return alter


@pytest.mark.parametrize("together", [True, False])
def test_columns_that_are_loud_together_have_no_noise_of_their_own(together):
    capture = capture_set(4, louder(together), read=0.3, kinds="d")
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    (signature,) = (s for s in prepared.signatures if s.name == "column_spread")
    score = signature.score(prepared.fields)
    assert score.log_p < -12
    named = Named(score, signature, "column_read_noise_map", (("column_read_noise_map", 1.0),), False)
    against = shared_lines(Step(named, prepared.fields, score.log_p))
    assert (against is not None) == together
