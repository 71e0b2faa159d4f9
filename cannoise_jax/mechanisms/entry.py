"""What the package knows of one mechanism, in one record; whoever holds it never asks its name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from cannoise_jax.physics.core.foreign import called, of_another_type
from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.recordings.recording import Kind
from cannoise_jax.signatures.generic import MapsOf
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import Signature
from cannoise_jax.vocabulary import Term


class Shot(NamedTuple):
    """One recording of a case. level: of an even light, normalised. scene: a smooth texture instead, given to
    the estimator as reference."""

    kind: Kind
    level: float = 0.0
    frames: int = 8
    exposure_s: float = 1.0
    scene: bool = False


@dataclass(frozen=True)
class Case:
    """Truth and recordings for one estimator. exact: a value of the code lattice, without an error."""

    truth: Mapping[str, float]
    shots: tuple[Shot, ...]
    exact: bool = False
    note: str = ""


# What a case records: darks alone, a flat beside them, darks and flats by exposure.
DARK = (Shot("dark"),)
FLAT = (Shot("dark"), Shot("flat", 0.3))
SERIES = tuple(Shot("dark", exposure_s=t) for t in (0.01, 3.0, 6.0, 10.0))
LONG = (Shot("dark", exposure_s=0.01), Shot("dark", exposure_s=10.0))
LADDER = (
    *(Shot("dark", exposure_s=seconds) for seconds in (0.2, 0.8)),
    *(Shot("flat", level, exposure_s=level) for level in (0.2, 0.4, 0.6, 0.8)),
)


@dataclass(frozen=True)
class Examples:
    """Values of the parameters at which a mechanism is shown and tested; what is not given is typical.

    curve: the statistic that tells it apart, of `curves.KINDS`; none of what is in no catalogue.
    shown: plain in a small picture. dim: the shot noise of a bright scene would hide it.
    strong: seen in a small simulation, and no special case of anything weaker.
    cases: where the intervals of its estimator are checked.
    """

    curve: str = ""
    shown: Mapping[str, float] = field(default_factory=dict)
    dim: bool = False
    strong: Mapping[str, float] = field(default_factory=dict)
    cases: tuple[Case, ...] = ()


def nothing_looks(recorded: Recorded) -> tuple[Signature, ...]:
    """No signature, whatever was recorded."""
    return ()


@dataclass(frozen=True)
class Entry:
    """One mechanism: its name and what its amplitude means, its physics, what to record to see it, how it is
    measured, examples, and the signatures that look for it in recordings.

    signatures(recorded) -> those that the recordings can be searched for. pattern(recorded, values) -> its
    maps, where its frozen pattern is found by its sampler: recorded is what it adds where its strength is
    `values`, `[H, W]` in the unit that it acts on (e- or DN; a share where it multiplies). Raises ValueError
    where the term and the record have different names.
    """

    term: Term
    record: Mechanism
    needs: str
    estimator: Estimator | None = None
    examples: Examples = field(default_factory=Examples)
    signatures: Callable[[Recorded], tuple[Signature, ...]] = nothing_looks
    pattern: MapsOf | None = None

    def __post_init__(self):
        if self.term.id != self.record.id:
            raise ValueError(f"{self.term.id}: its record is that of {self.record.id}: give both one name")

    def looks(self, recorded: Recorded) -> tuple[Signature, ...]:
        """Its signatures, under its name. Raises BadInput where one from outside gives none, or its functions
        fail."""
        if not self.record.home:
            return tuple(dataclasses.replace(s, mechanism=self.id) for s in self.signatures(recorded))
        found = called(self.id, "`signatures`", self.signatures, recorded)
        if not isinstance(found, tuple | list) or not all(isinstance(s, Signature) for s in found):
            raise of_another_type(self.id, "`signatures`", found, "a tuple of Signature")
        return tuple(dataclasses.replace(s, mechanism=self.id, **_in_one_line(self.id, s)) for s in found)

    @property
    def looked_for(self) -> bool:
        """Whether anything looks for it, where the recordings allow."""
        return self.signatures is not nothing_looks

    @property
    def id(self) -> str:
        """Its name."""
        return self.term.id


_SCORES = ("score", "again", "strength")
"""Functions of a signature that return a score."""


def _in_one_line(id: str, signature: Signature) -> dict[str, Callable[..., Any]]:
    """The functions of a signature that are the user's, whose errors are then one line. Those of the kit are
    left: some are told apart by what they are."""

    def guarded(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        what = f"`{name}` of {signature.name}"

        def call(*given: Any, **named: Any) -> Any:
            found = called(id, what, function, *given, **named)
            if name in _SCORES and not isinstance(found, Score | None):
                raise of_another_type(id, what, found, "a Score, or None")
            return found

        return call

    functions = {f.name: getattr(signature, f.name) for f in dataclasses.fields(signature)}
    return {
        name: guarded(name, function)
        for name, function in functions.items()
        if callable(function) and not str(getattr(function, "__module__", "")).startswith("cannoise_jax.")
    }
