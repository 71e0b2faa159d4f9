"""What every command does around its work: no traceback of a closed pipe, no warning of a library, and
word of how far it is."""

from __future__ import annotations

import functools
import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from cannoise_jax.commands.compiled import caches
from cannoise_jax.commands.pulse import Pulse, Stream, beating, current, fitting
from cannoise_jax.physics.core.foreign import of_interrupt, of_memory
from cannoise_jax.recordings.recording import BadInput, printable

_SILENT_S, _EVERY_S, _SOON_S = 2.0, 5.0, 0.05
_LONGEST = 200
"""Characters of a name that a line shows."""

Main = Callable[..., int]


def command(name: str) -> Callable[[Main], Main]:
    """Wraps a command's main: 130 after Ctrl-C; the work goes on when the reader of a pipe leaves;
    warnings of libraries are dropped, those of this package are a line on stderr."""

    def around(main: Main) -> Main:
        @functools.wraps(main)
        def wrapped(*given: Any, **more: Any) -> int:
            os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
            with warnings.catch_warnings(), _streams(name):
                warnings.showwarning = functools.partial(_shown, name)
                waiting: list[threading.Timer] = []
                hook, sys.unraisablehook = sys.unraisablehook, functools.partial(_again, waiting)
                try:
                    status = main(*given, **more)
                    sys.stdout.flush()
                    return status
                except BaseException as error:
                    if of_interrupt(error):
                        print(f"bin/{name}: interrupted", file=sys.stderr)
                        return 130
                    if (said := _of_the_machine(error)) is None:
                        raise
                    print(f"bin/{name}: {said}", file=sys.stderr)
                    return 2
                finally:
                    sys.unraisablehook = hook
                    for later in waiting:  # the command has ended: nobody is left to interrupt
                        later.cancel()

        return wrapped

    return around


def _of_the_machine(error: BaseException) -> str | None:
    """One line for what the system refuses at a place where nobody foresaw it; None for other errors."""
    if of_memory(error):
        return "not enough memory for frames of this size and number: give fewer, or smaller ones"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else error.filename
        name = printable(str(name))
        shown = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}..."
        return f"{shown}: cannot be used ({error.strerror}): name another one"
    return None


@contextmanager
def _streams(name: str) -> Iterator[None]:
    """Within it commands end their work, and say so to nobody, when the reader of a pipe has left, and say
    what they are at when they have said nothing for a while."""
    before, pulse = (sys.stdout, sys.stderr), Pulse(name)
    err = Stream(before[1], pulse)
    out = Stream(before[0], pulse, lambda why: print(f"bin/{name}: what it prints is lost: {why}", file=err))
    sys.stdout, sys.stderr = out, err  # type: ignore[assignment]
    try:
        with beating(pulse, err):
            yield
    finally:
        sys.stdout, sys.stderr = before


def _again(waiting: list[threading.Timer], swallowed: Any) -> None:
    """Ctrl-C inside a callback that cannot raise (JAX has one in the garbage collector) comes once more."""
    if issubclass(swallowed.exc_type, KeyboardInterrupt):
        # At once would still be inside of it; a signal to the main thread also ends what it waits for.
        main = threading.main_thread().ident
        later = threading.Timer(_SOON_S, signal.pthread_kill, (main, signal.SIGINT))
        later.daemon = True
        waiting.append(later)
        later.start()
    else:
        sys.__unraisablehook__(swallowed)


def _shown(command_name: str, message, category, filename, lineno, file=None, line=None) -> None:
    if str(getattr(category, "__module__", "")).startswith("cannoise_jax"):
        print(f"bin/{command_name}: {printable(str(message))}", file=sys.stderr)


class _Line(logging.Formatter):
    """Records of the log in one printable line each."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))


def show_warnings(name: str) -> None:
    """From now on what the package warns of in its log is a line on stderr, as of the command."""
    handler = logging.StreamHandler()
    handler.setFormatter(_Line(f"bin/{name}: %(message)s"))
    logging.basicConfig(handlers=[handler], level=logging.WARNING)


def cache_folder() -> Path:
    """Where conversions of folders are kept. Raises BadInput where the user has no home folder."""
    try:
        return caches() / "folders"
    except RuntimeError as error:
        raise BadInput("no home folder to keep converted files in: set XDG_CACHE_HOME") from error


def progress(doing: str, alone: bool = True) -> Callable[..., None]:
    """Says on stderr how many are done and how long the rest will take, once that is worth saying: on one
    line of a terminal, else a line every few seconds. next_one: what is being done now. alone: else what is
    done is said by the caller, and only silence is broken."""
    started = last = entered = time.monotonic()
    spoken = False
    at = 0, 0, ""

    def words() -> str:
        number, total, next_one = at
        text = f"{doing}: {number} of {total}"
        # What is being done may take longer than what was: beyond the time of all that is left it tells
        # nothing of when that ends, and no time is said.
        usual = (entered - started) / number * (total - number) if number else 0.0
        left = usual - (time.monotonic() - entered)
        text += f", {duration(left)} left" if left > 0 else ""
        return text + (f", now {printable(next_one)}" if next_one else "")

    pulse = current()

    def tell(number: int, total: int, next_one: str = "") -> None:
        nonlocal last, spoken, at, entered
        now, first = time.monotonic(), not at[1]
        if (number, total) != at[:2]:
            entered = now
        at = number, total, next_one
        if number >= total:
            pulse.done(words)
            if spoken:
                line = f"{doing}: {total} in {now - started:.0f} s"
                line = f"\r{fitting(f'{line:<72}')}" if sys.stderr.isatty() else line
                print(line, file=sys.stderr, flush=True)
            spoken = False
            return
        if first:
            pulse.at(words)
        terminal = sys.stderr.isatty()
        soon = now - started < _SILENT_S or now - last < (0.2 if terminal else _EVERY_S)
        if soon or not number or not alone:
            return
        last, spoken = now, True
        line, end = (f"\r{fitting(f'{words():<72}')}", "") if terminal else (words(), "\n")
        print(line, end=end, file=sys.stderr, flush=True)

    return tell


def stages() -> Callable[[str], None]:
    """Says each line with the time since it was made, and the last one again where nothing else is said."""
    began, last = time.monotonic(), "reading the files"

    def tell(text: str) -> None:
        nonlocal last
        last = text
        print(f"[{time.monotonic() - began:6.1f} s] {text}", file=sys.stderr, flush=True)

    current().at(lambda: f"still {last}")
    return tell


def counted(items: Sequence[Any], doing: str, named: Callable[[Any], str] | None = None) -> Iterator[Any]:
    """The items one by one, with word of how far it is. named: what an item is called while it is done."""
    tell = progress(doing)
    for number, item in enumerate(items):
        tell(number, len(items), *([named(item)] if named else []))
        yield item
    tell(len(items), len(items))


def duration(seconds: float) -> str:
    """A time as one says it."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
