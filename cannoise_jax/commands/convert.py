"""bin/convert IN... OUT.h5, or IN_FOLDER OUT_FOLDER: recordings of any supported format in the native one."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cannoise_jax.commands.entry import command, progress, show_warnings
from cannoise_jax.commands.outputs import check_file, check_takes_files, line_of
from cannoise_jax.commands.parser import OneLineParser, add_recording_flags, options, overrides, place
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished

if TYPE_CHECKING:
    from cannoise_jax.recordings.recording import Recording

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(,[\d.]+)*")
_NATIVE = (".h5", ".hdf5")


_MODES = {
    "binning": "binning",
    "origin": "origin of the part read out",
    "offset": "offset",
    "mode": "readout mode",
    "gain_setting": "gain setting",
    "filter": "filter",
    "bits": "number of bits",
}
"""What FITS headers state beside the fields of a recording, and what has to be one to be joined."""


@command("convert")
def main(argv: list[str] | None = None) -> int:
    """Converts; returns 0, or 2 after one line on stderr when something cannot be used."""
    parser = _parser()
    arguments = parser.parse_intermixed_args(_gathered(sys.argv[1:] if argv is None else argv))
    show_warnings("convert")
    try:
        if _is_folder(arguments):
            return _convert_folder(arguments)
        if not (arguments.paths[0].exists() or arguments.paths[0].is_symlink()):
            raise BadInput(f"{arguments.paths[0]}: no such file or folder")
        if arguments.dry_run or len(arguments.paths) < 2:
            parser.error("give IN... OUT.h5, or IN_FOLDER OUT_FOLDER; --dry-run prints the plan of a folder")
        if given := [f for f in ("assign", "leave_out") if getattr(arguments, f)]:
            flag = f"--{given[0].replace('_', '-')}"
            raise BadInput(
                f"{arguments.paths[0]}: {flag} sorts the files of a folder, and single files are given: "
                "name only those that are meant, and state their kind with --kind"
            )
        *inputs, output = arguments.paths
        recording = convert(inputs, output, overrides(arguments), arguments.force)
    except BadInput as error:
        print(f"bin/convert: {error}", file=sys.stderr)
        return 2
    print(line_of(output, recording))
    return 0


def convert(inputs: list[Path], output: Path, given: dict, force: bool = False) -> Recording:
    """Stacks the inputs, in the order given, into one native file and returns the recording written.

    given: see `metadata.OVERRIDES`. Raises BadInput, and then nothing is written.
    """
    from cannoise_jax.recordings.atomic import new_folder
    from cannoise_jax.recordings.join import join_recordings
    from cannoise_jax.recordings.load import load_recording
    from cannoise_jax.recordings.native import write_recording
    from cannoise_jax.recordings.sidd import is_instance
    from cannoise_jax.recordings.usable import copies, of_several_noises, without_noise

    missing = next((path for path in inputs if not path.exists() and not path.is_symlink()), None)
    if missing is not None:
        raise BadInput(f"{missing}: no such file or folder")
    if output.suffix.lower() not in _NATIVE:
        raise BadInput(f"{output}: the output comes last and ends in .h5 (or is a folder, for one folder)")
    check_file(output, output.suffix.lower(), force)
    if folder := next((path for path in inputs if path.is_dir() and not is_instance(path)), None):
        raise BadInput(
            f"{folder}: a folder, which becomes one recording for each kind and setting: name a folder for "
            f"the output, not the file {output}"
        )
    loaded = [load_recording(path, **given) for path in inputs]
    recording = join_recordings(loaded)
    _check_modes(inputs)
    twice = copies(loaded) if len(loaded) > 1 else {}
    for number, first in twice.items():
        print(
            f"bin/convert: {inputs[number]}: the same pixels as {inputs[first]}: used once", file=sys.stderr
        )
    kept = [r for number, r in enumerate(loaded) if number not in twice]
    if twice:
        recording = join_recordings(kept)
    if silent := without_noise(kept):
        more = f"; and {len(silent) - 1} more such" if len(silent) > 1 else ""
        print(f"bin/convert: {silent[0]}{more}: no noise in them, written as they are", file=sys.stderr)
    elif line := of_several_noises(recording):
        print(f"bin/convert: {line}: written as they are", file=sys.stderr)
    with new_folder(output.parent):
        write_recording(output, recording)
    return recording


def _check_modes(inputs: list[Path]) -> None:
    """Raises BadInput where FITS files were read out in ways that no field of a recording tells apart."""
    from cannoise_jax.recordings.fits import SUFFIXES, open_fits
    from cannoise_jax.recordings.load import suffix_of

    stated = [(path, open_fits(path).about) for path in inputs if suffix_of(path) in SUFFIXES]
    for (path, here), (first, there) in ((other, stated[0]) for other in stated[1:]):
        for name, what in _MODES.items():
            if here.get(name) != there.get(name):
                words = [
                    f"is {v}" if v is not None else "is not stated" for v in (here.get(name), there.get(name))
                ]
                raise BadInput(f"{path}: {what} {words[0]}, of {first} it {words[1]}: join equal settings")
        said, other = (dict(one.get("settings") or ()) for one in (here, there))
        for word in (word for word in said if word in other and said[word] != other[word]):
            raise BadInput(
                f"{path}: {word} is {said[word]}, of {first} it is {other[word]}: join equal settings"
            )


def _is_folder(arguments: argparse.Namespace) -> bool:
    """Whether one folder, but no scene folder of SIDD for a single file, is to be sorted."""
    first, *rest = arguments.paths
    to_file = bool(rest) and rest[-1].suffix.lower() in _NATIVE
    return len(rest) <= 1 and first.is_dir() and not to_file and (bool(rest) or arguments.dry_run)


def _convert_folder(arguments: argparse.Namespace) -> int:
    from cannoise_jax.recordings.folders.plan import plan_folder
    from cannoise_jax.recordings.folders.plan_text import text
    from cannoise_jax.recordings.folders.store import write_plan
    from cannoise_jax.recordings.usable import of_several_noises

    source, *rest = arguments.paths
    chosen = options(arguments)
    if rest and rest[0].resolve() == source.resolve():
        raise BadInput(f"{rest[0]}: is the folder that is read: name another one for what is converted")
    if rest and _inside(rest[0], source):
        raise BadInput(f"{rest[0]}: lies inside {source}: name a folder elsewhere for what is converted")
    if rest and not arguments.dry_run and not rest[0].is_file():
        check_takes_files(rest[0], rest[0])
    plan = plan_folder(
        source,
        chosen.overrides,
        assign=chosen.assign,
        leave_out=chosen.leave_out,
        tell=progress("reading files"),
    )
    print(text(plan), flush=True)
    if count := len(plan.problems):  # the plan lists them
        things = "1 thing is" if count == 1 else f"{count} things are"
        raise BadInput(f"{source}: {things} missing or contradictory, see the end of the plan")
    if arguments.dry_run:
        return 0
    written = {f"{one.folder}/{group.label}.h5".lstrip("/") for one in plan.sets for group in one.groups}
    for path in sorted(rest[0].rglob("*.h5")) if rest[0].is_dir() else []:
        if path.relative_to(rest[0]).as_posix() not in written and is_finished(path):
            print(f"note: {path}: not of this conversion, and stays", flush=True)
    tell = progress("writing recordings")
    total = sum(len(one.groups) for one in plan.sets)
    for number, (path, recording) in enumerate(write_plan(plan, rest[0], force=arguments.force), start=1):
        print(line_of(path, recording), flush=True)
        if line := of_several_noises(recording):
            print(f"note: {line}: written as they are", flush=True)
        tell(number, total)
    return 0


def _inside(path: Path, folder: Path) -> bool:
    return folder.resolve() in (path.resolve(), *path.resolve().parents)


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
        usage="bin/convert IN... OUT.h5 [flags]\n       bin/convert IN_FOLDER OUT_FOLDER [--dry-run] [flags]",
        description="Converts recordings into the native format (HDF5). Files of one camera, size and "
        "setting become one recording, in the order given. A folder is sorted by what headers and names say, "
        "into one recording for each kind, exposure, gain, temperature, filter and size.",
        epilog="Formats: FITS (.fits .fit .fts .fz .fits.gz), camera raw (DNG NEF CR2 CR3 ARW ...), TIFF, "
        "NPY, NPZ, PGM, grey PNG and BMP, HDF5, and scene folders of SIDD. Names that tell the kind of a "
        "file or its folder: bias, zero, offset; dark; flat; light.",
    )
    parser.add_argument("paths", nargs="+", type=place, metavar="PATH", help="inputs, and the output last")
    parser.add_argument("--dry-run", action="store_true", help="print the plan of a folder and write nothing")
    add_recording_flags(parser, single=True)
    parser.add_argument("--force", action="store_true", help="replace outputs that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
