"""What signatures are given, and what they give back: findings, additions to a model, predictions, series."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism, Scaling
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.score import Score

Many = tuple[Fields, ...]


class Predicted(NamedTuple):
    """What one finding predicts for new frames.

    scaling: 'additive' DN, 'signal' fractions of it, 'exposure' DN per second, 'codes' DN of the recording.
    pattern, doubt: estimate of a frozen pattern and the variance it leaves open, `[H, W]` or broadcasting.
    row, column, frame: standard deviation of random offsets, of that scaling; exponent: of the spectrum of
    the row offsets, 0: white.
    """

    scaling: str
    pattern: np.ndarray | None = None
    doubt: np.ndarray | float = 0.0
    row: float = 0.0
    column: float = 0.0
    frame: float = 0.0
    exponent: float = 0.0

    @property
    def left_out(self) -> Predicted | None:
        """What a model without the finding has in its place: of a pattern the noise that its doubt is, the
        same in all pixels. Where noise is stronger than the model has it, more of it is a gain by itself."""
        if self.pattern is None:
            return None
        return Predicted(self.scaling, np.zeros((1, 1)), float(np.mean(self.doubt)))


class Series(NamedTuple):
    """One recording as the series that a name says is Gaussian noise, redrawn in every frame.

    score: `[n, k]`, of every contrast between frames, and information `[k]`: places along the series, their
    noise has this variance. exponent: of the power law that its spectrum follows, 0: white, and nothing else.
    level: whether the noise of the model is that of the places; else it is what the series shows.
    """

    score: np.ndarray
    information: np.ndarray
    exponent: float
    level: bool


class Found(NamedTuple):
    """A finding as it is handed to a camera model.

    mechanism: as it was named. fields: before it was taken out. pattern: `Signature.pattern` of it. gain:
    DN/e-, read_dn: DN, of the baseline. seconds: longest exposure, unknown ones counted as 1 s; longest: the
    longest known one, 0: none. span: white minus black, DN.
    """

    mechanism: str
    score: Score
    fields: Many
    pattern: np.ndarray | None
    gain: float
    read_dn: float
    seconds: float
    longest: float
    span: float
    size: tuple[int, int]

    def by_exposure(self, parameter: str) -> Scaling:
        """Of a strength of this name: growing with the exposure from the longest one and, where it is in DN,
        with the gain."""
        return Scaling(
            gain=1.0 if parameter.endswith("_dn") else 0.0,
            exposure=1.0,
            reference_exposure_s=self.longest or 1.0,
        )


class Addition(NamedTuple):
    """What a finding adds to a camera model: strengths of a mechanism, measured maps, another place or
    scaling than its own where given. black_shift: DN per channel taken from the black level; fitted_black:
    whether the model takes the black level that was fitted. bare: nothing but these. record: of a mechanism
    from outside. beside: values that hold instead where a mechanism of this id is added too. into: where one
    of this id is added too, what that one becomes with this in it, or None where it cannot hold it."""

    values: dict[str, float] = {}
    maps: dict[str, Any] = {}
    scaling: Scaling | None = None
    point: Point | None = None
    black_shift: np.ndarray | None = None
    fitted_black: bool = False
    bare: bool = False
    record: Mechanism | None = None
    beside: Mapping[str, dict[str, float]] = MappingProxyType({})
    into: Mapping[str, Callable[[Addition], Addition | None]] = MappingProxyType({})


class Asked(NamedTuple):
    """What a run asks of the weakest effect that it would find: the fields of each look, the log p that it
    rejects at, what share of the error rate the last look may spend, and the weight of the test."""

    looks: tuple[Many, ...]
    log_p: float
    share: float
    weight: float

    @property
    def own_log_p(self) -> float:
        """log p at which the test itself rejects in the last look."""
        return float(self.log_p + np.log(self.weight * self.share))
