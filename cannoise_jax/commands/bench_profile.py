"""bin/bench profile: what the time of a training step goes to, on the GPU that JAX finds."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

from cannoise_jax.commands.bench_accelerator import CODE, WORK, asked, check_gpu, machine
from cannoise_jax.commands.parser import add_table
from cannoise_jax.recordings.recording import BadInput

COLUMNS = ("work", "kernels", "ms", "share")
STEPS = tuple(name for name in WORK if name.startswith("step"))


def add_profile(commands: Any) -> None:
    """The flags of `bin/bench profile`, to the parser's commands."""
    parser = commands.add_parser("profile", help="what the time of a training step on a GPU goes to")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(WORK)} (default: steps)")
    parser.add_argument("--calls", type=int, default=10, help="traced, in a row")
    add_table(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Traces, prints and writes the table. Raises BadInput without an accelerator."""
    # One graph of a whole step would hide the kernels in it.
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_gpu_enable_command_buffer=".strip()
    from cannoise_jax.bench.items import ITEMS
    from cannoise_jax.bench.profile import profile
    from cannoise_jax.commands.bench_runs import check_table, write_table

    wanted = asked("profile", arguments.only or STEPS)
    if arguments.calls < 1:
        raise BadInput("profile: --calls from 1")
    check_gpu("profile")
    check_table(arguments)
    rows: list[tuple[str, ...]] = []
    values: dict[str, str] = {}
    for name in wanted:
        found = profile(name, arguments.calls, lambda line: print(line, file=sys.stderr, flush=True))
        whole = sum(found.kinds.values())
        values[f"{name}_ms"] = f"{1e3 * found.seconds:.2f}"
        for kind, seconds in found.kinds.items():
            rows.append((ITEMS[name].title, kind, f"{1e3 * seconds:.2f}", f"{100 * seconds / whole:.0f}%"))
            values[f"{name}_{kind.split(',')[0].replace(' ', '_')}"] = rows[-1][-1]
            print("  ".join(rows[-1]), flush=True)
        for kernel, seconds, times in found.longest:
            print(f"  {1e3 * seconds:8.3f} ms  {times:5d}  {kernel[:110]}", file=sys.stderr, flush=True)
    write_table(arguments, COLUMNS, rows, values, CODE, machine())
