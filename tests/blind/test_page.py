"""Table, figures and page from a scored trial, complete and empty."""

import io

import matplotlib.image
import pytest

from cannoise_jax.blind import figures
from cannoise_jax.blind.expected import EXPECTED, card_right, place_right
from cannoise_jax.blind.page import page
from cannoise_jax.blind.score import score
from cannoise_jax.blind.table import lines, text
from tests.blind.test_score import entry, finding


@pytest.fixture(scope="module")
def result():
    truth, claims, known = {}, {}, {}
    for n, mechanism in enumerate(("row_noise", "prnu", "heavy_tails") * 4):
        name = f"s{n}"
        multiple = (0.3, 0.6, 1.5, 4.0)[n // 3]
        truth[name] = entry(name, "strong" if multiple == 4 else "curve", (mechanism, multiple))
        found = {**finding(mechanism), "where": {"axis": "row"}, "heldout_gain_nats": 45.0}
        claims[name] = {"findings": [found] if multiple > 1 else [], "seconds": 10.0 + n}
        known[name] = {"mde": 1.1 / multiple, "gain": 50.0, "unweighted_p": 0.2, "unrefitted_p": 0.3}
    truth["n"], claims["n"] = entry("n", "null"), {"findings": [], "battery_p_value": 0.4}
    return score(truth, claims, known)


def test_table_states_values_and_whether_bars_are_met(result):
    rows = {r.what: r for r in lines(result)}
    assert rows["named at 4 x MDE"].met and "3/3" in rows["named at 4 x MDE"].value
    assert rows["held-out gain over the true model's"].value.startswith("0.9 ")
    assert rows["held-out gain over the true model's"].met
    assert rows["unknown: flagged"].met is None
    assert result["mde"]["prnu"]["median"] == pytest.approx(1.1)
    assert result["localisation"]["axis"]["hits"] == 1
    assert 0.5 < result["detection"]["all"]["half_at"] < 1.6
    assert "MISSED" not in text(result).split("seconds")[1]


def test_page_holds_table_and_three_pictures(result):
    made = page(result, "twelve sets & one")
    assert made.count("data:image/png;base64,") == 3 and "twelve sets &amp; one" in made
    for draw in (figures.detection, figures.confusion, figures.gain):
        image = matplotlib.image.imread(io.BytesIO(draw(result)))
        assert min(image.shape[:2]) > 100 and image[..., :3].std() > 0.02


def test_a_trial_without_any_set_makes_a_page_too():
    nothing = score({}, {})
    assert "no sets" in text(nothing) and page(nothing, "none").count("data:image/png") == 3


def test_cards_and_places_are_judged_part_by_part():
    axes = {"varies_over": "row", "time": "redrawn", "scales": "signal"}
    assert all(card_right("row_gain_noise", {"axes": axes}).values())
    assert card_right("row_noise", {"axes": axes}) == {"axis": True, "time": True, "scaling": False}
    assert not any(card_right("prnu", {}).values())
    right = place_right({"axis": "frequency", "period_px": 8.1}, "banding", {"period_px": 8.0})
    assert right == {"axis": True, "period": True}
    assert not place_right({"axis": "row"}, "banding", {"period_px": 8.0})["axis"]
    assert all(e.time and e.scales and e.axes for e in EXPECTED.values())
