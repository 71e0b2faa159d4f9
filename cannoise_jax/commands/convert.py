"""bin/convert IN... OUT.h5: recordings of any supported format into one file of the native format."""

from __future__ import annotations

import argparse
import logging
import re
import sys
from pathlib import Path

from cannoise_jax.commands.parser import OneLineParser, numbers
from cannoise_jax.recordings.join import join_recordings
from cannoise_jax.recordings.load import load_recording, supported
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import CFA_PATTERNS, KINDS, BadInput

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(,[\d.]+)*")


def main(argv: list[str] | None = None) -> int:
    """Converts; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(_gathered(sys.argv[1:] if argv is None else argv))
    logging.basicConfig(format="bin/convert: %(message)s", level=logging.WARNING)
    overrides = {
        name: getattr(arguments, name)
        for name in ("cfa", "black_level", "white_level", "kind", "camera", "iso", "exposure_s")
        if getattr(arguments, name) is not None
    }
    try:
        recording = convert(arguments.inputs, arguments.output, overrides, arguments.overwrite)
    except BadInput as error:
        print(f"bin/convert: {error}", file=sys.stderr)
        return 2
    size = "{} x {}".format(*recording.size)
    print(f"{arguments.output}: {recording.count} frames of {size}, {recording.cfa}, {recording.camera}")
    return 0


def convert(inputs: list[Path], output: Path, overrides: dict, overwrite: bool = False):
    """Stacks the inputs, in the order given, into one native file and returns the recording written.

    Raises BadInput, and then nothing is written.
    """
    if output.suffix.lower() not in (".h5", ".hdf5"):
        raise BadInput(f"{output}: the output comes last and ends in .h5")
    if output.exists() and not overwrite:
        raise BadInput(f"{output}: exists: name another file, or replace it with --overwrite")
    if not output.parent.is_dir():
        raise BadInput(f"{output}: no such folder {output.parent}")
    recording = join_recordings([load_recording(path, **overrides) for path in inputs])
    write_recording(output, recording)
    return recording


def _gathered(argv: list[str]) -> list[str]:
    """The numbers that follow --black-level as one argument, a,b,c,d, so that files may come after them."""
    if "--black-level" not in argv:
        return list(argv)
    start = argv.index("--black-level") + 1
    end = start
    while end < len(argv) and _NUMBER.fullmatch(argv[end]):
        end += 1
    return [*argv[:start], *([",".join(argv[start:end])] if end > start else []), *argv[end:]]


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/convert",
        description="Converts recordings into one file of the native format (HDF5). Several inputs of the "
        "same camera, size and settings become one recording, in the order given.",
        epilog=f"Formats: {supported()}; and the scene folders of SIDD.",
    )
    parser.add_argument("inputs", nargs="+", type=Path, metavar="IN")
    parser.add_argument("output", type=Path, metavar="OUT.h5")
    parser.add_argument("--cfa", choices=CFA_PATTERNS, help="colour order of the 2x2 cell")
    parser.add_argument(
        "--black-level", type=numbers, metavar="DN", help="one value, or four in mosaic order"
    )
    parser.add_argument("--white-level", type=float, metavar="DN")
    parser.add_argument("--kind", choices=KINDS)
    parser.add_argument("--camera", metavar="NAME")
    parser.add_argument("--iso", type=float)
    parser.add_argument("--exposure", type=float, dest="exposure_s", metavar="SECONDS")
    parser.add_argument("--overwrite", action="store_true", help="replace OUT.h5 where it exists")
    return parser


if __name__ == "__main__":
    sys.exit(main())
