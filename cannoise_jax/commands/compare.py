"""bin/compare: what still differs between recordings and a simulator; which of two simulators is nearer,
by their draws or by the reports of two diagnoses."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.entry import cache_folder, command, progress, show_warnings, stages
from cannoise_jax.commands.outputs import check_folder
from cannoise_jax.commands.parser import (
    OneLineParser,
    add_mechanisms_flag,
    add_recording_flags,
    folder,
    options,
    seed,
)
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.discovery.compare import Comparison

_FILES = ("comparison.json", "comparison.html")


@command("compare")
def main(argv: list[str] | None = None) -> int:
    """Prints the table and writes comparison.json and comparison.html; returns 0 whatever differs, 2 for bad
    input."""
    arguments = _parser().parse_intermixed_args(argv)
    show_warnings("compare")
    tell = stages()
    try:
        if arguments.reports:
            return _of_reports(arguments)
        if arguments.recordings is None:
            raise BadInput("give --recordings, or two reports of bin/diagnose")
        simulators = arguments.simulator or ["poisson-gaussian"]
        if len(simulators) > 2:
            raise BadInput(f"{len(simulators)} simulators: give one, or two to set side by side")
        if not 0 < arguments.alpha < 1:
            raise BadInput(f"--alpha: must lie between 0 and 1, got {arguments.alpha:g}")
        for simulator in simulators:
            _check_named(simulator)
        if arguments.out is not None:
            check_folder(arguments.out, _FILES, arguments.force, "the comparison")
        found, result = _compared(arguments, simulators, tell)
        if arguments.out is not None:
            _write(arguments, found, result)
    except (BadInput, ValueError, OSError) as error:
        print(f"bin/compare: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/compare: interrupted; nothing was written", file=sys.stderr)
        return 130
    _show(found, result)
    if arguments.out is not None:
        print(arguments.out / "comparison.html")
    return 0


def _of_reports(arguments: argparse.Namespace) -> int:
    """Two reports of diagnoses of the same recordings."""
    from cannoise_jax.discovery.compare.reports import lines, read_compared, side_by_side

    if len(arguments.reports) != 2 or arguments.recordings is not None or arguments.simulator:
        raise BadInput("reports: give two of them and nothing to draw from")
    if arguments.out is not None:
        check_folder(arguments.out, _FILES[:1], arguments.force, "the comparison")
    result = side_by_side(*(read_compared(path) for path in arguments.reports))
    print("\n".join(lines(result)))
    if arguments.out is not None:
        from cannoise_jax.recordings.atomic import new_folder, texts_in_place

        text = json.dumps(result, indent=1, allow_nan=False) + "\n"
        with new_folder(arguments.out), texts_in_place({arguments.out / _FILES[0]: text}):
            pass
    return 0


def _check_named(simulator: str) -> None:
    """Raises BadInput, before the recordings are read, for what names no simulator."""
    if simulator != "poisson-gaussian" and ":" not in simulator and not Path(simulator).exists():
        raise BadInput(
            f"{simulator}: no such simulator: name poisson-gaussian, a sensor.json, a training folder, a "
            "folder of simulated frames, or module:function"
        )


def _compared(arguments: argparse.Namespace, simulators: list[str], tell) -> tuple[list[Comparison], Any]:
    """One comparison a simulator, and which of two is nearer."""
    from cannoise_jax.mechanisms.outside import entries_of
    from cannoise_jax.recordings.folders.store import capture_of
    from cannoise_jax.recordings.usable import usable

    own = entries_of(arguments.mechanisms)
    for simulator in simulators:
        if Path(simulator).suffix == ".json" and Path(simulator).is_file():
            from cannoise_jax.discovery.frames.simulate import check_file

            check_file(simulator, own)

    capture, plan = capture_of(
        arguments.recordings, options(arguments), cache_folder(), progress("reading files")
    )
    if plan:
        print(plan, end="", file=sys.stderr, flush=True)
    capture, left_out = usable(capture, unsteady=True)

    import jax

    from cannoise_jax.discovery.compare import better, compare
    from cannoise_jax.discovery.frames.faults import fault_lines, faults_of, without_moving, without_spots

    capture, moved = without_moving(capture)
    faults = faults_of(capture)
    for line in (*left_out, *moved, *fault_lines(faults)):
        print(f"bin/compare: {line}", file=sys.stderr, flush=True)
    capture = without_spots(capture, faults)

    key = jax.random.key(arguments.key)
    found = [compare(capture, s, key, alpha=arguments.alpha, mechanisms=own, tell=tell) for s in simulators]
    return found, better(found[0].bank, found[1].bank) if len(found) == 2 else None


def _show(found: list[Comparison], result: Any) -> None:
    from cannoise_jax.discovery.compare.report import better_line, lines

    for c in found:
        print("\n".join(lines(c)), end="\n\n")
    if result is not None:
        print(better_line(found[0], found[1], result))
    elif len(found) == 2:
        print("the simulators draw no recording in common: nothing says which is nearer")


def _write(arguments: argparse.Namespace, found: list[Comparison], result: Any) -> None:
    from cannoise_jax.discovery.compare import document
    from cannoise_jax.discovery.compare.page import page
    from cannoise_jax.discovery.compare.report import better_document
    from cannoise_jax.recordings.atomic import new_folder, texts_in_place

    report: dict[str, Any] = {"comparisons": [document(c) for c in found]}
    if result is not None:
        report["better"] = better_document(found[0], found[1], result)
    texts = (json.dumps(report, indent=1, allow_nan=False) + "\n", page(tuple(found), result))
    places = {arguments.out / n: t for n, t in zip(_FILES, texts, strict=True)}
    with new_folder(arguments.out), texts_in_place(places):
        pass


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/compare", description=__doc__)
    parser.add_argument(
        "reports",
        nargs="*",
        metavar="REPORT",
        help="report.json (or its folder) of two diagnoses, and no more",
    )
    parser.add_argument("--recordings", type=folder, metavar="DIR", help="recordings of one camera")
    parser.add_argument(
        "--simulator",
        action="append",
        help="poisson-gaussian (calibrated from the recordings; the default), a sensor.json, a training "
        "folder, a folder of simulated frames, or module:function; give it twice to ask which is nearer",
    )
    parser.add_argument(
        "--out",
        type=folder,
        metavar="DIR",
        help="for comparison.html and comparison.json (else: screen only)",
    )
    parser.add_argument("--alpha", type=float, default=0.01, help="chance of a false alarm of the run")
    parser.add_argument("--key", type=seed, default=0, help="seed of everything random")
    add_mechanisms_flag(parser, "entries of your own that a sensor.json names")
    add_recording_flags(parser)
    parser.add_argument("--force", action="store_true", help="replace results that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
