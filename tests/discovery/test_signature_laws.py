"""Laws that all signatures follow: that of nothing, the spread of what they find, and what must not matter to
them - the order of recordings, an offset of all codes, rows for columns."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.score import Score
from tests.discovery.drawn import (
    BLACK,
    Many,
    capture,
    null_scores,
    of,
    prepared,
    recorded,
    seen_in,
    shown,
    turned,
    turned_recordings,
)
from tests.discovery.looks import SIGNATURES
from tests.discovery.planted import OWN, SHARED, TRUE, by_own_law, planted

ALL = list(SIGNATURES.values())
OFTEN = [s.name for s in ALL if not s.rare]
RARELY = [s.name for s in ALL if s.rare]
UNLIKELY = 1e-5
"""Chance at which a statistic of the draws is held against a signature: some 200 are looked at."""


@pytest.mark.parametrize("name", OFTEN)
def test_p_is_not_too_small_without_an_effect(name):
    scores = null_scores(name)
    assert len(scores) > 10
    p = np.exp([s.log_p for s in scores])
    assert stats.kstest(p, "uniform", alternative="greater").pvalue > 1e-4
    assert all(s.log_p <= 0 and s.gain >= 0 and s.error >= 0 and s.shift > 0 for s in scores)


@pytest.mark.parametrize("name", RARELY)
def test_a_rare_test_rejects_rarely(name):
    rejected = [s.log_p < np.log(0.1) for s in null_scores(name)]
    assert len(rejected) >= 20
    assert stats.binomtest(sum(rejected), len(rejected), 0.1, alternative="greater").pvalue > 1e-3


def off_by(values: Sequence[float], errors: Sequence[float]) -> float:
    """Chance that values of these standard errors scatter as much, or as little (chi-square, two sides)."""
    v, e = np.array(values), np.array(errors)
    spread, freedom = float(np.sum(((v - np.average(v, weights=e**-2)) / e) ** 2)), len(v) - 1
    return 2 * min(float(stats.chi2.sf(spread, freedom)), float(stats.chi2.cdf(spread, freedom)))


def test_the_spread_of_draws_tells_an_error_that_is_a_third_or_three_times_as_large():
    values = np.random.default_rng(0).standard_normal(20)
    assert off_by(values, np.ones(20)) > 0.01
    assert max(off_by(values, np.full(20, error)) for error in (1 / 3, 3.0)) < UNLIKELY


@pytest.mark.parametrize("signature", SHARED, ids=lambda s: s.name)
def test_the_error_of_what_is_planted_is_the_spread_of_what_is_found(signature):
    looks = [planted(signature, 100.0, seed) for seed in range(20)]
    found = [(signature.score(fields), amplitude) for fields, amplitude in looks]
    values, errors = zip(*((s.amplitude / a, s.error / a) for s, a in found), strict=True)
    assert off_by(values, errors) > UNLIKELY
    assert abs(np.mean(values) - 1) < 2 * np.mean(errors)


@pytest.mark.parametrize("name", OWN)
def test_the_error_of_what_a_law_of_its_own_leaves_is_the_spread_of_what_is_found(name):
    scores = [SIGNATURES[name].score(by_own_law(name, seed)) for seed in range(20)]
    values, errors = zip(*((s.amplitude, s.error) for s in scores), strict=True)
    assert off_by(values, errors) > UNLIKELY
    if name in TRUE:
        assert abs(np.mean(values) - TRUE[name]) < 3 * np.mean(errors)


SEARCHED = ("step", "lags_any", "lags_read", "taps", "glow", "tail_column", "tail_row")
"""Signatures whose value without an effect is the largest of many, which scatters by more than one of them,
or their mean, which scatters by less."""


def signed(scores: list[Score]) -> list[str]:
    """Parameters that are estimated with their sign, so that chance gives either."""
    values = {n: [s.parameters[n] for s in scores if n in s.parameters] for n in scores[0].parameters}
    return [
        n
        for n, each in values.items()
        if n not in scores[0].spot
        and all(error > 0 for _, _, error in each)
        and min(v for v, _, _ in each) < 0 < max(v for v, _, _ in each)
    ]


SIGNED = [s.name for s in ALL if s.name not in SEARCHED]


@pytest.mark.parametrize("name", SIGNED)
def test_the_error_of_a_signed_value_is_its_spread_without_an_effect(name):
    scores = null_scores(name)
    for parameter in signed(scores):
        values, _, errors = zip(*(s.parameters[parameter] for s in scores), strict=True)
        assert off_by(values, errors) > UNLIKELY, parameter


UNTOLD = {
    "moving, reference_shift, reference_blur, warm, lag_in_time, row_turns_temporal": "norms, of recordings",
    "other_response": "zero without such pixels",
    "clocking, hits, corrected, lattice, taps": "zero without an effect, which recordings alone show",
    "telegraph_beside": "of the few pixels that seem to jump",
    "tap_gains": "zero without steps",
    "kurtosis, light_tails, pixel_spread, taps_redrawn": "told of one side alone: zero on the other",
    "row_spread, column_spread": "zero on the side where lines differ by less than chance",
    "tail_column, tail_row": "of the length that fits best; held against that of planted ones by themselves",
    "wave_redrawn_2, wave_redrawn_3": "the score of the first wave",
    "saturation, signal_step, iso_step, code_spacing, pile_up, variance_curve": "of levels and codes",
}
"""Signatures whose error is held against no spread here, and what their values are without an effect."""


def test_every_error_is_held_against_a_spread_or_named():
    told = {*OWN, *(s.name for s in SHARED), *(n for n in SIGNED if signed(null_scores(n)))}
    stated = {s.name for s in ALL if any(score.error > 0 for score in null_scores(s.name))}
    left_out = {name for together in UNTOLD for name in together.split(", ")}
    assert stated - told == left_out


def same(one: Score | None, other: Score | None, near: float = 1e-4) -> bool:
    """Whether both say the same."""
    if one is None or other is None:
        return one is other
    return one.log_p == pytest.approx(other.log_p, rel=near, abs=near) and one.amplitude == pytest.approx(
        other.amplitude, rel=10 * near, abs=10 * near * one.shift
    )


@cache
def reversed_recordings():
    recordings = capture(0)
    return prepared(CaptureSet(recordings.camera, recordings.recordings[::-1]))


@cache
def moved_recordings():
    return prepared(capture(0, BLACK + 32))


@cache
def transposed_recordings():
    return prepared(turned_recordings(capture(0)))


def small(name: str) -> Many | None:
    """Fields that a signature sees something in, None: it needs recordings."""
    where = seen_in(name)
    return None if where == "recorded" else shown(name)[1]


def looked(split, name: str) -> Score | None:
    return of(split, name).score(split.fields)


@pytest.mark.parametrize("name", SIGNATURES)
def test_the_order_of_recordings_does_not_matter(name):
    fields = small(name)
    if fields is None:
        one, other = looked(recorded(0), name), looked(reversed_recordings(), name)
    else:
        one, other = (SIGNATURES[name].score(f) for f in (fields, fields[::-1]))
    assert one is not None and same(one, other)


@pytest.mark.parametrize("name", SIGNATURES)
def test_an_offset_of_all_codes_does_not_matter(name):
    fields = small(name)
    if fields is None or name in ("black_level", "black_channels"):  # these hold the stated level against it
        one, other = looked(recorded(0), name), looked(moved_recordings(), name)
    else:
        moved = tuple(f._replace(mean=f.mean + np.float32(32), black=f.black + 32) for f in fields)
        one, other = (SIGNATURES[name].score(f) for f in (fields, moved))
    assert one is not None and same(one, other, 1e-3)


ONE_WAY = (
    "column_turns_additive",
    "column_turns_relative",
    "flicker",
    "row_slope",
    "row_light",
    "row_turns_temporal",
    "smear",
    "raster_slope",
    "taps_redrawn",
)
"""Signatures of the order in which a sensor is read, which have no counterpart along the other axis: rows are
read one after another, and regions lie side by side more than above each other."""


def counterpart(name: str) -> str:
    """The signature of columns for one of rows, the other way round, or the same."""
    swap = {"row": "column", "column": "row"}
    other = "_".join(swap.get(word, word) for word in name.split("_"))
    return other if other in SIGNATURES else name


@pytest.mark.parametrize("name", SIGNATURES)
def test_transposed_rows_are_columns(name):
    fields, other = small(name), counterpart(name)
    if fields is None:
        one, two = looked(recorded(0), name), looked(transposed_recordings(), other)
    else:
        one, two = SIGNATURES[name].score(fields), SIGNATURES[other].score(turned(fields))
    assert one is not None
    if name.startswith("greens"):  # whose levels are compared at the sites of one of them
        assert two is not None and abs(two.amplitude - one.amplitude) < one.error
    else:
        assert same(one, two) == (name not in ONE_WAY)
