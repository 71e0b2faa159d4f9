"""Two engines at the same work, in turn: each in a process of its own, one call at a time, the order changing
from pair to pair. What is compared are the ratios of pairs, which a busy machine moves less than seconds."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.bench.items import Item
from cannoise_jax.recordings.recording import BadInput


class Spread(NamedTuple):
    """Median and quartiles."""

    median: float
    low: float
    high: float


class Measured(NamedTuple):
    """One item. ours, peer: seconds a call; ratio: peer's over ours in each pair, above one: ours is faster;
    cpu: the same of the seconds that all cores worked, which a busy machine moves least; None without a
    peer. start: what starting cost ours cold, ours from what it compiled before, and the peer:
    init, first (s), start_mib. mib: most memory while working. load: before and after."""

    item: Item
    ours: Spread
    peer: Spread | None
    ratio: Spread | None
    cpu: Spread | None
    start: dict[str, dict[str, float]]
    mib: dict[str, float]
    load: tuple[float, float]


def spread(values: list[float]) -> Spread:
    """Of at least one value."""
    return Spread(*(float(np.quantile(values, q)) for q in (0.5, 0.25, 0.75)))


def measure(
    item: Item,
    pairs: int,
    against: bool,
    cores: int | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> Measured:
    """Times an item in `pairs` pairs of calls after a warm-up, on some of the cores or all."""
    before = load()
    with tempfile.TemporaryDirectory(prefix="cannoise-bench-") as folder:
        place = Path(folder) / "weights.npz"
        kept = {
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/compiled",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        start = {}
        for name in ("cold", "cached"):
            worker = Worker("ours", item, place, kept, cores)
            start[name] = worker.started
            say(f"{item.name}, ours {name}: {_short(worker.started)}")
            if name == "cold":
                worker.end()
        workers = {"ours": worker}
        if against:
            workers["torch"] = Worker("torch", item, place, {}, cores)
            start["torch"] = workers["torch"].started
            say(f"{item.name}, torch: {_short(start['torch'])}")
        calls: dict[str, list[dict[str, float]]] = {name: [] for name in workers}
        for pair in range(pairs):
            for name in sorted(workers, reverse=bool(pair % 2)):
                calls[name].append(workers[name].call())
        for worker in workers.values():
            worker.end()
    mib = {name: found[-1]["mib"] for name, found in calls.items()}
    times = {name: spread([c["s"] for c in found]) for name, found in calls.items()}
    ratio, cpu = (_ratios(calls, unit) if against else None for unit in ("s", "cpu_s"))
    return Measured(item, times["ours"], times.get("torch"), ratio, cpu, start, mib, (before, load()))


def _ratios(calls: dict[str, list[dict[str, float]]], unit: str) -> Spread:
    return spread([b[unit] / a[unit] for a, b in zip(calls["ours"], calls["torch"], strict=True)])


class Worker:
    """A process that holds one engine ready. Raises BadInput where it cannot."""

    def __init__(
        self, engine: str, item: Item, place: Path, environment: dict[str, str], cores: int | None = None
    ):
        self.engine = engine
        environment = environment | ({"CANNOISE_BENCH_CORES": str(cores)} if cores else {})
        self._process = subprocess.Popen(
            [sys.executable, "-m", "cannoise_jax.bench.worker", engine, item.name, str(place)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **environment},
        )  # fmt: skip

    @cached_property
    def started(self) -> dict[str, float]:
        """What starting cost, once it is ready."""
        return self._answer()

    def call(self, times: int = 1) -> dict[str, Any]:
        """Seconds (s, cpu_s) a call and memory (mib) of calls in a row, none waiting for the one before
        where the engine need not."""
        assert self._process.stdin and self.started
        self._process.stdin.write(f"{times}\n")
        self._process.stdin.flush()
        return self._answer()

    def end(self) -> None:
        """Lets the process go."""
        self._process.communicate()

    def kill(self) -> None:
        """Ends the process, whatever it does."""
        self._process.kill()
        self._process.wait()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout
        line = self._process.stdout.readline()
        if not line:
            raise BadInput(
                f"speed: the process of {self.engine} ended with status {self._process.wait()}: see above"
            )
        return json.loads(line)


def _short(found: dict[str, float]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in found.items())


def load() -> float:
    """Processes that wanted a core in the last minute; nan where the system does not tell."""
    return os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
