"""The process in which bin/fleet diagnoses a set: it ends with the one that began it, however that ends.

python -m cannoise_jax.commands.fleet_process PIPE diagnose ...
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from cannoise_jax.commands.outputs import make_folder
from cannoise_jax.commands.start import run

_POLL_S = 0.05
_GUARD = threading.Lock()
_RUNNING: set[subprocess.Popen] = set()
"""Processes of this one, whichever thread waits for them."""


def diagnose_set(
    recordings: str,
    out: str,
    flags: Sequence[str],
    here: str,
    heard: Callable[[str], None] = lambda line: None,
) -> str | None:
    """Diagnoses one set in a process of its own, whose end, whatever it is, ends nothing else. heard: called
    with what it says, line by line, and with nothing when it begins.

    Returns its error in one line, None where there is none.
    """
    make_folder(Path(out).parent)
    said = []
    with _running(["diagnose", "--recordings", recordings, "--out", out, *flags], here) as process:
        heard("")
        assert process.stderr is not None
        for line in process.stderr:
            heard(line)
            said.append(line.strip())
        process.wait()
    if process.returncode == 0:
        return None
    said = [line for line in said if line] or ["nothing said"]
    own = [line.removeprefix("bin/diagnose: ") for line in said if line.startswith("bin/diagnose: ")]
    return (
        own[-1] if own and process.returncode > 0 else f"ended with status {process.returncode}: {said[-1]}"
    )


def end_all(threads: ThreadPoolExecutor) -> None:
    """Ends threads that diagnose, with their processes, of which nobody would read what they find."""
    threads.shutdown(wait=False, cancel_futures=True)
    ended = threading.Thread(target=threads.shutdown, daemon=True)
    ended.start()
    while ended.is_alive():  # a thread may have taken a set and not yet begun its process
        with _GUARD:
            for process in _RUNNING:
                process.terminate()
        ended.join(_POLL_S)


@contextlib.contextmanager
def _running(words: list[str], here: str) -> Iterator[subprocess.Popen]:
    """A process that knows by a pipe that this one is there: what is killed tells nobody."""
    theirs, ours = os.pipe()
    try:
        start = [sys.executable, "-m", "cannoise_jax.commands.fleet_process", str(theirs)]
        with _GUARD:
            process = subprocess.Popen(
                [*start, *words], cwd=here, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE, text=True, errors="replace", pass_fds=(theirs,),
            )  # fmt: skip
            _RUNNING.add(process)
        try:
            yield process
        finally:
            with _GUARD:
                _RUNNING.discard(process)
    finally:
        os.close(theirs)
        os.close(ours)


def _end_with(pipe: int) -> None:
    """Ends this process once nobody holds the other end of the pipe, into which nothing is written."""

    def wait() -> None:
        os.read(pipe, 1)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    _end_with(int(sys.argv.pop(1)))
    sys.exit(run(sys.argv.pop(1)))
