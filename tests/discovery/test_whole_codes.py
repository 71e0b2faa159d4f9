"""A comb of codes is of the whole frame, or of a few lines alone, which no histogram tells."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.compare.families import CODES, STATIC, STRUCTURE, of
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.proof.own_part import Borne
from cannoise_jax.discovery.proof.whole_codes import codes_to_converters, in_few_lines
from cannoise_jax.discovery.search.name import Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import SIZE, capture_set

FEW = np.random.default_rng(4).random((1, SIZE[1])) < 0.1


def favoured(where):
    """Half of the values that lie beside every eighth code become that code."""

    def alter(rng):
        def change(dn, signal, kind, t):
            near = np.round(dn / 8) * 8
            moved = where & (np.abs(dn - near) < 1.5) & (rng.random(dn.shape) < 0.5)
            return np.where(moved, near, dn)

        return change

    return alter


def coarse(where):
    """Pixels that have every eighth code alone."""
    return lambda rng: lambda dn, signal, kind, t: np.where(where, np.round(dn / 8) * 8, dn)


@pytest.mark.parametrize(
    ("alter", "few"),
    [
        (favoured(True), None),
        (favoured(np.linspace(-1, 1, SIZE[1]) > -0.5), None),
        (coarse(FEW), "columns"),
        (favoured(FEW), "columns"),
        (coarse(np.random.default_rng(5).random((SIZE[0], 1)) < 0.1), "rows"),
    ],
    ids=["everywhere", "three quarters", "coarse columns", "some columns", "coarse rows"],
)
def test_a_comb_of_few_lines_is_told_from_one_of_the_frame(alter, few):
    capture = capture_set(5, alter, kinds="df", frames=6)
    splits = split_recordings(capture)
    prepared = prepare(capture, all_frames(splits), False)
    signature = next(s for s in prepared.signatures if s.name == "comb")
    score = signature.score(prepared.fields)
    assert score is not None and score.log_p < -20 and score.where["period"] == 8
    name = "missing_codes"
    step = Step(Named(score, signature, name, ((name, 1.0),), False), prepared.fields, score.log_p)
    found = in_few_lines(step, capture, all_frames(splits))
    assert (found is None) == (few is None)
    if found is not None:
        assert few in found.against[0] and found.left > 0.9


def test_how_codes_are_filled_speaks_of_converters_alone_where_one_moves_it():
    """A step between amplifiers moves every level by part of a code, and with it which codes are filled."""

    codes = of("", CODES)

    def borne(change, family=codes):
        before = np.array([change, 0.0])
        judged = SimpleNamespace(family=family, where="flat", z=np.zeros(2), passing=4.0)
        return Borne(judged, before, np.zeros(2), np.array([True, False]), np.zeros(2, bool), np.ones(2))

    each = {0: [borne(900.0)], 1: [borne(60.0), borne(40.0, of(STATIC, STRUCTURE))]}
    told = codes_to_converters(each, {0})
    assert told[0][0].own.any() and not told[1][0].own.any() and told[1][1].own.any()
    assert codes_to_converters(each, set())[1][0].own.any()
    assert codes_to_converters({0: [borne(20.0)], 1: [borne(60.0)]}, {0})[1][0].own.any()
