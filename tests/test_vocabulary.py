"""The vocabulary is complete and consistent; the module that says what a name holds imports nothing."""

import ast
from itertools import pairwise
from pathlib import Path

import pytest

from cannoise_jax import vocabulary
from cannoise_jax.mechanisms import ENTRIES, VOCABULARY, contains
from cannoise_jax.vocabulary import CLASSES, Term


def test_the_list_goes_class_by_class_the_measured_ones_first():
    terms = list(VOCABULARY.values())
    assert [t.id for t in terms][-1] == "unknown" and len({t.listed for t in terms}) == len(terms)
    for one, next in pairwise(terms):
        assert CLASSES.index(one.kind) <= CLASSES.index(next.kind)
    sensor = [e for e in sorted(ENTRIES, key=lambda e: e.term.listed) if e.term.kind == "sensor"]
    measured = [e.estimator is not None for e in sensor]
    assert measured == sorted(measured, reverse=True) and 0 < sum(measured) < len(measured)


@pytest.mark.parametrize("term", VOCABULARY.values(), ids=lambda t: t.id)
def test_entry_is_well_formed(term: Term):
    assert term.id.islower() and term.definition.endswith(".") and "\n" not in term.definition
    assert term.amplitude and term.unit
    assert term.entry is None or 1 <= term.entry <= 50
    for outer in term.within:
        assert outer in VOCABULARY and not contains(term.id, outer), "containment must be without cycles"


def test_amplitude_units_follow_the_scaling():
    for additive in ("row_noise", "column_noise", "dsnu", "row_fpn", "pink_noise", "offset_drift", "rts"):
        assert VOCABULARY[additive].unit == "DN" and "rms" in VOCABULARY[additive].amplitude
    for sinusoid in ("banding", "flicker"):
        assert "peak" in VOCABULARY[sinusoid].amplitude
    for multiplicative in ("prnu", "column_gain", "illumination_drift"):
        assert VOCABULARY[multiplicative].unit == "1" and "rms" in VOCABULARY[multiplicative].amplitude


def test_contains():
    assert contains("row_pink_noise", "row_noise") and not contains("row_noise", "row_pink_noise")
    assert contains("prnu", "column_gain") and contains("dsnu", "dsnu")
    assert not contains("heavy_tails", "rts")


def test_imports_nothing_of_the_package():
    tree = ast.parse(Path(vocabulary.__file__).read_text())
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert names <= {"__future__", "dataclasses", "typing"}
