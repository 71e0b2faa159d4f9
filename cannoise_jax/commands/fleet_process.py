"""The process in which bin/fleet diagnoses a set, and the end of those that run."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from cannoise_jax.commands.outputs import make_folder

_GUARD = threading.Lock()
_RUNNING: set[subprocess.Popen] = set()
"""Processes of this one, whichever thread waits for them."""


def diagnose_set(recordings: str, out: str, flags: Sequence[str], here: str) -> str | None:
    """Diagnoses one set in a process of its own, whose end, whatever it is, ends nothing else.

    Returns its error in one line, None where there is none.
    """
    make_folder(Path(out).parent)
    words = [sys.executable, "-m", "cannoise_jax.commands.start", "diagnose"]
    with _running([*words, "--recordings", recordings, "--out", out, *flags], here) as process:
        _, said_all = process.communicate()
    if process.returncode == 0:
        return None
    said = said_all.strip().splitlines() or ["nothing said"]
    own = [line.removeprefix("bin/diagnose: ") for line in said if line.startswith("bin/diagnose: ")]
    return (
        own[-1] if own and process.returncode > 0 else f"ended with status {process.returncode}: {said[-1]}"
    )


def end_running() -> None:
    """Ends the processes of all threads: nobody would read what they find. Called when none is begun any
    more but by a thread that has just taken its set up, which waits here for its process to be known."""
    with _GUARD:
        for process in _RUNNING:
            process.terminate()


@contextlib.contextmanager
def _running(words: list[str], here: str) -> Iterator[subprocess.Popen]:
    with _GUARD:
        process = subprocess.Popen(
            words, cwd=here, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True, errors="replace",
        )  # fmt: skip
        _RUNNING.add(process)
    try:
        yield process
    finally:
        with _GUARD:
            _RUNNING.discard(process)
