"""How far a diagnosis is: what it is at, and how long the rest may take.

All stages look at the same frames with the same statistics. So what one pass of them over the frames takes,
the first of which is timed, tells what the stages take: each so many passes and so many more for every
finding, in proportions that hold from one camera to the next. What stages have taken corrects it. A stage
that goes on far beyond its time tells nothing of when it ends: then no time is said.
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
    """What a stage takes, in passes over the frames: for itself, and for every finding. begins: with what its
    lines begin. counted: whether how many pieces are done of it tells how far it is."""

    begins: tuple[str, ...]
    alone: float
    finding: float
    counted: bool = False


STAGES = (
    Cost(("",), 0.0, 0.35),
    Cost(("prove: on", "prove: likelihood"), 1.0, 0.0),
    Cost(("prove: strength",), 0.7, 0.1),
    Cost(("gate",), 2.0, 0.1),
    Cost(("adequacy",), 0.5, 0.35, True),
    Cost(("remainder",), 2.0, 0.2),
    Cost(("check", "compare"), 1.5, 0.05),
)
"""In order, the search first; about the middle of 81 diagnoses, drawn and real, of 1 to 25 findings."""
_PASS, _ALL_LOOK = "locate:", "none held back"
"""With what the line of the first pass begins; what it says where all frames look: then there are none to
prove on, and the last stage follows the search."""
_USUAL, _MORE = 8, 4
"""Findings that a search is expected to end with at least, and beyond those it has, while it finds more."""
_COUNT = re.compile(r"(\d+) of (\d+)\b")
_STEP = re.compile(r"step (\d+)\b")
_OWN_TIME = re.compile(r", some \d+ s more$")
"""What a comparison says of its own end, which is not that of the run."""
_ENDS = 0.1
"""Of the time of a stage, what it is expected to take still when that is over."""
_FEWEST = 3
"""Pieces done from which the time for those that are left is told."""


class Stages:
    """Called with a line for each thing that a run is at, which it says with the time since `started`. Of
    what is counted it says the first; the others are there for whoever waits (see `pulse`)."""

    def __init__(self, started: float, clock: Callable[[], float] = time.monotonic) -> None:
        self._started, self._clock = started, clock
        self._text, self._kind, self._at = "reading the recordings", "", 0
        self._entered = clock()
        self._looking, self._pass = False, 0.0
        self._took, self._cost, self._next = 0.0, 0.0, 1
        self._findings, self._most, self._pieces = 0, 0, (0, 0)
        current().at(self.words)

    def __call__(self, text: str) -> None:
        now, text = self._clock(), _OWN_TIME.sub("", text)
        counted, kind = _COUNT.search(text), _COUNT.sub("", text)
        first = self._looking
        if first:  # the pass is over
            self._pass, self._looking = now - self._entered, False
        if text.startswith(_PASS):
            self._looking, self._next = True, len(STAGES) - 1 if _ALL_LOOK in text else 1
        at = max(n for n, stage in enumerate(STAGES) if text.startswith(stage.begins))
        entered = at > self._at  # else it is said within a later one
        if entered and self._at:
            self._took += now - self._entered
            self._cost += self._passes(STAGES[self._at])
        if entered or first or self._looking:
            self._entered = now
        self._at = max(at, self._at)
        if step := _STEP.match(text):
            self._findings = int(step[1])
            self._most = max(self._most, self._findings)
        elif text.startswith("given up"):
            self._findings -= 1
        same, self._text, self._kind = kind == self._kind, text, kind
        if counted:
            self._pieces = int(counted[1]), int(counted[2])
        elif not same:
            self._pieces = 0, 0
        if counted and same:
            return
        left = f"; {_some(seconds)}" if (entered or first) and (seconds := self.left()) is not None else ""
        # In one piece: comparisons of several recordings are said by threads of their own.
        print(f"[{now - self._started:6.1f} s] {text}{left}\n", end="", file=sys.stderr, flush=True)

    def words(self) -> str:
        """What the run is at, and how long the rest may take."""
        left = self.left()
        return f"still {self._text}" if left is None else f"still {self._text}; {_some(left)}"

    def left(self) -> float | None:
        """Seconds that the rest may take; None while nobody knows."""
        if not self._pass:
            return None
        unit = (self._pass + self._took) / (1 + self._cost)
        stage, spent, (number, pieces) = STAGES[self._at], self._clock() - self._entered, self._pieces
        own = unit * self._passes(stage)
        rest = unit * sum(self._passes(s) for s in STAGES[max(self._at + 1, self._next) :])
        if stage.counted and _FEWEST < number <= pieces:  # the last of them has just begun
            return spent / (number - 1) * (pieces - number + 1) + rest
        if spent - own > max(own, rest) / 2:
            return None
        return max(own - spent, _ENDS * own) + rest

    def _passes(self, stage: Cost) -> float:
        finds = not self._at and (self._looking or _STEP.match(self._text))
        found = self._findings if stage is not STAGES[0] else self._most  # to give up takes its time, too
        findings = max(found + _MORE, _USUAL) if finds else found
        return stage.alone + stage.finding * findings


def _some(seconds: float) -> str:
    return f"some {duration(seconds)} left"
