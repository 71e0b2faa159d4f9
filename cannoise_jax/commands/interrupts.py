"""Ctrl-C while libraries are loaded.

Commands load what they need when they need it. An exception in the midst of that is lost, or becomes another
one, or ends the process in the C++ of a library that is half there: a signal that comes then waits for its
end.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

_SOON_S, _PATIENCE_S = 0.05, 10.0
"""How soon it is looked again, and how long at most: code of the user's may never end loading."""
_LOADER = "<frozen importlib"
"""With what the names of the files of Python's own loader begin."""

Handler = Callable[[int, FrameType | None], Any]


def after_loading(handler: Handler) -> Handler:
    """The handler of a signal, which comes once nothing is being loaded in the main thread, and once for all
    signals of the same number that came until then."""
    since: dict[int, float] = {}

    def handle(number: int, frame: FrameType | None) -> None:
        first = since.get(number)
        if _is_loading(frame):
            if first is None:
                since[number] = time.monotonic()
                _again(number, since)
                return
            if time.monotonic() - first < _PATIENCE_S:
                return
        since.pop(number, None)
        handler(number, frame)

    return handle


def _is_loading(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code.co_filename.startswith(_LOADER):
            return True
        frame = frame.f_back
    return False


def _again(number: int, since: dict[int, float]) -> None:
    """Sends a signal to the main thread until it was heard."""
    main = threading.main_thread().ident

    def send() -> None:
        while number in since:
            time.sleep(_SOON_S)
            if number in since and main is not None:
                signal.pthread_kill(main, number)

    threading.Thread(target=send, daemon=True, name="later").start()
