"""The work of `items` on an accelerator: a few processes start together, for compiling takes longest there,
and are then timed alone, one after the other. What the matrix units reach is measured beside it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cannoise_jax.bench.items import ITEMS
from cannoise_jax.bench.side_by_side import Spread, Worker, spread

_ENVIRONMENT = {
    "XLA_PYTHON_CLIENT_PREALLOCATE": "false",  # several processes share the memory
    "CANNOISE_BENCH_TORCH_DEVICE": "cuda",
}
_SIDE = 8192
_TOGETHER = 3
"""Processes that share the memory of an accelerator: each keeps what it once took."""


class Timed(NamedTuple):
    """An item by one engine. seconds: a call, of calls in a row; first: of the first call, compiling and all;
    operations: of a step, see `operations`, None of sampling; mib: most memory of the accelerator."""

    item: str
    engine: str
    seconds: Spread
    first: float
    operations: float | None
    mib: float


def measure(
    work: Sequence[tuple[str, str]],
    rounds: int,
    in_a_row: int,
    say: Callable[[str], None] = lambda line: None,
) -> list[Timed]:
    """Times (engine, item) pairs in rounds of calls in a row. PyTorch takes the weights of ours, which
    comes before it."""
    found = []
    with tempfile.TemporaryDirectory(prefix="cannoise-bench-") as folder:
        for start in range(0, len(work), _TOGETHER):
            workers = {
                (engine, item): Worker(engine, ITEMS[item], Path(folder) / f"{item}.npz", dict(_ENVIRONMENT))
                for engine, item in work[start : start + _TOGETHER]
            }
            try:
                for worker in workers.values():
                    worker.started  # noqa: B018 - all have to be ready before one is timed
                found += [_timed(*pair, worker, rounds, in_a_row, say) for pair, worker in workers.items()]
            finally:
                for worker in workers.values():
                    worker.kill()
    return found


def _timed(
    engine: str, item: str, worker: Worker, rounds: int, in_a_row: int, say: Callable[[str], None]
) -> Timed:
    began = worker.started
    say(f"{item}, {engine}: first call {began['first']:.1f} s")
    calls = [worker.call(in_a_row) for _ in range(rounds + 1)][1:]
    seconds = spread([c["s"] for c in calls])
    say(f"{item}, {engine}: {1e3 * seconds.median:.2f} ms")
    return Timed(item, engine, seconds, began["first"], began.get("operations"), calls[-1]["mib"])


def matrix_rate(dtype: str, rounds: int = 10) -> float:
    """Operations a second of products of two 8192 x 8192 matrices, as JAX does them by default."""
    import jax

    keys = jax.random.split(jax.random.key(0), 2)
    a, b = (jax.random.normal(k, (_SIDE, _SIDE), dtype) for k in keys)
    product = jax.jit(lambda a, b: a @ b)
    product(a, b).block_until_ready()
    begun = time.perf_counter()
    for _ in range(rounds):
        made: Any = product(a, b)
    made.block_until_ready()
    return 2.0 * _SIDE**3 * rounds / (time.perf_counter() - begun)
