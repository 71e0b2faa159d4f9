"""How loud rows or columns are over time, beside the noise of the pixels in them."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy import stats

from cannoise_jax.physics.robust import median

Line = Literal["row", "column"]
_PARTS = 8
"""Pieces of a line, whose scatter says how well its noise is known: whatever the pixels' own noise is, and
however neighbours are alike."""
_FEWEST = 8
"""Pixels of a piece, and lines beyond the smooth terms, that say anything."""
_SMOOTH = 6
"""Waves over all lines that are no part of it: dark charge, and light, may make noise that grows smoothly."""
_SMOOTHER = 3.0
"""Mean square of those waves, over that of independent lines, from which on they are noise that is smooth."""
_CAPPED = 1e-3
"""Chance of a pixel whose sum of squares counts as no more than this: those that blink are no part of it."""
_LOUDEST = 3.0
"""Noise power of a line over that of most, up to which it is told in full."""
_PLAIN = 2.0
"""Standard errors from which on lines are taken to be louder in some frames than in others."""


LEAST_SHARE = 0.1
"""Of the variance that is taken to be read noise at least: rounding and dark charge are known but roughly."""


class Squares(NamedTuple):
    """Sums of squares of every pixel over time, in units of the noise, what lines share in each frame taken
    out, and their degrees of freedom."""

    squares: Float[np.ndarray, "h w"]
    freedom: int


class Loudness(NamedTuple):
    """Logarithm of the noise power of every line beyond what is smooth over the lines, and of its error the
    variance. ratio: what lines differ by over what pieces of them do, mean squares. known: lines of pixels
    enough; freedom: of the lines, once what is smooth is taken out."""

    logs: Float[np.ndarray, "k"]
    error: float
    ratio: float
    known: Bool[np.ndarray, "k"]
    freedom: int
    pieces: int

    @property
    def variance(self) -> float:
        """Of the true logarithms."""
        return max(float(np.sum(self.logs**2)) / self.freedom - self.error, 0.0)

    @property
    def doubt(self) -> float:
        """Standard error of that variance."""
        return (self.variance + self.error) * float(np.sqrt(2 / self.freedom))

    @property
    def chance(self) -> float:
        """With which lines that are equally loud differ as much, natural logarithm."""
        tail = float(stats.f.sf(self.ratio, self.freedom, self.freedom * (self.pieces - 1)))
        if tail > 1e-200:
            return float(np.log(tail))
        return float(stats.norm.logsf((self.ratio - 1) * np.sqrt(self.freedom / 2)))


def within_lines(
    values: Float[np.ndarray, "n h w"], usable: Bool[np.ndarray, "h w"], axis: Line
) -> np.ndarray:
    """Less what rows and columns share, to which no pixel adds more than three standard deviations: one far
    out would make its whole line louder. Twice, for lines that share more than that."""
    for along in (1, 2, 1, 2) if axis == "row" else (2, 1, 2, 1):
        counts = np.maximum(usable.sum(along - 1, keepdims=True), 1)
        values = (values - np.clip(values, -3, 3).sum(along, keepdims=True) / counts) * usable
    return values


def _bounded(power: np.ndarray, usable: np.ndarray, freedom: int) -> np.ndarray:
    """The powers `[k, n]`, none more than `_LOUDEST` times what chance gives once in a thousand: one
    limit for all lines, since one of their own would be of what their pixels share."""
    law = stats.chi2(freedom, scale=1 / freedom)
    typical = float(median(power[usable])) / float(law.median())
    return np.minimum(power, _LOUDEST * float(law.isf(_CAPPED)) * typical)


class _Parted(NamedTuple):
    """Mean squares of what the noise power of lines differs by beyond what is smooth over them, and of what
    pieces of lines differ by beside, logarithms, each of a line."""

    of_lines: float
    of_pieces: float


def _parted(logs: Float[np.ndarray, "k s"], terms: np.ndarray) -> _Parted:
    """Two-way analysis of variance of pieces of lines."""
    lines, pieces = logs.shape
    means = logs.mean(1)
    rough = _beyond(means, terms)
    apart = logs - means[:, None] - logs.mean(0) + logs.mean()
    return _Parted(
        float(np.sum(rough**2)) / (lines - terms.shape[1]),
        float(np.sum(apart**2)) / ((lines - 1) * (pieces - 1)) / pieces,
    )


def loudness(
    whole: Squares, halves: tuple[Squares, Squares], usable: Bool[np.ndarray, "h w"], axis: Line
) -> Loudness | None:
    """How loud the lines are; None where too little tells. halves: of one half of the frames and of the
    other; what is louder in some frames alone is no noise of a line that stays."""
    usable = usable if axis == "row" else usable.T
    pieces = min(_PARTS, usable.shape[1] // (2 * _FEWEST))
    if pieces < 2 or whole.freedom < 2:
        return None
    starts = np.linspace(0, usable.shape[1], pieces + 1).astype(int)[:-1]
    count = np.add.reduceat(usable.astype(float), starts, axis=1)
    known = count.min(1) >= _FEWEST
    terms = _smooth_terms(np.flatnonzero(known), len(known))
    spare = int(known.sum()) - terms.shape[1]
    if spare < _FEWEST:
        return None

    def powers(of: Squares) -> np.ndarray:
        return (of.squares if axis == "row" else of.squares.T) / of.freedom

    def logs(of: Squares) -> np.ndarray:
        power = _bounded(powers(of), usable, of.freedom)
        mean = np.add.reduceat(power * usable, starts, axis=1)[known] / count[known]
        return np.log(np.maximum(mean, 1e-6))

    found, moving = _parted(logs(whole), terms), 0.0
    if all(h.freedom for h in halves):
        turns = _parted((logs(halves[0]) - logs(halves[1])) / 2, terms)
        beyond = turns.of_lines - turns.of_pieces
        moving = beyond if beyond > _PLAIN * turns.of_pieces * np.sqrt(2 / spare) else 0.0
    error, rough = max(found.of_pieces + moving, 1e-12), np.zeros(len(known))
    own = _own_powers(powers(whole), usable, whole.freedom)
    logs_of = np.log(np.maximum(own[known], 1e-6))
    rough[known] = _beyond(logs_of, terms)
    white = float(np.sum(rough**2)) / spare
    smooth = _beyond(logs_of, terms[:, [0, -1]]) - rough[known]
    # As much as lines that have nothing to do with each other give is theirs.
    if np.sum(smooth**2) < _SMOOTHER * white * _SMOOTH:
        rough[known] += smooth
    return Loudness(rough, error, found.of_lines / error, known, spare, pieces)


def _own_powers(power: np.ndarray, usable: np.ndarray, freedom: int) -> Float[np.ndarray, "k"]:
    """Mean power of every line, to which no pixel adds more than chance gives once in a thousand beside the
    others of its line: however loud that is."""
    law = stats.chi2(freedom, scale=1 / freedom)
    most = float(law.isf(_CAPPED))
    left = float(stats.chi2.cdf(freedom * most, freedom + 2)) + most * _CAPPED
    count = np.maximum(usable.sum(1), 1)
    scale = np.sum(power * usable, 1) / count
    for _ in range(8):
        scale = np.sum(np.minimum(power, most * scale[:, None]) * usable, 1) / count / left
    return scale


def _beyond(values: Float[np.ndarray, "k"], terms: Float[np.ndarray, "k m"]) -> Float[np.ndarray, "k"]:
    return values - terms @ np.linalg.lstsq(terms, values, rcond=None)[0]


def _smooth_terms(places: np.ndarray, lines: int) -> Float[np.ndarray, "n k"]:
    """Waves over the lines, and every second one: the baseline has a noise of every mosaic site."""
    waves = np.cos(np.pi * np.outer((places + 0.5) / lines, np.arange(_SMOOTH + 1)))
    return np.column_stack([waves, (-1.0) ** places])
