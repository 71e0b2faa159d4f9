"""The words of a report: its sentences, its first sentence and its places."""

from __future__ import annotations

import math
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from cannoise_jax.discovery.compare.words import digits, ends
from cannoise_jax.discovery.proof.prove import Proof
from cannoise_jax.discovery.report.page import gain_interval, nearer_with_rest, number, place, sites, verdict
from cannoise_jax.discovery.report.pictures import where_pictures
from cannoise_jax.discovery.report.wording import sentence
from cannoise_jax.discovery.search.name import Doubt
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.signatures.codes import combed
from cannoise_jax.signatures.signature import Axes
from tests.discovery.looks import white

RNG = np.random.default_rng(8)
ROWS = Axes("readout", "row", "redrawn", "additive", "white")


def test_codes_that_are_only_rarer_are_not_said_never_to_occur():
    entry = {
        "mechanism": "missing_codes",
        "outcome": "FOUND",
        "amplitude": {"value": 2.0, "unit": "code steps", "ci90": [2.0, 2.0]},
        "parameters": {"shortfall": {"value": 0.02, "unit": "1", "ci90": [0.01, 0.04]}},
    }
    signature = combed(MagicMock(), name="comb", parameter="period", covers=("comb",), shapes=())
    step = SimpleNamespace(named=SimpleNamespace(signature=signature, doubt=None), late=False)
    said = sentence(entry, step, Proof(None, None, math.nan, math.nan, 0), VOCABULARY["missing_codes"])
    assert "Every 2 codes one is rarer" in said and "holds 0.98" in said and "(90 %: 0.96 to 0.99)" in said
    assert "never" not in said


@pytest.mark.parametrize(
    ("value", "count", "said"),
    [
        (1374.0, 3, "1,370"), (99_900.0, 3, "99,900"), (999.7, 3, "1,000"), (-1374.0, 2, "-1,400"),
        (29_114.0, 4, "29,110"), (4.94e6, 3, "4.94e+06"), (0.00316, 3, "0.00316"),
        (14.25, 3, "14.2"), (0.0, 3, "0"),
    ],
)  # fmt: skip
def test_numbers_have_an_exponent_only_where_they_would_be_long(value, count, said):
    assert digits(value, count) == said
    assert digits(abs(value), count, "+") == f"+{said.removeprefix('-')}"


def test_levels_keep_all_their_digits():
    assert sites([1374.0] * 4) == "1,374" and sites([0.8, 1374.2, 65535.0, 0.8]) == "0.8, 1,374, 65,535, 0.8"
    assert number(9999.7) == "10,000" and ends(29_110.0, 29_114.0) == ("29,110", "29,114")


def finding(mechanism, value, spread, outcome="FOUND", **more):
    ci90 = [value - spread, value + spread]
    amplitude = {"value": value, "unit": VOCABULARY[mechanism].unit, "ci90": ci90}
    return {"mechanism": mechanism, "outcome": outcome, "amplitude": amplitude, **more}


def said_of(entry, proof, axes=ROWS, doubt=None):
    signature = SimpleNamespace(axes=axes, says=None, kind=None, frozen=axes.time == "frozen")
    named = SimpleNamespace(signature=signature, doubt=doubt)
    darks = (SimpleNamespace(exposure_s=0.01, lit=False), SimpleNamespace(exposure_s=60.0, lit=False))
    step = SimpleNamespace(named=named, late=False, before=darks)
    return sentence(entry, step, proof, VOCABULARY[entry["mechanism"]])


def test_the_interval_of_what_lost_its_name_follows_its_strength():
    entry = finding("unknown", 0.012, 0.0001, "UNKNOWN_STRUCTURE")
    entry["amplitude"]["unit"] = "1"
    doubt = Doubt(0.84, ("hot pixels (fixed)",), "green_imbalance")
    said = said_of(entry, Proof(None, 27_848.0, 2.7e4, 2.8e4, 10**6), doubt=doubt)
    assert "strength 0.012 (90 %: 0.0119 to 0.0121); nearest to green imbalance, but a simulator" in said
    assert "hot pixels (fixed); on frames not used to find it the fit gains 27,800 nats." in said


