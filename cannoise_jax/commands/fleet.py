"""bin/fleet: diagnoses many capture sets, on this machine or a cluster, and ranks the cameras by what their
simulator lacks."""

from __future__ import annotations

import importlib.metadata
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cannoise_jax.commands import diagnose
from cannoise_jax.commands.entry import command, duration
from cannoise_jax.commands.outputs import check_folder, make_folder
from cannoise_jax.commands.parser import OneLineParser, count, folder, place
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput

_SHOWN = 20
"""Rows of the table on the screen."""
_PATIENCE_S = 30
"""How long a scheduler has to answer."""


@command("fleet")
def main(argv: list[str] | None = None) -> int:
    """Writes a report for every set, fleet.json, fleet.csv and fleet.html; returns 0 when all are diagnosed,
    1 when some could not be, 2 for bad input."""
    arguments, flags = _parser().parse_known_args(argv)
    try:
        return _run(arguments, flags)
    except BadInput as error:
        print(f"bin/fleet: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/fleet: interrupted: the same command goes on with the sets that are left", file=sys.stderr)
        return 130


def _run(arguments: Any, flags: list[str]) -> int:
    diagnose.check_flags(["--recordings", "each", "--out", "own", *flags], "bin/fleet")
    sets, out = _sets(arguments.recordings), arguments.out
    check_folder(out, (), arguments.force, "the reports")
    _check_table(out / "fleet.json", flags, arguments.force)
    found = {} if arguments.force else {name: row for name in sets if (row := _finished(name, out))}
    if found:
        print(f"{len(found)} of {len(sets)} have their report already")
    own = [*flags, "--force"] if arguments.force else flags
    with _executor(arguments.scheduler, arguments.processes) as executor:
        make_folder(out)
        table = _write(out, found, flags)
        jobs = {
            executor.submit(diagnose_set, str(place), os.path.abspath(out / name), own, os.getcwd()): name
            for name, place in sets.items()
            if name not in found
        }
        begun = time.monotonic()
        for number, job in enumerate(as_completed(jobs), start=1):
            name = jobs[job]
            found[name] = row = _outcome(job, name, out)
            still = (time.monotonic() - begun) / number * (len(jobs) - number)
            left = f" ({duration(still)} left)" if number < len(jobs) else ""
            print(f"{len(found)} of {len(sets)}: {name}: {row['verdict'] or row['error']}{left}", flush=True)
            table = _write(out, found, flags)

    from cannoise_jax.discovery.report.fleet import lines

    print("", *lines(table[:_SHOWN]), sep="\n")
    more = [f"and {len(table) - _SHOWN} more"] if len(table) > _SHOWN else []
    print(*more, out / "fleet.html", sep="\n")
    return int(any(row["error"] for row in table))


def _write(out: Path, found: dict[str, dict[str, Any]], flags: list[str]) -> list[dict[str, Any]]:
    """The table as it is now, written and returned."""
    from cannoise_jax.discovery.report import fleet
    from cannoise_jax.recordings.atomic import texts_in_place

    table = fleet.ranked(found.values())
    texts = fleet.texts(table, importlib.metadata.version("cannoise-jax"), flags)
    with texts_in_place({out / name: text for name, text in texts.items()}):
        return table


def _outcome(job: Future[str | None], name: str, out: Path) -> dict[str, Any]:
    """The row of a set whose diagnosis has ended."""
    from cannoise_jax.discovery.report.fleet import failed

    try:
        error = job.result()
    except Exception as lost:  # whatever ends a worker ends this set only
        error = " ".join(str(lost).split()) or type(lost).__name__
    if error:
        return failed(name, error)
    return _finished(name, out) or failed(name, "its report is not in --out: machines must share that folder")


