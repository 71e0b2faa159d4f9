"""What a signature is: how one mechanism shows in recordings, as a record of pure functions.

Whoever holds a signature never asks its name: where it sits in the grammar, what it looks at, what it takes
out, what it predicts for other frames and what it adds to a camera model are fields of the record. A field
that has nothing to say says so by a constant (`COVERS_NOTHING`, `NO_LAW`, `NO_PATTERN`, `NOT_SIMULATED`,
`NO_PLACE`, `NO_CLOSED_FORM`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy import stats

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.places import PlaceName, place
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.handed import Addition, Asked, Found, Many, Predicted, Series
from cannoise_jax.signatures.least import Law, Seen
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.score import Score

Scales = Literal["additive", "codes", "signal", "signal squared", "exposure", "all noise", "scene", "none"]


@dataclass(frozen=True)
class Axes:
    """Where an effect enters, what it varies over (a place of `physics.core.places`), how it behaves in time,
    how its strength scales and the law of one number of it: one spelling for report, card and wording.
    Raises ValueError for a place that there is not."""

    enters: str
    varies_over: PlaceName
    time: str
    scales: Scales
    law: str

    def __post_init__(self):
        place(self.varies_over)

    @property
    def in_bands(self) -> bool:
        """Whether chance in it is independent from one band of rows to the next."""
        over = place(self.varies_over)
        if self.time == "modulated":
            return False
        return over.within_rows and not (over.whole and self.time == "redrawn")

    @property
    def white_lines(self) -> bool:
        """Whether it is noise of whole rows or columns, each by itself and anew in every frame."""
        lines = self.varies_over in ("row", "column")
        return lines and (self.time, self.scales, self.law) == ("redrawn", "additive", "white")


CONTRASTS = frozenset({"contrasts", "usable", "sigma", "louder", "level"})
"""What a statistic of differences between frames reads of a field."""
ONE_FACTOR = "one factor"
"""Law of a pattern that all pixels have times one number a frame."""
STATIC = frozenset({"static", "answers", "usable", "sigma"})
"""What a statistic of what stays reads of a field."""
FILES = frozenset[str]()
"""Of statistics of what the files hold, whatever was taken out: codes, levels, statements."""


OFFSETS = Point("readout", "signal", "pixel", "frozen")
"""An offset map; a sparse frozen pattern is one with zeros."""
BLINKING = Point("readout", "signal", "pixel", "telegraph")
"""Noisy pixels blink about their level."""


COVERS_NOTHING: tuple[str, ...] = ()
"""No other signature is doubtful beside it: of what they look at it takes out all that is its own."""


def same_unit(score: Score, mechanism: str) -> Score:
    """Quoted as it is: the amplitude is in the unit of its one mechanism."""
    return score


def NO_SERIES(fields: Fields, score: Score) -> None:
    """It names no noise of lines or along the scan."""


Look = Callable[[Many], Score | None]
Limit = Callable[[Asked, Score, str], float]


@dataclass(frozen=True, kw_only=True, eq=False)
class Signature:
    """How one mechanism shows.

    name: unique. mechanism: id of the entry that it is of, None: of none. axes: its place in words. kin:
      shared by signatures of the same thing at another time or scaling. reads: attributes of `Fields` that
      the score depends on; a score stands as long as none of them changed.
    score(fields) -> Score, None where it cannot be tested; absorb(fields, score) -> fields with the effect
      taken out. covers: signatures that cannot be trusted once this one is in the model; covered_by: those
      that cover this one though they do not know it, as one of an entry from outside; hides(score): more of
      them, for an effect of that size; before(score): those that it must be judged before; found_in:
      those that it shows beside only once they are known, and in which it is counted until it is: found after
      one of them it is taken out before it, and they are found anew. after: the one that must be found before
      this is looked for: of the same kind, so that without it both would be of one thing. rare: whether p is
      1 unless something is far off.
    readings(score, scores) -> mechanisms and the evidence for each, the first may stay unnamed; None: its
      own. reads_as: those that it may mean beside its own. lifted_by: signatures whose evidence counts for
      this one's where both reject.
    predict(fields, score) -> what it predicts for new frames. pattern(fields, score, rng) -> a draw of the
      frozen map, given what the frames say. simulate(found) -> what a named finding adds to a camera model;
      place(found) -> what one without a name adds, at its place in the grammar.
    again(fields, score) -> score of the same finding on other frames; None: its score there.
      strength(score, looked, held) -> the score with the strength that frames held back tell beside those
      that looked; None: that of the score there.
    detectable(asked, score, mechanism) -> amplitude found with probability one half; decides: whether that
      holds whatever other signatures of the mechanism see. least(sets) -> law of the least amplitude that
      all frames can show.
    quoted(score, mechanism) -> the score in that mechanism's unit, of its own where it reads as several.
      at(score, amplitude) -> the score of the same finding at another strength. moves_frames(score, size) ->
      how far, DN, it moves the means of frames; of_frames: whether it is what the means of frames move by,
      DN, which may be a part of such. drawn_once: whether it is one draw of a random pattern that stays,
      which all frames tell better together. control: whether some of it is added to draws for the control of
      the two-sample test.
    says(entry) -> the first words of its sentence and their interval. kind(score) -> of what has no name,
      what it is in words, where the law of its axes says too little. single_pixels: whether it is about
      pixels that others set aside. restates: what it corrects of what was stated. of_gain: whether variance
      tells of it and the gain the product alone, so that the one is as wrong as the other. counted: whether
      its electrons were counted, so that they stay where the gain is found to be another one. approximate:
      whether what it takes out is close to the effect, not all of it, so that what has no name sees the rest.
      form_free: whether its form differs from camera to camera in ways that the model does not follow, so
      that much of what it bears on may be left.
    series(field, score) -> one recording as the Gaussian noise of lines or along the scan that it names;
      None: it names none, or none there.
    off(fields, score, rng) -> by number of the recording, what it says that the mean is off the reference by,
      DN: of what is no part of a camera model, to be held against frames; None: it is part of one, or moves
      no mean. map_of: place and scaling of the map of independent values that it is, of variance
      `score.payload`, which is told together with other such maps. speaks_for: kinds of recordings in which
      all that stays and differs is then of its part. beyond: whether its first parameter is, with its sign,
      what recordings have beyond the simulator that is judged, and not all that they have.

    Raises ValueError where it reads as several mechanisms and is quoted in the unit of none.
    """

    name: str
    axes: Axes
    reads: frozenset[str]
    score: Look
    absorb: Callable[[Many, Score], Many]
    covers: tuple[str, ...]
    predict: Callable[[Many, Score], Predicted | None]
    pattern: Callable[[Many, Score, np.random.Generator], np.ndarray | None]
    simulate: Callable[[Found], Addition | None]
    place: Callable[[Found], Addition | None]
    detectable: Limit
    least: Callable[[tuple[Seen, ...]], Law | None]
    mechanism: str | None = None
    kin: str = ""
    covered_by: tuple[str, ...] = ()
    hides: Callable[[Score], tuple[str, ...]] = lambda score: ()
    before: Callable[[Score], tuple[str, ...]] = lambda score: ()
    found_in: tuple[str, ...] = ()
    after: str = ""
    rare: bool = False
    readings: Callable[[Score, Mapping[str, Score]], tuple[tuple[str | None, float], ...]] | None = None
    reads_as: tuple[str, ...] = ()
    lifted_by: tuple[str, ...] = ()
    again: Callable[[Many, Score], Score | None] | None = None
    strength: Callable[[Score, Many, Many], Score | None] | None = None
    decides: bool = False
    quoted: Callable[[Score, str], Score] = same_unit
    at: Callable[[Score, float], Score] = field(
        default=lambda score, amplitude: score.replace(amplitude=amplitude)
    )
    moves_frames: Callable[[Score, tuple[int, int]], float] | None = None
    of_frames: bool = False
    drawn_once: bool = False
    control: bool = False
    says: Callable[[dict[str, Any]], tuple[str, tuple[float, float]]] | None = None
    kind: Callable[[Score], str] | None = None
    single_pixels: bool = False
    restates: Literal["gain", "read", None] = None
    of_gain: bool = False
    counted: bool = False
    series: Callable[[Fields, Score], Series | None] = NO_SERIES
    off: Callable[[Many, Score, np.random.Generator], dict[int, np.ndarray]] | None = None
    speaks_for: frozenset[str] = frozenset()
    map_of: tuple[str, Scales] | None = None
    approximate: bool = False
    form_free: bool = False
    beyond: bool = False

    def __post_init__(self):
        if self.reads_as and self.quoted is same_unit:
            raise ValueError(
                f"{self.name}: it may mean {', '.join(self.reads_as)}: say in `quoted` how strong"
            )

    @property
    def weight(self) -> float:
        """Share of the common error rate that it takes, against 1 of most."""
        return SHARED.rare if self.rare else 1.0

    def precedes(self, other: Signature) -> bool:
        """Whether it is taken out before a map that was found earlier: what pixels share in each frame is in
        their mean by less, and independent from recording to recording only until a map is taken out of all
        of them, and is in the noise that a map is told by; what a map of pixels leaves of lines is known
        exactly, but not what lines leave of a map."""
        if other.map_of is None:
            return False
        if self.axes.time == "redrawn":
            return self.axes.varies_over != "pixel"
        return self.map_of is not None and self.map_of[0] == "pixel" and other.map_of[0] != "pixel"

    @property
    def frozen(self) -> bool:
        """Whether what it finds stays from frame to frame."""
        return self.axes.time == "frozen"

    def read_as(self, score: Score, scores: Mapping[str, Score]) -> tuple[tuple[str | None, float], ...]:
        """Mechanisms that a score may mean, and the evidence for each in nats."""
        return self.readings(score, scores) if self.readings else ((self.mechanism, score.evidence),)

    @property
    def redraws_frames(self) -> bool:
        """Whether it is one random number a frame: a few frames then say all that is known of its spread."""
        one = self.axes.varies_over == "frame" or self.axes.law == ONE_FACTOR
        return (one and self.axes.time == "redrawn") or self.axes.time == "modulated"

    def score_again(self, fields: Many, found: Score) -> Score | None:
        """The score of a finding on other frames."""
        return self.again(fields, found) if self.again else self.score(fields)

    def refitted(self, fields: Many, found: Score) -> Score | None:
        """The score of a finding in the same frames when other findings are in the model. Where something
        else of its kind is stronger then, as rows that wander are than a wave, that of the finding still."""
        score = self.score(fields)
        if score is None or self.again is None or score.same_spot(found):
            return score
        return self.again(fields, found)


def unchanged(fields: Many, score: Score) -> Many:
    """Nothing to take out of the fields: the signatures that see the effect are set aside instead."""
    return fields


def NO_LAW(fields: Many, score: Score) -> None:
    """It predicts no codes: the composite score serves."""


def NO_PATTERN(fields: Many, score: Score, rng: np.random.Generator) -> None:
    """Nothing of it stays that could be measured pixel by pixel."""


def NOT_SIMULATED(found: Found) -> None:
    """It is not the camera's, or no camera model has it."""


def NO_PLACE(found: Found) -> None:
    """The grammar has no place for it."""


def NO_CLOSED_FORM(sets: tuple[Seen, ...]) -> None:
    """No law of its least amplitude is known: its own score tells."""


def NO_STRENGTH(asked: Asked, score: Score, mechanism: str) -> float:
    """Its amplitude says where, not how strongly, it acts."""
    return float("nan")


def by_shift(quoted: Callable[[Score, str], Score] = same_unit) -> Limit:
    """The amplitude that shifts the score to the threshold."""

    def limit(asked: Asked, score: Score, mechanism: str) -> float:
        if not np.isfinite(score.shift):
            return float("inf")
        threshold = float(stats.norm.isf(np.exp(asked.log_p)))
        return quoted(score, mechanism).shift * threshold ** (1 / score.power)

    return limit


BY_SHIFT: Limit = by_shift()