def test_an_interval_of_a_gain_has_no_more_digits_than_the_gain():
    assert gain_interval([0.06714809, 0.06714842]) == gain_interval([0.25, 0.25]) == ""
    assert gain_interval([0.05806, 0.05941]) == ", 90 %: 0.05806 to 0.05941"
    assert gain_interval([None, None]) == ", too few frames for an interval"


def test_strengths_are_said_with_what_they_measure():
    proof = Proof(None, 66582.7, 6e4, 7e4, 10**6)
    said = said_of(finding("prnu", 0.00316, 0.00011), proof)
    assert said.endswith(
        "rms share of the signal 0.316 % (90 %: 0.305 to 0.327 %); on frames not used to find it the fit "
        "gains 66,600 nats."
    )
    assert "2.01 DN rms (90 %: 1.91 to 2.11 DN)" in said_of(finding("row_noise", 2.01, 0.1), proof)
    tails = said_of(finding("heavy_tails", 0.725, 0.0), proof._replace(gain=8.3e7))
    assert "excess kurtosis of the read noise 0.725; " in tails and "more than 10 nats a pixel." in tails
    assert "4,290 DN rms" in said_of(finding("dsnu", 4293.0, 1.0), proof)


def test_a_structure_without_a_name_is_described_in_words():
    axes = Axes("readout", "pixel", "redrawn", "all noise", "neighbours")
    entry = finding("unknown", 0.05, 0.01, "UNKNOWN_STRUCTURE")
    said = said_of(entry, Proof(None, 9.0, 1.0, 20.0, 99), axes)
    assert said.startswith(
        "A structure without a name, from pixel to pixel, new in every frame, in proportion to all noise "
        "(of the kind: neighbours): strength 0.05 (90 %: 0.04 to 0.06)"
    )


def test_growth_with_the_exposure_is_said_once():
    axes, proof = Axes("pixel", "pixel", "frozen", "exposure", "sparse"), Proof(None, 9.0, 1.0, 20.0, 99)
    assert "(growing with the exposure): 2 DN rms at 60 s" in said_of(
        finding("hot_pixels", 2.0, 0.1), proof, axes
    )
    assert "(growing" not in said_of(finding("hot_pixels", 2.0, 0.1), proof)
    said = said_of(finding("dark_current", 2.0, 0.1), proof, axes)
    assert said.count("exposure") == 1 and "(growing" not in said


def test_names_that_cannot_be_told_apart_are_listed():
    candidates = [{"mechanism": m, "probability": 0.3} for m in ("row_noise", "banding", "unknown", "rts")]
    entry = finding("row_noise", 1.0, 0.1, "AMBIGUOUS", candidates=candidates)
    said = said_of(entry, Proof(None, None, math.nan, math.nan, 0))
    assert said.startswith(
        "These recordings cannot tell row noise, banding and rts apart; as row noise: 1 DN"
    )


@pytest.mark.parametrize("probability", [0.6, 0.002])
def test_one_name_is_not_told_apart_from_itself(probability):
    candidates = [
        {"mechanism": "row_noise", "probability": probability},
        {"mechanism": "unknown", "probability": 0.998 - probability},
        {"mechanism": "banding", "probability": 0.002},
    ]
    entry = finding("row_noise", 1.0, 0.1, "AMBIGUOUS", candidates=candidates)
    said = said_of(entry, Proof(None, None, math.nan, math.nan, 0))
    assert said.startswith("Nothing known fits better than row noise: 1 DN")


def test_page_counts_names_and_tells_what_is_not_confirmed():
    def found(mechanism, sure):
        return {"mechanism": mechanism, "confirmed": sure}

    report = {
        "verdict": "partly explained",
        "findings": [found("dsnu", True), found("dsnu", True), found("prnu", True), found("unknown", False)],
    }
    assert verdict(report) == (
        "Partly explained: DSNU (2 times) and PRNU. "
        "Found, but not confirmed on frames held back: a structure without a name."
    )
    report = {"verdict": "explained", "findings": [found("banding", False)]}
    assert verdict(report) == "Explained: banding, not confirmed on frames held back."


def test_the_first_sentence_says_what_differs_most_and_which_way():
    line = {"what": "rows", "simulator_has": "too much", "recorded": 0.1, "simulated": 1.0, "unit": "DN rms"}
    report = {"verdict": "differs, no cause found", "findings": [], "remains": {"after": [line], "left": 0.3}}
    assert verdict(report) == (
        "Differs, and no cause was found. What still differs most: rows, of which the simulator has too much "
        "(0.1 DN rms recorded, 1 DN rms simulated)."
    )


