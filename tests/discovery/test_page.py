"""The words of a report: its sentences, its first sentence and its places."""

from __future__ import annotations

import math
from types import SimpleNamespace
from unittest.mock import MagicMock

from cannoise_jax.discovery.page import place, verdict
from cannoise_jax.discovery.prove import Proof
from cannoise_jax.discovery.wording import sentence
from cannoise_jax.signatures.codes import combed


def test_codes_that_are_only_rarer_are_not_said_never_to_occur():
    entry = {
        "mechanism": "missing_codes",
        "outcome": "FOUND",
        "amplitude": {"value": 2.0, "unit": "code steps", "ci90": [2.0, 2.0]},
        "parameters": {"shortfall": {"value": 0.02, "unit": "1", "ci90": [0.01, 0.04]}},
    }
    signature = combed(MagicMock(), name="comb", parameter="period", covers=("comb",), shapes=())
    step = SimpleNamespace(named=SimpleNamespace(signature=signature), late=False)
    said = sentence(entry, step, Proof(None, None, math.nan, math.nan, 0), "Some codes never occur.")
    assert "Every 2 codes one is rarer" in said and "holds 0.98" in said and "(90 %: 0.96 to 0.99)" in said
    assert "never" not in said


def test_page_counts_names_and_tells_what_is_not_confirmed():
    def found(mechanism, sure):
        return {"mechanism": mechanism, "confirmed": sure}

    report = {
        "verdict": "partly explained",
        "findings": [found("dsnu", True), found("dsnu", True), found("prnu", True), found("unknown", False)],
    }
    assert verdict(report) == (
        "Partly explained: dsnu (2 times) and prnu. "
        "Found, but not confirmed on frames held back: a structure without a name."
    )
    report = {"verdict": "explained", "findings": [found("banding", False)]}
    assert verdict(report) == "Explained: banding, not confirmed on frames held back."


def test_the_first_sentence_says_what_differs_most_and_which_way():
    line = {"what": "rows", "simulator_has": "too much", "recorded": 0.1, "simulated": 1.0, "unit": "DN rms"}
    report = {"verdict": "differs, no cause found", "findings": [], "remains": {"after": [line]}}
    assert verdict(report) == (
        "Differs, and no cause was found. What still differs most: rows, of which the simulator has too much "
        "(0.1 DN rms recorded, 1 DN rms simulated)."
    )


def test_places_are_short_and_a_slope_is_at_no_one_frequency():
    assert place({"axis": "pixel", "lags": [[0, 1], [0, 2]], "correlations": [-0.0170197601, 0.018]}) == (
        "pixel by pixel (lags: (0, 1), (0, 2); correlations: -0.01702, 0.018)"
    )
    assert place({"axis": "frequency", "period_px": None, "direction": "row"}).startswith("by spatial")
    assert place({"axis": "frequency", "period_px": 18.45, "direction": "row"}).startswith("at one spatial")
    assert place({"axis": "row", "index": list(range(9))}).endswith("6, 7, …)")
