"""How photon transfer measures one mechanism, and when what it measures enters a camera model."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import Estimate, Estimates
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.vocabulary import Term

Statistics = Sequence[FrameStatistics]
Measured = Mapping[str, Estimate]
Law = Literal["tails", "spread", "telegraph"]
Each = Callable[[Sequence[Any]], Iterable[Any]]
"""How to go through what takes its time, so that a caller can say how far it is."""
BY_CHANCE = 3e-4
"""Chance of a strength at least as large without the effect, below which a mechanism enters a model: of the
50 that are asked for, one camera in 70 gets one that it does not have."""


class Placed(NamedTuple):
    """What was measured, at another place in the grammar than the usual one, and why there."""

    estimates: dict[str, Estimate]
    because: str
    point: Point


@dataclass(frozen=True)
class Estimator:
    """The parameters of a mechanism from recordings, and what its verdict depends on.

    measure(statistics, baseline) -> estimates by parameter, the strength first, or `NotMeasurable`. It picks
      the recordings that it needs; strengths hold at the setting of those (exposure-driven ones per second).
    least: least strength that matters, in its unit; None: 2 % of a pixel's noise in the dark. neutral: the
      strength at which nothing differs from the baseline. exact: a value of the code lattice, without error.
    searched: the strongest of many frequencies. smooths(strength, statistics) -> what it has left of
      the noise that the baseline is measured on, as a share of the variance; None: all.
    in_baseline: it is the baseline itself, and not asked for. reported: why it never enters.
    white: it takes noise that is not what it looks for to be alike in no two pixels (`smoothed`).
    gives_way_to: ids beside which it does not enter. without(statistics, baseline, estimates) -> the
      recordings less what it adds to them. frozen: it is of what frames have in common, and measured on what
      those leave. against(estimates, statistics) -> why not to believe it,
      or nothing.
    law: what it makes of the values of one pixel, for `estimators.loudness`. loud(dark, gain=DN/e-, **values)
      -> 1 at the pixels that it alone makes loud; spares(statistics, baseline, without=pixels) -> its
      estimates without those that another does, where they hold whatever the other laws are.
      placed(estimates, dark) -> its place, where that is not the usual one. beside(estimates, point, dark) ->
      whether a mechanism at that place makes what it sees. maps(parameters, seen) -> frozen maps of the unit
      that was recorded.
    corrects(baseline, statistics, estimates) -> the baseline that a model with it has. of_light: the strength
      is a share of the light as it was recorded. straight(statistics, baseline, estimates) -> by what factor
      such a share is larger of the light itself, where this bends the response.
    """

    measure: Callable[..., Estimates]
    least: float | None = None
    neutral: float = 0.0
    exact: bool = False
    searched: bool = False
    smooths: Callable[[Any, Statistics], Any] | None = None
    in_baseline: bool = False
    white: bool = False
    reported: str = ""
    gives_way_to: tuple[str, ...] = ()
    without: Callable[..., list[FrameStatistics]] | None = None
    frozen: bool = False
    against: Callable[[Measured, Statistics], str] | None = None
    law: Law | None = None
    loud: Callable[..., np.ndarray] | None = None
    spares: Callable[..., Estimates] | None = None
    placed: Callable[[Measured, FrameStatistics], Placed | None] | None = None
    beside: Callable[[Measured, Point, FrameStatistics], bool] | None = None
    maps: Callable[..., dict[str, np.ndarray]] | None = None
    corrects: Callable[[Baseline, Statistics, Measured], Baseline] | None = None
    of_light: bool = False
    straight: Callable[[Statistics, Baseline, Measured], float] | None = None

    def __call__(self, statistics: Statistics, baseline: Baseline) -> Estimates:
        """The estimates of `measure`."""
        return self.measure(statistics, baseline)


class Measurable(Protocol):
    """What `model` asks of a mechanism: an entry of `mechanisms`."""

    @property
    def term(self) -> Term: ...

    @property
    def record(self) -> Mechanism: ...

    @property
    def estimator(self) -> Estimator | None: ...
