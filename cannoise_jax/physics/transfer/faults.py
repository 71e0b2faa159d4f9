"""What every command that measures recordings says of them alike, where numbers cannot be right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.fit import Line
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quantities import SET_ASIDE, set_aside
from cannoise_jax.physics.transfer.rails import STILL, contradicted_black, cut_off
from cannoise_jax.physics.transfer.several_gains import several_gains


class Faults(NamedTuple):
    """Where recordings of one ISO setting bear no measurement, or contradict what is stated of them: a line
    each, empty where they do not.

    cut_off: darks show neither read noise nor black level. unlike: flats and darks are of two gains. moves:
    scenes tell no gain. doubted: flats tell one that may be wrong. black: the stated black level is none of
    the darks'.
    """

    cut_off: str = ""
    unlike: str = ""
    moves: str = ""
    doubted: str = ""
    black: str = ""


def faults(statistics: Sequence[FrameStatistics], lines: Sequence[Line | NotMeasurable] = ()) -> Faults:
    """The faults of the recordings of one ISO setting. lines: of photon transfer, by channel; without them,
    as where a table states them, nothing is said of the gain."""
    reasons = (line.record for line in lines if isinstance(line, NotMeasurable))
    moves = next((reason for reason in reasons if reason.endswith(STILL)), "")
    drawn = [line for line in lines if isinstance(line, Line)]
    worst = max(drawn, key=lambda line: line.dropped, default=None)
    doubted = set_aside(worst) if worst is not None and worst.dropped > SET_ASIDE else ""
    return Faults(
        cut_off(statistics), several_gains(statistics), moves, doubted, contradicted_black(statistics)
    )
