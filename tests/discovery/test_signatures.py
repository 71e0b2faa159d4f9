"""A harness over all signatures: what is read and taken out, and whether everything that a report, a card and
a camera model ask is there. Their laws stand in `test_signature_laws`."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report.card import card, lines
from cannoise_jax.discovery.report.document import plain
from cannoise_jax.discovery.report.wording import sentence
from cannoise_jax.discovery.search.model import with_addition
from cannoise_jax.discovery.search.name import UNKNOWN, Named
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.signatures.fields import Fields, refit
from cannoise_jax.signatures.handed import Found, Predicted
from cannoise_jax.signatures.signature import FILES, NO_LAW, NO_PATTERN, Signature, unchanged
from tests.discovery.drawn import drawn, seen_in, shown
from tests.discovery.looks import SIGNATURES
from tests.discovery.planted import OWN, SHARED, by_own_law, planted

FIXED = frozenset({"name", "kind", "frames", "number", "group", "exposure_s", "step", "gain", "black"}) | {
    "clean",
    "before",
    "unit",
}
"""What nothing that is taken out of a field can change."""
ALL = list(SIGNATURES.values())
OF_FIELDS = [s for s in ALL if s.reads != FILES]
OF_FILES = [s for s in ALL if s.reads == FILES]


def names(signatures):
    return [s.name for s in signatures]


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_it_reads_no_more_than_it_says(signature):
    """A cached score is used again while nothing that it reads has changed."""
    signature, fields = shown(signature.name)
    rng = np.random.default_rng(1)
    other = {
        "contrasts": lambda x: x[:, ::-1] * 1.5,
        "static": lambda x: x[::-1] * 1.5,
        "usable": lambda x: x & (rng.random(x.shape) < 0.8),
        "louder": lambda x: np.full((1, 1), 1.3, np.float32),
        "answers": lambda x: x._replace(mixed={"pixel": np.zeros((3, 3, 1, 1), np.float32)}),
    }
    changed = tuple(
        f._replace(
            **{
                part: other.get(part, lambda x: x * np.float32(1.3))(getattr(f, part))
                for part in set(Fields._fields) - FIXED - signature.reads
            }
        )
        for f in fields
    )
    one, again = signature.score(fields), signature.score(changed)
    for part in ("log_p", "gain", "penalty", "amplitude", "error", "shift", "parameters"):
        assert getattr(one, part) == getattr(again, part), part


def test_what_would_be_wrong_silently_must_be_said():
    (rows,) = (s for s in ALL if s.control)
    said = {f.name: getattr(rows, f.name) for f in dataclasses.fields(rows)}
    for name in (
        "reads",
        "absorb",
        "covers",
        "predict",
        "pattern",
        "simulate",
        "place",
        "detectable",
        "least",
    ):
        with pytest.raises(TypeError, match=name):
            Signature(**{other: value for other, value in said.items() if other != name})
    with pytest.raises(ValueError, match="row_additive_temporal: .* say in `quoted` how strong"):
        dataclasses.replace(rows, reads_as=("row_noise", "banding"))


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_a_score_of_nothing_can_be_used_as_any_other(signature):
    """A search that is repeated absorbs what it finds then, which may be nothing."""
    signature, fields = shown(signature.name)
    score = signature.score(fields)
    assert len(signature.absorb(fields, score)) == len(fields)
    signature.predict(fields, score)
    with np.errstate(all="raise", under="ignore"):
        found = found_by(signature, fields, score, signature.mechanism or UNKNOWN)
        for added in (signature.simulate(found), signature.place(found)):
            held = (*added.values.values(), *added.maps.values()) if added is not None else ()
            assert all(np.isfinite(np.asarray(v)).all() for v in held)


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_whether_a_finding_is_in_a_camera_model_is_told_without_its_map(signature):
    signature, fields = shown(signature.name)
    score = signature.score(fields)
    found = found_by(signature, fields, score, signature.mechanism or UNKNOWN)
    even = found._replace(pattern=np.ones(found.size))
    with np.errstate(all="raise", under="ignore"):
        for way in (signature.simulate, signature.place):
            assert (way(even) is None) == (way(found) is None)


@pytest.mark.parametrize("signature", SHARED, ids=names(SHARED))
def test_what_is_planted_is_found_with_its_strength_and_taken_out(signature):
    fields, amplitude = planted(signature, 100.0)
    score = signature.score(fields)
    assert score.log_p < -15
    assert abs(score.amplitude - amplitude) < 5 * score.error + 0.15 * amplitude
    left = signature.score(refit(signature.absorb(fields, score), fields))
    assert left is None or left.log_p > np.log(1e-3)
    law = signature.predict(fields, score)
    if signature.predict is NO_LAW:
        return
    assert isinstance(law, Predicted)
    shared = max(law.row, law.column, law.frame)
    if law.pattern is None:
        assert shared == score.amplitude
    else:
        unit = max(f.exposure_s for f in fields) if signature.axes.scales == "exposure" else 1.0
        power = np.mean(np.square(law.pattern) + law.doubt)
        assert math.sqrt(power) * unit == pytest.approx(score.amplitude, rel=0.35)


@pytest.mark.parametrize("name", OWN)
def test_what_a_law_of_its_own_leaves_is_found_and_taken_out(name):
    signature, fields = SIGNATURES[name], by_own_law(name)
    score = signature.score(fields)
    assert score.log_p < -15
    left = signature.score(refit(signature.absorb(fields, score), fields))
    assert left is None or left.log_p > np.log(1e-3)


UNPLANTED = {
    "reference_shift, reference_blur, row_light": "discovery/test_reference.py",
    "reference_spread": "discovery/test_mde.py",
    "shading": "discovery/test_mde.py",
    "moving, clocking, warm, hits, lag_in_time, lattice, corrected": "discovery/test_beyond.py",
    "taps, taps_redrawn, tap_gains": "discovery/test_taps.py",
    "row_turns_temporal": "discovery/test_parity.py",
    "wave_redrawn_2, wave_redrawn_3": "signatures/test_waves.py",
    "tail_column, tail_row": "discovery/test_late_charge.py",
    "row_spread, column_spread": "signatures/test_noisy_lines.py",
    "kept_in_time": "signatures/test_in_time.py",
    "other_response": "signatures/test_other_response.py",
    "telegraph_beside": "signatures/test_jumps_beside.py",
}
"""Signatures that take something out which only recordings show: edges of scenes, a smooth mean, single
electrons, what lies behind single pixels, frames in their order, pixels made of others, layouts of readouts,
noise that lines have, and what comes after another. Each with the tests of it."""


def test_every_signature_that_takes_something_out_is_held_to_it_or_named():
    """Tests speak of a signature by its name or by that of its mechanism."""
    planted, left_out = {*names(SHARED), *OWN}, set()
    for together, file in UNPLANTED.items():
        words = set(re.findall(r"\w+", (Path(__file__).parents[1] / file).read_text()))
        for name in together.split(", "):
            assert words & {name, SIGNATURES[name].mechanism}, f"{file} does not speak of {name}"
            left_out.add(name)
    taken = {s.name for s in ALL if s.absorb is not unchanged}
    assert not planted & left_out and taken == planted | left_out


def found_by(signature: Signature, fields, score, mechanism):
    rng = np.random.default_rng(0)
    return Found(
        mechanism=mechanism,
        score=score,
        fields=fields,
        pattern=signature.pattern(fields, score, rng),
        gain=1.5,
        read_dn=2.0,
        seconds=0.4,
        longest=0.4,
        span=1000.0,
        size=fields[0].mean.shape,
    )


@pytest.mark.parametrize("signature", SHARED, ids=names(SHARED))
def test_the_simulator_gets_the_strength_that_was_found(signature):
    fields, _ = planted(signature, 400.0)
    score = signature.score(fields)
    model = SensorModel.poisson_gaussian(1.5, 2.0, 100.0, 1100.0)
    for mechanism in (signature.mechanism, UNKNOWN):
        if mechanism is None:
            continue
        found = found_by(signature, fields, score, mechanism)
        added = signature.place(found) if mechanism == UNKNOWN else signature.simulate(found)
        assert added is not None
        step = SimpleNamespace(named=SimpleNamespace(mechanism=mechanism, signature=signature))
        grown = with_addition(model, step, added)
        (fitted,) = grown.mechanisms
        value = next(iter(fitted.parameters.values()))
        rms = 1.0
        if signature.pattern is not NO_PATTERN:
            rms = float(np.sqrt(np.mean(np.asarray(fitted.maps["field"]) ** 2)))
        assert float(value) * rms == pytest.approx(score.amplitude, rel=0.35)


@pytest.mark.parametrize("signature", ALL, ids=names(ALL))
def test_words_card_and_limits_are_complete(signature):
    signature, fields = shown(signature.name)
    score = signature.score(fields)
    assert all(isinstance(axis, str) and axis for axis in dataclasses.astuple(signature.axes))
    assert signature.axes.scales != "relative" and signature.axes.scales != "thermal"
    assert math.isfinite(score.log_p) and math.isfinite(score.gain) and math.isfinite(score.amplitude)
    mechanism = signature.mechanism or UNKNOWN
    named = Named(score, signature, UNKNOWN, ((UNKNOWN, 1.0),), False)
    step = Step(named, fields, -20.0)
    others = (
        tuple(ALL) if seen_in(signature.name) == "drawn" else ()
    )  # which look at small fields in less time
    told = card(step, (signature, *others), frozenset(VOCABULARY))
    assert told["axes"]["scales"] == signature.axes.scales
    assert all(text for _, text in lines(plain(told)))
    for outcome, id in (("UNKNOWN_STRUCTURE", UNKNOWN), ("FOUND", mechanism)):
        entry = {
            "mechanism": id,
            "outcome": outcome,
            "amplitude": {"value": 2.0, "unit": VOCABULARY[id].unit, "ci90": [1.9, 2.1]},
            "parameters": {
                n: {"value": v, "unit": u, "ci90": [v - e, v + e]}
                for n, (v, u, e) in {"shortfall": (0.9, "1", 0.1), **score.parameters}.items()
            },
        }
        said = sentence(entry, step, Proof(score, 5.0, 1.0, 9.0, 100), VOCABULARY[id])
        assert "90 %" in said and "nan" not in said
        grows = "exposure" in said
        assert grows or signature.axes.scales != "exposure"
    assert signature.at(score, 2.0 * (score.amplitude or 1.0)) != score
    assert dataclasses.replace(signature, mechanism="x").mechanism == "x"


def test_one_signature_is_of_the_rows_that_the_control_adds():
    (rows,) = (s for s in ALL if s.control)
    _, amplitude = planted(rows, 100.0)
    assert rows in SHARED and rows.predict(drawn(7), rows.score(drawn(7)).replace(amplitude=amplitude)).row


def test_files_are_judged_whatever_is_taken_out():
    assert {s.axes.enters for s in OF_FILES} <= {"converter", "photons", "pixel", "readout"}
    fields = drawn(8)
    for signature in OF_FILES:
        assert signature.absorb(fields, None) is fields
