"""bin/bench speed: what is refused, what is compared, and the table that comes of it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from cannoise_jax.bench import side_by_side
from cannoise_jax.bench.items import ITEMS, batch_of, config_of
from cannoise_jax.commands import bench, bench_speed
from cannoise_jax.commands.bench_take import take
from tests.conftest import ROOT


class Pretended:
    """A process that takes 2 s a call, one of another engine 3 s, with 4 s and 9 s of work."""

    made: list[str] = []

    def __init__(self, engine, item, place, environment, cores=None):
        self.engine, self.started = engine, {"init": 1.0, "first": 2.0, "start_mib": 9.0}

    def call(self):
        self.made.append(self.engine)
        ours = self.engine == "ours"
        return {"s": 2.0 if ours else 3.0, "cpu_s": 4.0 if ours else 9.0, "mib": 100.0}

    def end(self):
        pass


def test_pairs_change_their_order_and_ratios_are_of_pairs(monkeypatch):
    monkeypatch.setattr(side_by_side, "Worker", Pretended)
    monkeypatch.setattr(Pretended, "made", [])
    found = side_by_side.measure(ITEMS["sample_one"], 2, True)
    assert Pretended.made == ["ours", "torch", "torch", "ours"]
    assert found.ratio.median == 1.5 and found.cpu.median == 9 / 4


def test_what_was_measured_becomes_a_table(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(side_by_side, "Worker", Pretended)
    out = tmp_path / "speed.json"
    assert bench.main(["speed", "--only", "sample_one", "--pairs", "3", "--out", str(out)]) == 0
    assert "start_mib" in capsys.readouterr().err
    taken = take(ROOT, out, "speed", None, ["bin/bench speed"])
    assert taken.columns == bench_speed.COLUMNS and taken.rows[0][:3] == (
        ITEMS["sample_one"].title,
        "2000",
        "",
    )
    assert json.loads(out.read_text())["values"]["sample_one_ms"] == "2000"


def test_bad_options_end_with_one_line(capsys, monkeypatch):
    assert bench.main(["speed", "--only", "nothing"]) == 2
    assert bench.main(["speed", "--pairs", "0"]) == 2
    monkeypatch.setattr(bench_speed, "find_spec", lambda name: None)
    assert bench.main(["speed", "--against", "torch"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and all(line.startswith("bin/bench: speed") for line in lines)
    assert "cannoise-jax[torch]" in lines[2]


@pytest.mark.parametrize("name", [n for n, item in ITEMS.items() if item.kind == "step"])
def test_batches_are_of_the_config(name):
    item = ITEMS[name]
    config, data = config_of(item), batch_of(item)
    assert data["clean"].shape == (config.batch_size, config.patch, config.patch, 4)
    assert data["anchor"].shape[-3] == config.reference and data["clean"].dtype == np.float32
