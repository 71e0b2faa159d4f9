"""What every command that measures recordings says of them alike, where no number can be right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.photon_transfer import channel_lines
from cannoise_jax.physics.transfer.rails import STILL, contradicted_black, cut_off, lit_of


class Faults(NamedTuple):
    """Where recordings of one ISO setting bear no measurement, or contradict what is stated of them: a line
    each, empty where they do not. cut_off: of read noise and black level. moves: of the gain. black: the
    stated black level is none of the darks'."""

    cut_off: str = ""
    moves: str = ""
    black: str = ""


def faults(statistics: Sequence[FrameStatistics]) -> Faults:
    """The faults of the recordings of one ISO setting."""
    return Faults(cut_off(statistics), _moves(statistics), contradicted_black(statistics))


def _moves(statistics: Sequence[FrameStatistics]) -> str:
    if not any(s.recording.kind == "scene" for s in lit_of(statistics)):
        return ""
    reasons = (line.record for line in channel_lines(statistics) if isinstance(line, NotMeasurable))
    return next((reason for reason in reasons if reason.endswith(STILL)), "")
