"""bin/bench accelerator: refused without one; what it measures becomes a table with its own machine."""

from __future__ import annotations

import json

import jax
import pytest

from cannoise_jax.bench import accelerator
from cannoise_jax.commands import bench, bench_accelerator
from cannoise_jax.commands.bench_take import take
from cannoise_jax.recordings.recording import BadInput
from tests.conftest import ROOT


class Pretended:
    """A process that takes 2 ms a call."""

    alive: list[str] = []

    def __init__(self, engine, item, place, environment):
        self.name = f"{engine} {item.name}"
        self.started = {"first": 1.0} | (
            {"operations": 1e12} if engine == "ours" and item.kind == "step" else {}
        )
        self.alive.append(self.name)

    def call(self, times=1):
        return {"s": 2e-3, "cpu_s": 1.0, "mib": 1024.0}

    def kill(self):
        self.alive.remove(self.name)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="there is one here")
def test_without_an_accelerator_it_says_so(capsys):
    assert bench.main(["accelerator"]) == 2
    assert bench.main(["accelerator", "--only", "nothing"]) == 2
    assert bench.main(["accelerator", "--rounds", "0"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3 and "bin/bench speed" in lines[0] and "step_paper_64" in lines[1]


def test_the_table_has_operations_their_share_and_the_machine(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(accelerator, "Worker", Pretended)
    monkeypatch.setattr(accelerator, "matrix_rate", lambda dtype: {"float32": 1e15, "bfloat16": 2e15}[dtype])
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    monkeypatch.setattr(bench_accelerator, "find_spec", lambda name: True)
    out = tmp_path / "accelerator.json"
    assert bench.main(["accelerator", "--against", "torch", "--out", str(out)]) == 0
    assert not Pretended.alive and "step_paper_64, torch" in capsys.readouterr().err
    taken = take(ROOT, out, "accelerator", None, ["bin/bench accelerator"])
    rows = {(row[0], row[1]): row for row in taken.rows}
    full = rows["training step, paper, full width, batch 64, bfloat16", "ours"]
    assert full[2] == "2.00" and full[4:7] == ("1.00", "500", "0.25")
    peer = rows["training step, paper, full width, batch 64, float32", "PyTorch"]
    assert peer[4:7] == ("", "", "") and "cores" in taken.machine
    assert json.loads(out.read_text())["values"]["step_paper_64_torch_ms"] == "2.00"


def test_few_processes_hold_the_memory_at_a_time(monkeypatch):
    most = []

    class Counted(Pretended):
        def call(self, times=1):
            most.append(len(self.alive))
            return super().call(times)

    monkeypatch.setattr(accelerator, "Worker", Counted)
    accelerator.measure([("ours", name) for name in bench_accelerator.WORK], 1, 1)
    assert max(most) == 3


def test_all_processes_end_where_one_fails(monkeypatch):
    class Failing(Pretended):
        killed: list[str] = []

        def __init__(self, engine, item, place, environment):
            super().__init__(engine, item, place, environment)
            if item.name == "step_default_64":
                del self.started

        def __getattr__(self, name):
            raise BadInput("ended")

        def kill(self):
            self.killed.append(self.name)

    monkeypatch.setattr(accelerator, "Worker", Failing)
    with pytest.raises(BadInput):
        accelerator.measure([("ours", name) for name in bench_accelerator.WORK[:3]], 1, 1)
    assert len(Failing.killed) == 3
