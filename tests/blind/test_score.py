import numpy as np
import pytest

from cannoise_jax.blind.judge import alarm, named, seen, share
from cannoise_jax.blind.score import detection, score


def finding(mechanism, kind="sensor", outcome="FOUND", others=(), value=1.0, interval=(0.9, 1.1)):
    candidates = [{"mechanism": mechanism, "probability": 0.8}]
    candidates += [{"mechanism": m, "probability": 0.2 / len(others)} for m in others]
    return {
        "mechanism": mechanism,
        "class": kind,
        "outcome": outcome,
        "candidates": candidates,
        "amplitude": {"value": value, "ci90": list(interval)},
    }


def entry(name, category, *effects, adversary=None):
    told = [{"mechanism": m, "amplitude": 1.0, "multiple": k, "mde": 1 / k, "where": {}} for m, k in effects]
    return {"set": name, "category": category, "effects": told, "adversary": adversary, "without": []}


def test_share_is_clopper_pearson():
    assert share(0, 300)["ci95"][1] == pytest.approx(1 - 0.025 ** (1 / 300))
    low, high = share(30, 100)["ci95"]
    assert low == pytest.approx(0.2124, abs=1e-4) and high == pytest.approx(0.3998, abs=1e-4)
    assert share(0, 0)["value"] is None


def test_what_counts_as_an_alarm_and_as_a_right_name():
    assert alarm({"findings": [finding("row_noise")]})
    assert alarm({"findings": [finding("unknown", "unknown", "UNKNOWN_STRUCTURE")]})
    assert not alarm({"findings": [finding("illumination_drift", "capture")]})
    assert named(finding("prnu", outcome="AMBIGUOUS", others=("column_gain",)), "column_gain")
    assert not named(finding("prnu", outcome="FOUND", others=("column_gain",)), "column_gain")
    many = finding("prnu", outcome="AMBIGUOUS", others=("a", "b", "c", "d"))
    assert not named(many, "prnu")


def test_detection_recovers_the_half_power_point():
    rng = np.random.default_rng(0)
    rows = []
    for _ in range(400):
        multiple = np.exp(rng.uniform(np.log(0.3), np.log(10)))
        seen = rng.random() < 1 / (1 + (multiple / 1.5) ** -4)
        report = {"findings": [finding("row_noise")] if seen else []}
        rows.append((entry("s", "curve", ("row_noise", multiple)), report))
    assert detection(rows)["half_at"] == pytest.approx(1.5, rel=0.12)


def test_another_family_has_not_seen_the_effect():
    set_ = entry("s", "curve", ("row_noise", 1.0))
    assert seen(set_, {"findings": [finding("column_noise")]})
    assert seen(set_, {"findings": [finding("unknown", outcome="UNKNOWN_STRUCTURE")]})
    assert not seen(set_, {"findings": [finding("heavy_tails"), finding("bookkeeping", "bookkeeping")]})
    assert not seen(set_, {"findings": []})


def test_score_counts_every_category():
    truth = {
        "a": entry("a", "null"),
        "b": entry("b", "strong", ("row_noise", 4.0)),
        "c": entry("c", "strong", ("prnu", 4.0)),
        "d": entry("d", "double", ("row_noise", 4.0), ("prnu", 4.0)),
        "e": entry("e", "unlisted", ("tile_noise", 4.0)),
        "f": entry("f", "adversarial", adversary="nyquist"),
    }
    claims = {
        "a": {"findings": []},
        "b": {"findings": [finding("row_noise", value=1.05)]},
        "c": {"findings": [finding("dsnu"), finding("prnu")]},
        "d": {"findings": [finding("row_noise"), finding("banding")]},
        "e": {"findings": [finding("unknown", "unknown", "UNKNOWN_STRUCTURE")]},
        "f": {"findings": [finding("crosstalk")]},
    }
    result = score(truth, claims)
    assert result["false_alarms"]["hits"] == 0 and result["false_alarms"]["sets"] == 1
    assert result["naming"]["top1"]["hits"] == 1
    assert result["naming"]["finding_outside_group"]["hits"] == 1
    assert result["confusion"] == {"row_noise": {"row_noise": 1}, "prnu": {"dsnu": 1}}
    assert result["double"]["precision"]["value"] == 0.5 and result["double"]["recall"]["value"] == 0.5
    assert result["unknown"]["flagged"]["hits"] == 1 and result["unknown"]["misnamed"]["hits"] == 0
    assert result["adversarial"]["sensor_false_alarms"]["hits"] == 1
    assert result["amplitude"]["coverage90"]["hits"] == 2
