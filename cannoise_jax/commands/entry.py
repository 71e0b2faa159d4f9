"""What every command does around its work: no traceback of a closed pipe, no warning of a library, and
word of how far it is."""

from __future__ import annotations

import functools
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

from cannoise_jax.commands.compiled import caches
from cannoise_jax.recordings.recording import BadInput

_SILENT_S, _EVERY_S, _SOON_S = 2.0, 10.0, 0.05
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
            with warnings.catch_warnings(), _unread_too():
                warnings.showwarning = functools.partial(_shown, name)
                waiting: list[threading.Timer] = []
                hook, sys.unraisablehook = sys.unraisablehook, functools.partial(_again, waiting)
                try:
                    status = main(*given, **more)
                    sys.stdout.flush()
                    return status
                except BaseException as error:
                    if _of_interrupt(error):
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
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)[:200]:  # of NumPy, of JAX
        return "not enough memory for frames of this size and number: give fewer, or smaller ones"
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes)) else error.filename
        name = " ".join(str(name).split())
        shown = name if len(name) <= _LONGEST else f"{name[:_LONGEST]}..."
        return f"{shown}: cannot be used ({error.strerror}): name another one"
    return None


def _of_interrupt(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C, or what somebody made of it: Python itself has RuntimeError for one that
    comes in `__set_name__`, as in a late import."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def _unread_too() -> Iterator[None]:
    """Within it commands end their work, and say so to nobody, when the reader of a pipe has left."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = map(_Unread, before)  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


class _Unread:
    """A stream that drops what nobody reads."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        with self._dropping():
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with self._dropping():
            self._stream.flush()

    @contextmanager
    def _dropping(self) -> Iterator[None]:
        try:
            yield
        except BrokenPipeError:
            # What is left in the buffer must not be written at exit, either.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


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
        print(f"bin/{command_name}: {' '.join(str(message).split())}", file=sys.stderr)


def cache_folder() -> Path:
    """Where conversions of folders are kept. Raises BadInput where the user has no home folder."""
    try:
        return caches() / "folders"
    except RuntimeError as error:
        raise BadInput("no home folder to keep converted files in: set XDG_CACHE_HOME") from error


def progress(doing: str) -> Callable[..., None]:
    """Says on stderr how many are done and how long the rest will take, once that is worth saying: on one
    line of a terminal, else a line every ten seconds. next_one: what is being done now."""
    started = last = time.monotonic()
    spoken = False

    def tell(number: int, total: int, next_one: str = "") -> None:
        nonlocal last, spoken
        now = time.monotonic()
        terminal = sys.stderr.isatty()
        if spoken and number >= total:
            end = "\n" if terminal else ""
            print(f"{end}{doing}: {total} in {now - started:.0f} s", file=sys.stderr, flush=True)
            spoken = False
            return
        if (
            number >= total
            or now - started < _SILENT_S
            or not number
            or now - last < (0.2 if terminal else _EVERY_S)
        ):
            return
        last, spoken = now, True
        left = (now - started) / number * (total - number)
        text = f"{doing}: {number} of {total}, {duration(left)} left"
        text += f", now {next_one}" if next_one else ""
        line, end = (f"\r{text:<72}", "") if terminal else (text, "\n")
        print(line, end=end, file=sys.stderr, flush=True)

    return tell


def counted(items: Sequence[Any], doing: str, named: Callable[[Any], str] | None = None) -> Iterator[Any]:
    """The items one by one, with word of how far it is. named: what an item is called while it is done."""
    tell = progress(doing)
    for number, item in enumerate(items):
        yield item
        following = [named(other) for other in items[number + 1 : number + 2]] if named else []
        tell(number + 1, len(items), *following)


def duration(seconds: float) -> str:
    """A time as one says it."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.0f} min"
