"""A sign of life of a command that has said nothing for some seconds: what it is at, and for how long.

One thread of a command looks at when something was last said. On a terminal what comes next is written over
it, elsewhere it is a line.
"""

from __future__ import annotations

import io
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TextIO

QUIET_S = 4.5
"""Seconds after which something is said."""
_LOOK_S, _ENDS_S = 0.25, 1.0
_CLEAR = "\r\x1b[K"


class Pulse:
    """What a command is at, and when it last said something."""

    def __init__(self, name: str, clock: Callable[[], float] = time.monotonic) -> None:
        self._doing: list[Callable[[], str]] = [lambda: f"bin/{name} is at work"]
        self._clock = clock
        self._began = self._last = clock()
        self._lock = threading.RLock()
        self._over: Stream | None = None

    @contextmanager
    def doing(self, words: Callable[[], str]) -> Iterator[None]:
        """Within it this is what the command is at; asked when it is to be said."""
        self._doing.append(words)
        try:
            yield
        finally:
            self._doing.remove(words)

    def at(self, words: Callable[[], str]) -> None:
        """What the command is at from now on."""
        self._doing.append(words)

    def done(self, words: Callable[[], str]) -> None:
        """It is not at that any more."""
        if words in self._doing:
            self._doing.remove(words)

    @contextmanager
    def stages(self) -> Iterator[None]:
        """After it the command is at what it was at before, whatever was said within."""
        before = list(self._doing)
        try:
            yield
        finally:
            self._doing[:] = before

    def words(self) -> str:
        """What the command is at now."""
        return self._doing[-1]()

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Around whatever else is said."""
        with self._lock:
            if self._over is not None:
                self._over.put(_CLEAR)
                self._over = None
            try:
                yield
            finally:
                self._last = self._clock()

    def beat(self, stream: Stream) -> None:
        """Says what the command is at, where nothing was said for a while."""
        with self._lock:
            now = self._clock()
            if now - self._last < QUIET_S:
                return
            self._last = now
            text = f"[{now - self._began:6.1f} s] {self.words()}"
            if not stream.isatty():
                stream.put(f"{text}\n" if stream.at_start else f"\n{text}\n")
                stream.at_start = True
                return
            stream.put(f"{'' if stream.at_start else chr(10)}{_CLEAR}{fitting(text)}")
            self._over = stream


class Stream:
    """A stream of which a pulse knows, and which drops what nobody reads. lost: called with the reason where
    what is written cannot be kept."""

    def __init__(
        self, stream: TextIO | None, pulse: Pulse, lost: Callable[[str], None] = lambda why: None
    ) -> None:
        # Python has no stream where the shell closed it.
        self._stream = io.StringIO() if stream is None else stream
        self._pulse = pulse
        self._lost = lost
        self.at_start = True
        """Whether nothing stands on the line, or what may be written over."""

    def write(self, text: str) -> int:
        with self._pulse.writing(), self._dropping():
            self._stream.write(text)
            if text:
                self.at_start = text.endswith("\n") or text.startswith("\r")
        return len(text)

    def put(self, text: str) -> None:
        """Writes what does not count as said."""
        with self._dropping():
            self._stream.write(text)
            self._stream.flush()

    def flush(self) -> None:
        with self._dropping():
            self._stream.flush()

    @contextmanager
    def _dropping(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            # What is left in the buffer must not be written at exit, either.
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())
            if not isinstance(error, BrokenPipeError):
                self._lost(error.strerror or str(error))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


_CURRENT: list[Pulse] = []
"""Of the command that runs, the outermost where one calls another."""


def current() -> Pulse:
    """The pulse of the command that runs; one that nobody listens to where none does."""
    return _CURRENT[0] if _CURRENT else Pulse("")


def now_at(text: str) -> None:
    """What the command that runs is at from now on, where it says nothing itself."""
    current().at(lambda: text)


@contextmanager
def beating(pulse: Pulse, stream: Stream) -> Iterator[None]:
    """Within it signs of life are written to a stream."""
    if _CURRENT:  # that of the command that called this one
        yield
        return
    ended = threading.Event()

    def go_on() -> None:
        while not ended.wait(_LOOK_S):
            pulse.beat(stream)

    _CURRENT.append(pulse)
    thread = threading.Thread(target=go_on, daemon=True, name="pulse")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(_ENDS_S)  # longer where nobody reads what it writes
        _CURRENT.remove(pulse)
        with pulse.writing():
            pass


def fitting(text: str) -> str:
    """As much of a line as the terminal takes without wrapping it."""
    return text[: max(shutil.get_terminal_size().columns, 20) - 1]
