"""bin/compare: what still differs between recordings and a simulator; which of two simulators is nearer."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import jax

from cannoise_jax.commands.parser import OneLineParser
from cannoise_jax.discovery.compare import Comparison, better, compare, document
from cannoise_jax.discovery.compare.page import page
from cannoise_jax.discovery.compare.report import better_document, better_line, lines
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.recording import BadInput


def main(argv: list[str] | None = None) -> int:
    """Prints the table and writes comparison.json and comparison.html; returns 0 whatever differs, 2 for bad
    input."""
    arguments = _parser().parse_args(argv)
    started = time.monotonic()

    def tell(text: str) -> None:
        print(f"[{time.monotonic() - started:6.1f} s] {text}", file=sys.stderr, flush=True)

    try:
        simulators = arguments.simulator or ["poisson-gaussian"]
        if len(simulators) > 2:
            raise BadInput(f"{len(simulators)} simulators: give one, or two to set side by side")
        if arguments.out is not None:
            _check(arguments.out)
        capture = load_capture_set(arguments.recordings)
        found: list[Comparison] = []
        for simulator in simulators:
            key = jax.random.key(arguments.key)
            found.append(compare(capture, simulator, key, alpha=arguments.alpha, tell=tell))
        result = better(found[0].bank, found[1].bank) if len(found) == 2 else None
        report: dict[str, Any] = {"comparisons": [document(c) for c in found]}
        if result is not None:
            report["better"] = better_document(found[0], found[1], result)
        if arguments.out is not None:
            texts = {
                "comparison.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
                "comparison.html": page(tuple(found), result),
            }
            for name, text in texts.items():
                _write(arguments.out / name, text)
    except (BadInput, ValueError, OSError) as error:
        print(f"bin/compare: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/compare: interrupted; nothing was written", file=sys.stderr)
        return 130
    for c in found:
        print("\n".join(lines(c)), end="\n\n")
    if result is not None:
        print(better_line(found[0], found[1], result))
    elif len(found) == 2:
        print("the simulators draw no recording in common: nothing says which is nearer")
    if arguments.out is not None:
        print(arguments.out / "comparison.html")
    return 0


def _check(out: Path) -> None:
    """Makes the folder. Raises BadInput, before a minute is spent, where the results could not be written."""
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: is a file: name a folder for the comparison")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{out}: cannot be made ({error.strerror}): name another folder") from error


def _write(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise BadInput(f"{path}: cannot be written ({error.strerror}): name another folder") from error


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/compare", description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True, help="folder of recordings of one camera")
    parser.add_argument(
        "--simulator",
        action="append",
        help="poisson-gaussian (calibrated from the recordings; the default), a sensor.json, a training "
        "folder, a folder of simulated frames, or module:function; give it twice to ask which is nearer",
    )
    parser.add_argument("--out", type=Path, help="folder for comparison.html and comparison.json")
    parser.add_argument("--alpha", type=float, default=0.01, help="chance of a false alarm of the run (0.01)")
    parser.add_argument("--key", type=int, default=0, help="seed of everything random (0)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
