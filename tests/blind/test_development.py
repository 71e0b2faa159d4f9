"""Fixed development sets against recorded figures, which `bin/blind develop --figures FILE` records anew."""

import json
from pathlib import Path

import pytest

from cannoise_jax.trials import develop as development
from cannoise_jax.trials.develop import HIGHER_IS_BETTER, develop, worse

pytest.importorskip("getframes", reason="getframes is not installed: pip install 'cannoise-jax[blind]'")
RECORDED = json.loads((Path(__file__).parent / "recorded.json").read_text())


def test_figures_are_compared_in_their_own_direction():
    good = dict.fromkeys(HIGHER_IS_BETTER, 5)
    assert not worse(good, good)
    assert worse({**good, "named": 4}, good) == ["named: 4, recorded 5"]
    assert worse({**good, "errors": 6}, good) == ["errors: 6, recorded 5"]
    assert not worse({**good, "named": 6, "errors": 4}, good)


def test_the_claims_of_a_search_that_finds_nothing_are_counted_and_fall_behind(tmp_path, monkeypatch):
    monkeypatch.setitem(development.SETS, "fast", (2001, 3, 1))
    for search in ("diagnosed", "located"):
        monkeypatch.setattr(development, search, lambda *asked, **more: {"findings": []})
    found = develop("fast", tmp_path, lambda done, total: None)
    assert found == dict.fromkeys(HIGHER_IS_BETTER, 0)
    behind = ("named", "seen", "both_of_two", "unknown_flagged")
    assert worse(found, RECORDED["fast"]) == [f"{n}: 0, recorded {RECORDED['fast'][n]}" for n in behind]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["fast", "slow"])
def test_development_sets_come_out_no_worse_than_recorded(name, tmp_path):
    if name not in RECORDED:
        pytest.skip("no figures yet: bin/blind develop --slow --figures tests/blind/recorded.json")
    found = develop(name, tmp_path, lambda done, total: None)
    assert found["errors"] == 0
    assert not worse(found, RECORDED[name])
