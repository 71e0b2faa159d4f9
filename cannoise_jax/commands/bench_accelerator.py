"""bin/bench accelerator: training steps and sampling on the GPU that JAX finds."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Any

from cannoise_jax.commands.parser import add_table
from cannoise_jax.recordings.recording import BadInput

CODE = ("cannoise_jax/networks", "cannoise_jax/training", "cannoise_jax/sampling.py", "cannoise_jax/bench")
"""What the table depends on."""
WORK = (
    "step_paper_64", "step_paper_64_bf16", "step_default_64", "step_default_64_bf16", "step_default",
    "sample_batch", "sample_image", "sample_image_full",
)  # fmt: skip
BESIDE = ("step_paper_64", "sample_batch")
"""What the reference in PyTorch can do."""
COLUMNS = (
    "work", "by", "ms", "quartiles, ms", "TFLOP", "TFLOP/s", "of the matrix rate", "memory, GiB",
    "first call, s",
)  # fmt: skip


def add_accelerator(commands: Any) -> None:
    """The flags of `bin/bench accelerator`, to the parser's commands."""
    parser = commands.add_parser("accelerator", help="the same on a GPU, the paper's batch of 64")
    parser.add_argument("--against", choices=("torch",), help="also in PyTorch")
    parser.add_argument("--only", nargs="+", metavar="NAME", help=f"of {', '.join(WORK)}")
    parser.add_argument("--rounds", type=int, default=5, help="timed, after one that is not")
    parser.add_argument("--in-a-row", type=int, default=10, help="calls of a round")
    add_table(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes the table. Raises BadInput without an accelerator."""
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # the processes share its memory
    import jax

    from cannoise_jax.bench.accelerator import matrix_rate, measure
    from cannoise_jax.bench.items import ITEMS
    from cannoise_jax.commands.bench_runs import check_table, write_table

    wanted = asked("accelerator", arguments.only or WORK)
    if arguments.rounds < 1 or arguments.in_a_row < 1:
        raise BadInput("accelerator: --rounds and --in-a-row from 1")
    if arguments.against and find_spec("torch") is None:
        raise BadInput("accelerator: PyTorch is not installed: pip install 'cannoise-jax[torch]'")
    check_gpu("accelerator", ", or see bin/bench speed")
    check_table(arguments)
    engines = ("ours", *((arguments.against,) if arguments.against else ()))
    work = [(engine, name) for name in wanted for engine in engines if engine == "ours" or name in BESIDE]
    found = measure(work, arguments.rounds, arguments.in_a_row, lambda line: print(line, file=sys.stderr))
    rates = {dtype: matrix_rate(dtype) for dtype in ("float32", "bfloat16")}
    rows: list[tuple[str, ...]] = []
    values = {f"rate_{dtype}": f"{rate / 1e12:.0f}" for dtype, rate in rates.items()}
    values["device"] = jax.devices()[0].device_kind
    for one in found:
        known = [""] * 3
        if one.operations:
            reached = one.operations / one.seconds.median
            share = reached / rates[ITEMS[one.item].compute]
            known = [f"{one.operations / 1e12:.2f}", f"{reached / 1e12:.0f}", f"{share:.2f}"]
        rows.append(
            (
                ITEMS[one.item].title,
                {"ours": "ours", "torch": "PyTorch"}[one.engine],
                f"{1e3 * one.seconds.median:.2f}",
                f"{1e3 * one.seconds.low:.2f} to {1e3 * one.seconds.high:.2f}",
                *known,
                f"{one.mib / 1024:.1f}",
                f"{one.first:.0f}",
            )
        )
        ending = "" if one.engine == "ours" else "_torch"
        values[f"{one.item}{ending}_ms"] = f"{1e3 * one.seconds.median:.2f}"
        print("  ".join(rows[-1]), flush=True)
    for dtype, rate in rates.items():
        print(f"matrix product, {dtype}: {rate / 1e12:.0f} TFLOP/s")
    write_table(arguments, COLUMNS, rows, values, CODE, machine())


def asked(verb: str, names: Sequence[str]) -> list[str]:
    """The names of work. Raises BadInput for one that is none of `WORK`."""
    if unknown := sorted(set(names) - set(WORK)):
        raise BadInput(f"{verb}: {', '.join(unknown)}: known are {', '.join(WORK)}")
    return list(names)


def check_gpu(verb: str, instead: str = "") -> None:
    """Raises BadInput where JAX finds no GPU. instead: what else there is to do."""
    import jax

    if jax.default_backend() not in ("gpu", "cuda", "rocm"):
        raise BadInput(f"{verb}: JAX finds no GPU: install it with one{instead}")


def machine() -> str:
    """The accelerator, and the cores beside it."""
    import jax

    return f"{jax.devices()[0].device_kind}, {os.cpu_count()} cores"
