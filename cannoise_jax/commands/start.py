"""Starts a command by its name: python -m cannoise_jax.commands.start NAME ...

Loading a command takes some tenths of a second. Ctrl-C ends it within that time as it does later.
"""

from __future__ import annotations

import io
import os
import signal
import sys
from functools import partial
from importlib import import_module
from typing import Any

_INTERRUPTED = 130


def run(name: str) -> int:
    """Loads and runs a command; returns its status."""
    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # else it is ignored, as a shell has it for what runs behind
        signal.signal(signal.SIGINT, partial(_end, name))
    for stream in (sys.stdout, sys.stderr):  # names of files may hold bytes that no text has
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    from cannoise_jax.commands.compiled import keep_compiled
    from cannoise_jax.commands.interrupts import after_loading

    keep_compiled()
    # The work is shared out above: threads of the library of matrices would fight with those that share it.
    if "OMP_NUM_THREADS" not in os.environ:  # whoever states it has chosen
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main = import_module(f"cannoise_jax.commands.{name}").main
    if before is signal.default_int_handler:  # which raises KeyboardInterrupt
        signal.signal(signal.SIGINT, after_loading(before))
    try:
        status = main()
    except KeyboardInterrupt:  # once more, while the command ended for the first
        status = _INTERRUPTED
    finally:  # the work is done; what is left is Python's own end, which says tracebacks or loses the status
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if status == _INTERRUPTED:
        # Threads of libraries are still at work, and Python's own end in the midst of it may crash.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    return status


def _end(name: str, *_: Any) -> None:
    # An exception in the middle of an import may be lost, or turned into another one.
    os.write(2, f"bin/{name}: interrupted\n".encode())
    os._exit(_INTERRUPTED)


def __getattr__(name: str) -> Any:
    """The commands by name, as the installed scripts ask for them."""
    if name.startswith("_"):
        raise AttributeError(name)
    return partial(run, name)


if __name__ == "__main__":
    sys.exit(run(sys.argv.pop(1)))
