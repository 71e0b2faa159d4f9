"""How far a fleet is: what the sets that are being diagnosed are at, and how long the rest may take."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from typing import NamedTuple

from cannoise_jax.commands.entry import duration

_LINE = re.compile(r"\[ *[\d.]+ s\] (?:still )?(.*?)(?:; some (\d+) (s|min) left)?$")
"""A line of a diagnosis: what it is at, and how long the rest of it may take."""
_ENDS = 0.1
"""Of the time that sets take, what one is expected to take still when that is over."""


class Running(NamedTuple):
    """A set that is being diagnosed. began, ends: by the clock; ends: as it says itself, or None."""

    began: float
    text: str = ""
    ends: float | None = None


class FleetProgress:
    """What is known of `total` sets, `processes` of which are diagnosed at a time. Called by threads."""

    def __init__(self, total: int, processes: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._total, self._processes, self._clock = total, processes, clock
        self._lock = threading.Lock()
        self._running: dict[str, Running] = {}
        self._took: list[float] = []
        self._done = 0

    def heard(self, name: str, line: str) -> None:
        """What a set has said, which begins with an empty line."""
        with self._lock:
            now = self._clock()
            running = self._running.get(name) or Running(now)
            if found := _LINE.match(line.strip()):
                seconds = None if found[2] is None else float(found[2]) * (60 if found[3] == "min" else 1)
                ends = running.ends if seconds is None else now + seconds
                running = running._replace(text=found[1], ends=ends)
            self._running[name] = running

    def ended(self, name: str, failed: bool) -> None:
        """A set is done; what has failed tells nothing of how long others take."""
        with self._lock:
            self._done += 1
            running = self._running.pop(name, None)
            if running is not None and not failed:
                self._took.append(self._clock() - running.began)

    def left(self) -> float | None:
        """Seconds that the rest may take; None while nobody knows, and where none is left."""
        with self._lock:
            now, running = self._clock(), list(self._running.values())
        waiting = self._total - self._done - len(running)
        known = self._took or [r.ends - r.began for r in running if r.ends is not None]
        if not known or waiting + len(running) == 0:
            return None
        usual = sum(known) / len(known)
        ends = [r.began + usual if r.ends is None else r.ends for r in running]
        each = [max(end - now, _ENDS * usual) for end in ends]
        at_once = min(self._processes, len(running) + waiting)
        return max((sum(each) + waiting * usual) / at_once, *each, 0.0)

    def words(self) -> str:
        """How many sets are done, how long the others may take, and what those are at that run."""
        left = self.left()
        with self._lock:
            text = f"diagnosing: sets: {self._done} of {self._total}"
            at = [f"{name}: {r.text}" if r.text else name for name, r in self._running.items()]
        text += "" if left is None else f", some {duration(left)} left"
        return text + (f", now {'; '.join(at)}" if at else "")
