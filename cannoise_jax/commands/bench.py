"""bin/bench simulate|coverage|train|speed|diagnose|accelerator|profile|docs: speeds, exactness, results.

simulate     megapixels per second of SensorModel.sample beside getframes on the effects that both have.
coverage     how often the 90 % intervals of every mechanism's estimator hold the truth.
train        patches per second of the training step on random patches.
speed        seconds and memory of training steps and of sampling, alone or by turns with PyTorch.
diagnose     seconds and memory of a diagnosis, of simulated recordings and of folders.
accelerator  training and sampling at the paper's width and batch, on a GPU.
profile      what the time of these training steps goes to.
docs         renders README.md and docs/ from docs/results, and takes in what commands wrote.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial

from cannoise_jax.commands.bench_accelerator import add_accelerator
from cannoise_jax.commands.bench_diagnose import add_diagnose
from cannoise_jax.commands.bench_docs import add_docs
from cannoise_jax.commands.bench_profile import add_profile
from cannoise_jax.commands.bench_speed import add_speed
from cannoise_jax.commands.entry import command
from cannoise_jax.commands.parser import OneLineParser, add_table, seed
from cannoise_jax.recordings.recording import BadInput


@command("bench")
def main(argv: list[str] | None = None) -> int:
    """Runs one benchmark; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    try:
        arguments.run(arguments)
    except BadInput as error:
        print(f"bin/bench: {error}", file=sys.stderr)
        return 2
    return 0


def _run(name: str, arguments: argparse.Namespace) -> None:
    from cannoise_jax.commands import bench_runs

    runs = {
        "simulate": bench_runs.run_simulate,
        "coverage": bench_runs.run_coverage,
        "train": bench_runs.run_train,
    }
    runs[name](arguments)


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/bench", description=__doc__.split("\n\n")[0])
    commands = parser.add_subparsers(
        required=True, metavar="simulate|coverage|train|speed|diagnose|accelerator|profile|docs"
    )
    simulate = commands.add_parser("simulate", help="speed of SensorModel.sample beside getframes")
    simulate.add_argument(
        "--sizes", type=int, nargs="+", default=[256, 1024, 2048], help="frame sides, pixels"
    )
    simulate.add_argument("--electrons", type=float, nargs="+", default=[3.0, 300.0], help="mean signals, e-")
    simulate.add_argument("--frames", type=int, default=4, help="frames per timed call")
    simulate.add_argument(
        "--repeats", type=int, default=5, help="timed calls each, taken in turn; best counts"
    )
    add_table(simulate)
    simulate.set_defaults(run=partial(_run, "simulate"))
    covered = commands.add_parser("coverage", help="coverage of the 90 %% intervals of every estimator")
    covered.add_argument("--simulations", type=int, default=300, help="of each case")
    covered.add_argument("--mechanisms", nargs="+", metavar="ID", help="only these (default: all)")
    covered.add_argument("--seed", type=seed, default=0, help="of everything random")
    add_table(covered)
    covered.set_defaults(run=partial(_run, "coverage"))
    train = commands.add_parser("train", help="speed of the training step")
    train.add_argument("--width", type=float, default=1 / 16, help="of every channel count")
    train.add_argument("--batch", type=int, default=16, help="patches a step")
    train.add_argument("--patch", type=int, default=32, help="side of the packed patches")
    train.add_argument("--steps", type=int, default=10, help="timed, after two that are not")
    train.set_defaults(run=partial(_run, "train"))
    add_speed(commands)
    add_diagnose(commands)
    add_accelerator(commands)
    add_profile(commands)
    add_docs(commands)
    return parser


if __name__ == "__main__":
    sys.exit(main())
