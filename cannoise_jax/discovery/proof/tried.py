"""A candidate for the simulator that is handed back, and what it changed."""

from __future__ import annotations

from typing import NamedTuple

from cannoise_jax.discovery.proof.twosample import Area

LEAST_GAIN = 2e-4
"""Nats a pixel that the composite score of two draws of one model differs by chance."""


class Gain(NamedTuple):
    """A change with its 90 % interval."""

    value: float
    low: float
    high: float


class Tried(NamedTuple):
    """One candidate beside the simulator before it. what: `findings`, `findings that gain`, `confirmed
    findings`, `findings one by one`, `findings with a name` or `remainder`; steps: findings in it; score: of
    the composite score, nats a pixel, area: of what the two-sample area is above 0.5 (None: not measured, or
    told from chance neither before nor after); entered: whether it is in the simulator that is handed back;
    least: change of the score that counts as none."""

    what: str
    steps: int
    score: Gain | None
    area: Area | None
    entered: bool
    least: float = LEAST_GAIN

    @property
    def better(self) -> bool:
        """Whether one measure improved beyond its interval, and none became worse."""
        return not self.worse and (self.scored or self.nearer)

    @property
    def scored(self) -> bool:
        """Whether the composite score improved beyond its interval."""
        return self.score is not None and self.score.low > self.least

    @property
    def nearer(self) -> bool:
        """Whether the two-sample area improved beyond its interval."""
        return self.area is not None and self.area.high < 0

    @property
    def worse(self) -> bool:
        """Whether a measure became worse beyond its interval, which few frames tell too narrow."""
        score = (
            0 if self.score is None else int(self.score.low > self.least) - int(self.score.high < -self.least)
        )
        area = 0 if self.area is None else int(self.area.high < 0) - int(self.area.sure > 0)
        return min(score, area) < 0
