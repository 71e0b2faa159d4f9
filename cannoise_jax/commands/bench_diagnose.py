"""bin/bench diagnose: what a diagnosis costs, of simulated recordings and of folders."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.parser import add_table, folder

if TYPE_CHECKING:
    from cannoise_jax.bench.diagnosis import Cost

CODE = (
    *("cannoise_jax/recordings", "cannoise_jax/physics", "cannoise_jax/mechanisms"),
    *("cannoise_jax/evaluation", "cannoise_jax/signatures", "cannoise_jax/discovery"),
)
"""What the table depends on."""
COLUMNS = (
    "recordings", "megapixel-frames", "first time, s", "again, s", "CPU time, s",
    "CPU-s a megapixel-frame", "times a NumPy pass", "memory, MiB", "load",
)  # fmt: skip


def add_diagnose(commands: Any) -> None:
    """The flags of `bin/bench diagnose`, to the parser's commands."""
    parser = commands.add_parser("diagnose", help="seconds and memory of a diagnosis")
    parser.add_argument(
        "--recordings", type=folder, nargs="+", default=[], metavar="FOLDER", help="of cameras, timed as well"
    )
    add_table(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measures, prints and writes the table."""
    from cannoise_jax.bench.diagnosis import EFFECT, camera, cost, write_set
    from cannoise_jax.bench.side_by_side import load
    from cannoise_jax.commands.bench_runs import check_table, write_table
    from cannoise_jax.recordings.load import load_capture_set

    check_table(arguments)
    for recordings in arguments.recordings:
        load_capture_set(recordings)  # one that cannot be read is refused before minutes are spent
    rows: list[tuple[str, ...]] = []
    with tempfile.TemporaryDirectory(prefix="cannoise-bench-") as place:
        sets: list[tuple[str, Path]] = []
        for effect in (None, EFFECT):
            (recordings := Path(place) / f"recordings_{len(sets)}").mkdir()
            write_set(recordings, camera(effect))
            sets.append((f"simulated, {effect or 'no effect'}", recordings))
        sets += [(recordings.name, recordings) for recordings in arguments.recordings]
        for name, recordings in sets:
            (own := Path(place) / str(len(rows))).mkdir()
            rows.append(cells(name, cost(recordings, own), load()))
            print("  ".join(rows[-1]), flush=True)
    write_table(arguments, COLUMNS, rows, {}, CODE)


def cells(name: str, found: Cost, busy: float) -> tuple[str, ...]:
    """A row of the table; busy: load of the machine."""
    cpu = found.warm.cpu
    return (
        name,
        f"{found.megapixels:.2f}",
        f"{found.cold.seconds:.0f}",
        f"{found.warm.seconds:.0f}",
        f"{cpu:.0f}",
        f"{cpu / found.megapixels:.1f}",
        f"{cpu / found.numpy:,.0f}",
        f"{max(found.cold.mib, found.warm.mib):.0f}",
        f"{busy:.1f}",
    )