def diagnose_set(recordings: str, out: str, flags: Sequence[str], here: str) -> str | None:
    """Diagnoses one set in a process of its own, whose end, whatever it is, ends nothing else.

    Returns its error in one line, None where there is none.
    """
    make_folder(Path(out).parent)
    words = [sys.executable, "-m", "cannoise_jax.commands.start", "diagnose"]
    ended = subprocess.run(
        [*words, "--recordings", recordings, "--out", out, *flags],
        cwd=here, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace",
    )  # fmt: skip
    if ended.returncode == 0:
        return None
    said = ended.stderr.strip().splitlines() or ["nothing said"]
    own = [line.removeprefix("bin/diagnose: ") for line in said if line.startswith("bin/diagnose: ")]
    return own[-1] if own and ended.returncode > 0 else f"ended with status {ended.returncode}: {said[-1]}"


@contextmanager
def _executor(scheduler: str | None, processes: int) -> Iterator[Executor]:
    """Where sets are diagnosed: threads here that wait for one process each, or workers of dask."""
    if scheduler is None:
        threads = ThreadPoolExecutor(processes)
        try:
            yield threads
        finally:
            threads.shutdown(wait=False, cancel_futures=True)
        return
    try:
        from distributed import Client
    except ImportError:
        raise BadInput("--scheduler: needs dask.distributed: pip install 'cannoise-jax[fleet]'") from None
    try:
        client = Client(scheduler, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        raise BadInput(f"--scheduler: {scheduler}: {' '.join(str(error).split())[:200]}") from error
    with client:
        yield client.get_executor(pure=False)


def _sets(source: Path) -> dict[str, Path]:
    """The capture sets by name: the folders in a folder, or those that a text file lists, a line each.

    The name is the place below the folder that holds all of them.
    """
    if source.is_dir():
        folders = sorted(p for p in source.iterdir() if p.is_dir() and not p.name.startswith("."))
    elif source.is_file():
        try:
            listed = source.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise BadInput(f"{source}: is no list of folders: a text file has one a line") from error
        folders = [Path(line.strip()) for line in listed if line.strip() and not line.startswith("#")]
    else:
        raise BadInput(f"{source}: no such folder or list")
    if not folders:
        raise BadInput(f"{source}: holds no folders: put each capture set into one, or list them in a file")
    places = list(dict.fromkeys(Path(os.path.abspath(f)) for f in folders))
    above = os.path.commonpath([p.parent for p in places])
    return {p.relative_to(above).as_posix(): p for p in places}


def _check_table(path: Path, flags: list[str], force: bool) -> None:
    """Raises BadInput where a folder holds the reports of other flags, which do not belong in one table."""
    if force or not path.exists():
        return
    try:
        before = json_of(path.read_text(encoding="utf-8"))["flags"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(
            f"{path}: is no table of a fleet: name another folder, or replace it with --force"
        ) from error
    if before != flags:
        words = " ".join(before) or "none"
        raise BadInput(f"{path}: was made with other flags ({words}): name another folder, or use --force")


def _finished(name: str, out: Path) -> dict[str, Any] | None:
    """The row of a set that has its report; None where it has none, or a damaged one."""
    from cannoise_jax.discovery.compare.reports import read_report
    from cannoise_jax.discovery.report import fleet

    try:
        return fleet.row(name, read_report(out / name / "report.json"))
    except (BadInput, KeyError):
        return None


def _parser() -> OneLineParser:
    parser = OneLineParser(
        prog="bin/fleet",
        description=__doc__,
        allow_abbrev=False,
        passes_on=True,
        epilog="All other flags are those of bin/diagnose, for every set alike. Sets that have a report are "
        "passed over, so that the same command goes on after an interruption, and tries again what failed.",
    )
    add = parser.add_argument
    add(
        "--recordings",
        type=place,
        required=True,
        metavar="DIR|LIST",
        help="a folder of capture sets, or a text file with the folder of one a line",
    )
    add("--out", type=folder, required=True, metavar="DIR", help="for the table, and a folder of each set")
    add(
        "--processes",
        type=count,
        default=max((os.cpu_count() or 2) // 2, 1),
        metavar="N",
        help="sets at a time on this machine",
    )
    add("--scheduler", metavar="ADDRESS", help="of dask.distributed, whose workers then diagnose")
    add("--force", action="store_true", help="diagnose all sets anew")
    return parser


if __name__ == "__main__":
    sys.exit(main())