def test_what_is_next_to_nothing_is_not_said_to_differ_most():
    line = {"what": "rows", "simulator_has": "too much", "recorded": 0.1, "simulated": 1.0, "unit": "DN rms"}
    report = {
        "verdict": "differs, no cause found",
        "findings": [],
        "remains": {"after": [line], "left": 5e-7},
    }
    assert verdict(report) == "Differs, and no cause was found."
    report["after"] = {"two_sample_auc": 0.544, "two_sample_auc_ci90": [0.53, 0.56]}
    assert verdict(report).endswith("but a small network still sees it: an area of 0.544.")


def test_a_remainder_that_comes_nearer_and_is_left_out_is_told_from_one_that_does_not_help():
    tried = {"what": "remainder", "entered": False, "area_distance_change": {"ci90": [-0.13, -0.09]}}
    helps = tried | {"score_nats_per_pixel": {"ci90": [1e-4, 3e-4]}}
    costs = tried | {"score_nats_per_pixel": {"ci90": [-3e-4, -1e-4]}}
    for one, nearer in ((helps, True), (costs, False), (helps | {"entered": True}, False)):
        assert nearer_with_rest({"gate": {"tried": [one], "remainder": one["entered"]}}) is nearer


def test_a_map_with_pixels_far_out_says_how_wide_it_is_with_them():
    entry = finding("dsnu", 39.9, 0.1)
    entry["parameters"] = {"sigma_of_all": {"value": 73.02, "unit": "DN", "ci90": [70.0, 75.0]}}
    said = said_of(entry, Proof(None, 9.0, 1.0, 20.0, 99))
    assert "73 DN rms with the pixels that are far out of it" in said


def test_places_are_short_and_a_slope_is_at_no_one_frequency():
    assert place({"axis": "pixel", "lags": [[0, 1], [0, 2]], "correlations": [-0.0170197601, 0.018]}) == (
        "pixel by pixel (lags: (0, 1), (0, 2); correlations: -0.01702, 0.018)"
    )
    assert place({"axis": "frequency", "period_px": None, "direction": "row"}).startswith("by spatial")
    assert place({"axis": "frequency", "period_px": 18.45, "direction": "row"}).startswith("at one spatial")
    assert place({"axis": "row", "index": list(range(9))}).endswith("6, 7, …)")


def test_places_among_signals_are_said_in_words():
    at = {"axis": "signal", "range": [3000.69, 3000.69], "sign": 1.0}
    assert place(at) == (
        "over the range of signals (most at a signal of 3,000 DN; more noise there than a straight line has)"
    )
    for whole in ([0.0, 1.0], [0.0, 0.0], None):
        assert place({"axis": "signal", "range": whole}) == "over the range of signals"
    assert place({"axis": "signal", "range": [0.0, 0.62]}).endswith("(up to 62 % of the range)")
    assert place({"axis": "signal", "range": [40.0, 912.0]}).endswith("(signals of 40 to 912 DN)")


def test_the_ends_of_an_interval_do_not_print_alike():
    assert number([0.0021291, 0.0021294]) == "0.0021291 to 0.0021294" and number([1.0, 2.0]) == "1 to 2"
    proof = Proof(None, 66582.7, 6e4, 7e4, 10**6)
    assert "(90 %: 2.0096 to 2.0104 DN)" in said_of(finding("row_noise", 2.01, 0.0004), proof)
    assert "90 %" not in said_of(finding("row_noise", 2.01, 1e-15), proof)


def test_a_finding_that_takes_nothing_out_is_shown_where_it_acts():
    fields = white(RNG)
    for of_light, what in ((True, "lit"), (False, "darks")):
        pictures = where_pictures(fields, fields, "channel", False, of_light)
        assert pictures[0].alt == f"what stays ({what})"
    # What is in the means of frames of several exposures, and what moves them.
    assert where_pictures(fields, fields, "frame", False)[1].alt.startswith("level of the darks above")
    assert where_pictures(fields, fields, "frame", True)[1].alt.startswith("offsets between whole frames")
