"""bin/bench speed: training steps and sampling, timed alone or beside PyTorch."""

from __future__ import annotations

import argparse
import sys
from functools import partial
from importlib.util import find_spec
from typing import Any

from cannoise_jax.bench.items import ITEMS
from cannoise_jax.bench.side_by_side import Measured, Spread, measure
from cannoise_jax.commands.parser import add_table
from cannoise_jax.recordings.recording import BadInput

CODE = ("cannoise_jax/networks", "cannoise_jax/training", "cannoise_jax/sampling.py", "cannoise_jax/bench")
"""What the table depends on."""
PEERS = ("torch",)
HERE = tuple(name for name, item in ITEMS.items() if not item.accelerator)
WITH_PEER = tuple(name for name in HERE if ITEMS[name].base == "paper")
"""What the reference in PyTorch can do."""
COLUMNS = (
    "work", "ours, ms", "PyTorch, ms", "PyTorch / ours (quartiles)", "of CPU time", "memory, MiB",
    "PyTorch, MiB",    "init and first call, s", "from the cache, s", "load",
)  # fmt: skip


def add_speed(commands: Any) -> None:
    """The flags of `bin/bench speed`, to the parser's commands."""
    parser = commands.add_parser("speed", help="training steps and sampling, alone or beside PyTorch")
    parser.add_argument("--against", choices=PEERS, help="the same work in PyTorch, by turns")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(HERE)}")
    parser.add_argument("--pairs", type=int, default=9, help="timed calls each, taken by turns")
    parser.add_argument("--cores", type=int, help="of the machine to use (default: all)")
    add_table(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes the table."""
    from cannoise_jax.commands.bench_runs import check_table, write_table

    wanted = arguments.only or list(HERE)
    if set(wanted) - set(HERE):
        raise BadInput(f"speed: {', '.join(sorted(set(wanted) - set(HERE)))}: known are {', '.join(HERE)}")
    if arguments.pairs < 1 or (arguments.cores or 1) < 1:
        raise BadInput("speed: --pairs and --cores from 1")
    if arguments.against and find_spec("torch") is None:
        raise BadInput("speed: PyTorch is not installed: pip install 'cannoise-jax[torch]'")
    check_table(arguments)
    rows: list[tuple[str, ...]] = []
    values: dict[str, str] = {}
    for name in wanted:
        say = partial(print, file=sys.stderr, flush=True)
        beside = bool(arguments.against) and name in WITH_PEER
        found = measure(ITEMS[name], arguments.pairs, beside, arguments.cores, say)
        rows.append(cells(found))
        values |= named(found)
        print("  ".join(rows[-1]), flush=True)
    write_table(arguments, COLUMNS, rows, values, CODE)


def cells(found: Measured) -> tuple[str, ...]:
    """A row of the table."""
    begun = [_total(found.start[name]) for name in ("cold", "cached")]
    return (
        found.item.title,
        _ms(found.ours),
        _ms(found.peer) if found.peer else "",
        f"{found.ratio.median:.2f} ({found.ratio.low:.2f} to {found.ratio.high:.2f})" if found.ratio else "",
        f"{found.cpu.median:.2f}" if found.cpu else "",
        f"{found.mib['ours']:.0f}",
        f"{found.mib['torch']:.0f}" if "torch" in found.mib else "",
        *(f"{seconds:.1f}" for seconds in begun),
        " to ".join(f"{value:.1f}" for value in found.load),
    )


def named(found: Measured) -> dict[str, str]:
    """Numbers to cite in a sentence."""
    name = found.item.name
    values = {f"{name}_ms": _ms(found.ours), f"{name}_mib": f"{found.mib['ours']:.0f}"}
    if found.ratio:
        values[f"{name}_ratio"] = f"{found.ratio.median:.2f}"
    if found.cpu:
        values[f"{name}_cpu_ratio"] = f"{found.cpu.median:.2f}"
    return values


def _total(started: dict[str, float]) -> float:
    return started["init"] + started["first"]


def _ms(value: Spread) -> str:
    return f"{1e3 * value.median:.0f}"
