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
    def found(mechanism, low):
        gain = None if low is None else {"value": 1.0, "ci90": [low, 2.0]}
        return {"mechanism": mechanism, "heldout_gain_nats_per_pixel": gain}

    report = {
        "verdict": "mismatch",
        "findings": [found("dsnu", 0.1), found("dsnu", 0.1), found("prnu", 0.2), found("unknown", -0.1)],
    }
    assert verdict(report) == (
        "The recordings differ from the simulator by dsnu (2 times) and prnu. "
        "Found, but not confirmed on new frames: a structure without a name."
    )
    report["findings"] = [found("banding", None)]
    assert (
        verdict(report) == "The recordings differ from the simulator by banding, not confirmed on new frames."
    )


def test_places_are_short_and_a_slope_is_at_no_one_frequency():
    assert place({"axis": "pixel", "lags": [[0, 1], [0, 2]], "correlations": [-0.0170197601, 0.018]}) == (
        "pixel by pixel (lags: (0, 1), (0, 2); correlations: -0.01702, 0.018)"
    )
    assert place({"axis": "frequency", "period_px": None, "direction": "row"}).startswith("by spatial")
    assert place({"axis": "frequency", "period_px": 18.45, "direction": "row"}).startswith("at one spatial")
    assert place({"axis": "row", "index": list(range(9))}).endswith("6, 7, …)")
