"""The card of an unnamed structure says what was put in."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import prepare_split, split_recordings
from cannoise_jax.discovery.report.card import card, lines
from cannoise_jax.discovery.search.declare import registered
from cannoise_jax.discovery.search.name import Doubt, Named
from cannoise_jax.discovery.search.steps import Step
from tests.discovery.capture import capture_set, column_pattern, row_offsets

HIDDEN = ("row_noise", "row_pink_noise", "column_fpn", "column_gain")


def row_gains(sigma):
    """A factor of every row, new in every frame."""

    def alter(rng):
        return lambda dn, signal, kind, exposure: dn + signal * sigma * rng.standard_normal((dn.shape[0], 1))

    return alter


def told(alter, name, seed):
    capture = capture_set(seed, alter)
    prepared = prepare_split(capture, split_recordings(capture))
    signature = next(p for p in prepared.signatures if p.name == name)
    named = Named(signature.score(prepared.fields), signature, "unknown", (("unknown", 1.0),), False)
    ids = frozenset(e.id for e in registered(HIDDEN))
    return card(Step(named, prepared.fields, -20.0), prepared.signatures, ids), ids


@pytest.mark.parametrize(
    "alter, name, scales, power, share",
    [
        pytest.param(
            row_offsets(2.0), "row_additive_temporal", "additive", 0.0, (0.0, 0.1), marks=pytest.mark.slow
        ),
        (row_gains(0.01), "row_relative_temporal", "signal", 1.0, (0.0, 0.1)),
        (column_pattern(2.0), "column_additive_static", "additive", 0.0, (0.9, 1.0)),
    ],
)
def test_card_tells_scaling_time_and_spectrum(alter, name, scales, power, share):
    entry, ids = told(alter, name, 61)
    assert entry["axes"]["scales"] == scales
    assert entry["dependence"]["signal"]["power"] == power
    assert share[0] <= entry["static_share"] <= share[1]
    assert abs(entry["row_spectrum"]["exponent"]) < 0.3  # white from row to row
    assert entry["excess_kurtosis"]["value"] == pytest.approx(0, abs=0.2)
    near = [c["correlation"] for c in entry["covariance"]]
    assert np.max(np.abs(near)) < 0.03
    # A mechanism that may not be named is not the nearest either.
    assert entry["nearest"] is None or entry["nearest"] in ids
    json.dumps(entry, allow_nan=False)


def test_card_in_words_has_a_line_for_everything_known():
    entry, _ = told(row_gains(0.01), "row_relative_temporal", 62)
    text = dict(lines(entry))
    assert "scales: signal" in text["Place in the grammar"]
    assert "power 1" in text["By signal"] and "±" in text["By signal"]
    assert "Nearest named mechanism" in text and "Means of rows" in text


def test_a_card_says_which_name_was_withdrawn_and_why():
    capture = capture_set(61, row_offsets(2.0), kinds="d")
    prepared = prepare_split(capture, split_recordings(capture))
    signature = next(p for p in prepared.signatures if p.name == "row_additive_temporal")
    named = Named(signature.score(prepared.fields), signature, "row_noise", (("row_noise", 1.0),), False)
    step = Step(named.withdrawn(Doubt(0.43, ("parts of rows (frame to frame)",))), prepared.fields, -20.0)
    entry = card(step, prepared.signatures, frozenset({"row_noise", "banding"}))
    assert entry["nearest"] == "row_noise"
    assert "43 %" in entry["why_rejected"] and "parts of rows" in entry["why_rejected"]
