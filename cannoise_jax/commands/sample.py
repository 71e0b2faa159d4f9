"""bin/sample --model DIR --clean PATH --reference FILE_OR_CAMERA [--iso N] --out DIR

Synthetic noisy frames of a folder of clean images or recordings, as one camera at one ISO would record them.
"""

from __future__ import annotations

import argparse
import sys

from cannoise_jax.commands.entry import command
from cannoise_jax.commands.freed_memory import give_back_large
from cannoise_jax.commands.parser import OneLineParser, count, level, numbers, place, seed
from cannoise_jax.recordings.recording import CFA_PATTERNS, BadInput


@command("sample")
def main(argv: list[str] | None = None) -> int:
    """Samples; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(sys.argv[1:] if argv is None else argv)
    try:
        from cannoise_jax.commands.sample_frames import synthesise

        give_back_large()
        written = synthesise(arguments)
    except BadInput as error:
        print(f"bin/sample: {error}", file=sys.stderr)
        return 2
    for path in written:
        print(path)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/sample",
        description="Writes synthetic noisy frames, in the native format, of clean images: recordings of any "
        "format (their clean signal, or the mean of their frames) or floating-point NPY mosaics in 0..1.",
    )
    parser.add_argument("--model", required=True, type=place, help="training folder, or model file")
    parser.add_argument("--clean", required=True, type=place, metavar="PATH", help="a file or a folder")
    parser.add_argument(
        "--reference", required=True, metavar="FILE|CAMERA", help="a recording, or a camera of the model"
    )
    parser.add_argument("--iso", type=float, help="setting of the model's camera")
    parser.add_argument("--out", required=True, type=place, metavar="DIR", help="for the recordings")
    parser.add_argument("--frames", type=count, default=1, metavar="N", help="frames per clean image")
    parser.add_argument("--seed", type=seed, default=0, help="of the noise")
    add = parser.add_argument
    add(
        "--cfa",
        choices=CFA_PATTERNS,
        help="colour order of the clean images, and of a reference that states none",
    )
    add(
        "--black-level",
        type=numbers,
        metavar="DN",
        help="of the clean images, of a reference that states none, and of what is written without one",
    )
    add("--white-level", type=level, metavar="DN", help="likewise")
    add("--reference-cfa", choices=CFA_PATTERNS, help="of a reference file, in place of its own")
    add(
        "--reference-black-level",
        type=numbers,
        metavar="DN",
        help="of a reference file, in place of its own",
    )
    add("--reference-white-level", type=level, metavar="DN", help="likewise")
    add("--force", action="store_true", help="replace files that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
