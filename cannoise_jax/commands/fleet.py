"""bin/fleet: diagnoses many capture sets, on this machine or a cluster, and ranks the cameras by what their
simulator lacks."""

from __future__ import annotations

import importlib.metadata
import os
import signal
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

from cannoise_jax.commands import diagnose
from cannoise_jax.commands.entry import command, duration
from cannoise_jax.commands.fleet_process import diagnose_set, end_all
from cannoise_jax.commands.fleet_progress import FleetProgress
from cannoise_jax.commands.fleet_sets import Source, check_out, recorded, sets_of, source_of
from cannoise_jax.commands.interrupts import after_loading
from cannoise_jax.commands.outputs import check_folder, make_folder
from cannoise_jax.commands.parser import OneLineParser, count, folder, place
from cannoise_jax.commands.pulse import current
from cannoise_jax.recordings.atomic import REPORT_FILES
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished

_SHOWN = 20
"""Rows of the table on the screen."""
_PATIENCE_S = 30
"""How long a scheduler has to answer."""
_STOPPED = 128 + signal.SIGTERM
"""The status of what SIGTERM ended, as shells have it."""


@command("fleet")
def main(argv: list[str] | None = None) -> int:
    """Writes a report for every set, fleet.json, fleet.csv and fleet.html; returns 0 when all are diagnosed,
    1 when some could not be, 2 for bad input."""
    arguments, flags = _parser().parse_known_args(argv)
    try:
        with _stoppable():
            return _run(arguments, flags)
    except BadInput as error:
        print(f"bin/fleet: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        stopped = isinstance(error, _Stopped)
        said = "stopped" if stopped else "interrupted"
        print(f"bin/fleet: {said}: the same command goes on with the sets that are left", file=sys.stderr)
        return _STOPPED if stopped else 130


class _Stopped(KeyboardInterrupt):
    """SIGTERM, as the queue of a cluster sends it."""


@contextmanager
def _stoppable() -> Iterator[None]:
    """Within it SIGTERM ends what is done here as Ctrl-C does: with the processes that were begun."""
    if threading.current_thread() is not threading.main_thread():  # only that one may be told of signals
        yield
        return

    def stop(*_: Any) -> None:
        raise _Stopped

    before = signal.signal(signal.SIGTERM, after_loading(stop))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _run(arguments: Any, flags: list[str]) -> int:
    diagnose.check_flags(["--recordings", "each", "--out", "own", *flags], "bin/fleet")
    sets, out = sets_of(arguments.recordings), arguments.out
    check_out(arguments.recordings, sets, out)
    check_folder(out, (), arguments.force, "the reports")
    known = recorded(sets, out, flags, arguments.force)
    now = {name: source_of(place) for name, place in sets.items()}
    changed = [name for name in sets if name in known and known[name].stamp != now[name].stamp]
    kept = [name for name in sets if name in known and name not in changed]
    found = {name: row for name in kept if (row := _finished(name, out))}
    if found:
        print(f"{len(found)} of {len(sets)} have their report already")
    for name in changed:
        print(f"{name}: its recordings have changed since its report: diagnosed again")
    # The record says of what the reports are; what it does not name a killed run or a damaged file has left.
    record = {name: source for name, source in known.items() if name in found or name not in sets}
    own = [*flags, "--force"]
    with _executor(arguments.scheduler, arguments.processes) as executor:
        make_folder(out)
        table = _write(out, found, record, flags)
        asked = {name: place for name, place in sets.items() if name not in found}
        how_far = FleetProgress(len(asked), arguments.processes)
        current().at(how_far.words)
        jobs: dict[Future[str | None], str] = {}
        for name, place in asked.items():
            words = str(place), os.path.abspath(out / name), own, os.getcwd()
            # Workers elsewhere cannot be listened to.
            heard = () if arguments.scheduler else (partial(how_far.heard, name),)
            jobs[executor.submit(diagnose_set, *words, *heard)] = name
        for job in as_completed(jobs):
            name = jobs[job]
            found[name] = row = _outcome(job, name, out)
            how_far.ended(name, row["error"] is not None)
            still = how_far.left()
            left = "" if still is None else f" (some {duration(still)} left)"
            print(f"{len(found)} of {len(sets)}: {name}: {row['verdict'] or row['error']}{left}", flush=True)
            if row["error"] is None:
                record[name] = now[name]
            table = _write(out, found, record, flags)

    from cannoise_jax.discovery.report.fleet import lines

    print("", *lines(table[:_SHOWN]), sep="\n")
    more = [f"and {len(table) - _SHOWN} more"] if len(table) > _SHOWN else []
    print(*more, out / "fleet.html", sep="\n")
    return int(any(row["error"] for row in table))


def _write(
    out: Path, found: dict[str, dict[str, Any]], record: dict[str, Source], flags: list[str]
) -> list[dict[str, Any]]:
    """The table as it is now, written and returned."""
    from cannoise_jax.discovery.report import fleet
    from cannoise_jax.recordings.atomic import texts_in_place

    table = fleet.ranked(found.values())
    sources = {name: source._asdict() for name, source in record.items()}
    texts = fleet.texts(table, importlib.metadata.version("cannoise-jax"), flags, sources)
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


@contextmanager
def _executor(scheduler: str | None, processes: int) -> Iterator[Executor]:
    """Where sets are diagnosed: threads here that wait for one process each, or workers of dask."""
    if scheduler is None:
        threads = ThreadPoolExecutor(processes)
        try:
            yield threads
        finally:
            end_all(threads)
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


def _finished(name: str, out: Path) -> dict[str, Any] | None:
    """The row of a set that has its whole report; None where it has none, or that of another version."""
    from cannoise_jax.discovery.compare.reports import read_report
    from cannoise_jax.discovery.report import fleet

    if not all(is_finished(out / name / own) for own in REPORT_FILES):
        return None
    try:
        return fleet.row(name, read_report(out / name / "report.json"))
    except (BadInput, KeyError, TypeError):
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
