"""How far a diagnosis is: what it is at, and how long the rest may take.

How long the search takes depends on what there is to find. The stages after it take times that go with the
number of findings, in proportions that hold from one camera to the next: so the rest is told once the search
has ended, from the time that it took.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable
from typing import NamedTuple

from cannoise_jax.commands.entry import duration
from cannoise_jax.commands.pulse import current


class Cost(NamedTuple):
    """What a stage takes beside the others: for itself, and for every finding. begins: with what its lines
    begin. counted: whether how many pieces are done of it tells how far it is."""

    begins: tuple[str, ...]
    alone: float
    finding: float
    counted: bool = False


SEARCH = Cost(("",), 10.0, 3.0)
STAGES = (
    SEARCH,
    Cost(("prove: on", "prove: likelihood"), 4.0, 1.2, True),
    Cost(("prove: strength",), 3.0, 1.1, True),
    Cost(("gate",), 25.0, 0.2),
    Cost(("adequacy",), 8.0, 3.0, True),
    Cost(("remainder",), 30.0, 1.5),
    Cost(("check", "compare"), 22.0, 1.0),
)
"""In order; measured on five cameras with 3 to 20 findings."""
_COUNT = re.compile(r"(\d+) of (\d+)\b")
_STEP = re.compile(r"step (\d+)\b")
_OVERDUE = 0.3
"""Of the time that a stage has taken, what it takes more at least."""
_FEWEST = 3
"""Pieces done from which the time for those that are left is told."""


class Stages:
    """Called with a line for each thing that a run is at, which it says with the time since `started`. Of
    what is counted it says the first; the others are there for whoever waits (see `pulse`)."""

    def __init__(self, started: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._started, self._clock = started, clock
        self._text, self._kind, self._at = "reading the recordings", "", 0
        self._began = self._entered = clock()
        self._findings, self._most, self._pieces = 0, 0, (0, 0)
        current().at(self.words)

    def __call__(self, text: str) -> None:
        now, kind = self._clock(), _COUNT.sub("", text)
        counted, step = _COUNT.search(text), _STEP.match(text)
        if step:
            self._findings = int(step[1])
            self._most = max(self._most, self._findings)
        elif text.startswith("given up"):
            self._findings -= 1
        at = max(n for n, stage in enumerate(STAGES) if text.startswith(stage.begins))
        entered = at > self._at  # else it is said within a later one
        if entered:
            self._at, self._entered = at, now
        if kind != self._kind:
            self._pieces = 0, 0
        if counted:
            self._pieces = int(counted[1]), int(counted[2])
        self._text, same, self._kind = text, kind == self._kind, kind
        if counted and same:
            return
        left = f"; {_some(seconds)}" if entered and (seconds := self.left()) is not None else ""
        print(f"[{now - self._started:6.1f} s] {text}{left}", file=sys.stderr, flush=True)

    def words(self) -> str:
        """What the run is at, and how long the rest may take."""
        left = self.left()
        return f"still {self._text}" if left is None else f"still {self._text}; {_some(left)}"

    def left(self) -> float | None:
        """Seconds that the rest may take; None while nobody knows."""
        if not self._at:
            return None
        costs = [stage.alone + stage.finding * self._findings for stage in STAGES]
        costs[0] = SEARCH.alone + SEARCH.finding * self._most
        unit = (self._entered - self._began) / sum(costs[: self._at])
        spent, (done, pieces) = self._clock() - self._entered, self._pieces
        if STAGES[self._at].counted and _FEWEST <= done < pieces:
            own = spent / done * (pieces - done)
        else:
            # What has taken longer than expected will not end at once.
            own = max(unit * costs[self._at] - spent, _OVERDUE * spent)
        return own + unit * sum(costs[self._at + 1 :])


def _some(seconds: float) -> str:
    return f"some {duration(seconds)} left"
