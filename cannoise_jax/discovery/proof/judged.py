"""The simulator that is judged: opened, drawn from like the recordings, and what it has already."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.frames.battery import Prepared, stated_parameters
from cannoise_jax.discovery.frames.simulate import Draw, Simulator, open_simulator, simulate_like
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.proof.lowered import lowered
from cannoise_jax.discovery.proof.sides import Sides, handed_simulators, simulators
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.steps import Fitted, Step, without_all
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.mechanisms.checked import maps_of
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.signatures import generic
from cannoise_jax.signatures.signature import FILES

CALIBRATED, STATED = "poisson-gaussian", "nlf"
"""Simulators by name: calibrated from the recordings, or as the files state it."""


@dataclass(frozen=True, eq=False)
class Judged:
    """The simulator that is judged, and the recordings that it can draw. stated: whether gain and read noise
    of the files are judged. handed, drawn: a simulator that was handed over, and frames of it like the
    recordings. given: the camera model as it was handed over, where that has too much of something."""

    capture: CaptureSet
    label: str
    stated: bool
    handed: Simulator | None = None
    drawn: CaptureSet | None = None
    given: SensorModel | None = None

    @property
    def model(self) -> SensorModel | None:
        """The camera model that was handed over, None where it is no such."""
        return None if self.handed is None else self.handed.model

    @property
    def held(self) -> frozenset[str] | None:
        """Mechanisms of the camera model that was handed over; None where it is no such."""
        return None if self.model is None else frozenset(f.mechanism for f in self.model.mechanisms)

    def own_names(self, allowed: frozenset[str], entries: tuple[Entry, ...]) -> frozenset[str]:
        """Names for what its own draws show: of noise of rows or columns those that the camera model holds,
        where it holds one of the same lines. White rows beside noise along the raster look like rows of a
        power law, as which they could not be lowered."""
        if self.model is None:
            return allowed
        held = {f.mechanism: _lines(f.record) for f in self.model.mechanisms}
        lines = set(held.values()) - {None}
        return allowed - {e.id for e in entries if e.id not in held and _lines(e.record) in lines}

    def sides(
        self, first: Prepared, steps: tuple[Step, ...], own: tuple[Step, ...], less: bool = False
    ) -> Sides:
        """The simulator before and after, as draws. less: whether `own` lacks what it had too much of."""
        if self.handed is not None and self.drawn is not None:
            return handed_simulators(
                self.capture, first, steps, own,
                handed=self.handed, drawn=self.drawn, given=self.given, less=less,
            )  # fmt: skip
        stated = stated_parameters(self.capture, first.baselines) if self.stated else None
        return simulators(self.capture, first, steps, stated)


def with_less(judged: Judged, share: Mapping[str, float], key: Key[Array, ""]) -> Judged | None:
    """The simulator at a share of the strength of what it has too much of; None where it is no camera model
    or has no such mechanism."""
    model = judged.model
    less = None if model is None else lowered(model, share)
    if judged.handed is None or less is None:
        return None
    handed = judged.handed._replace(model=less, draw=less.sample)
    drawn = simulate_like(judged.capture, handed.draw, jax.random.fold_in(key, 6), handed.dark)
    return dataclasses.replace(judged, handed=handed, drawn=drawn, given=model)


def opened(
    capture: CaptureSet,
    simulator: str | Path | SensorModel | Draw,
    key: Key[Array, ""],
    tell: Callable[[str], None],
    mechanisms: Sequence[Entry] = (),
) -> Judged:
    """The simulator as it is judged. mechanisms: see `open_simulator`. Raises BadInput for one that cannot
    be, or not be calibrated."""
    told = any(r.count > 1 or (r.shot and r.read) for r in capture.recordings)
    if simulator == CALIBRATED and not told:
        raise BadInput(
            f"{capture.path or capture.camera}: every recording is of one frame, and one shows no noise: "
            "record two or more of each setting, or compare with a --simulator that is calibrated"
        )
    if simulator == STATED and not any(r.shot and r.read for r in capture.recordings):
        raise BadInput(
            f"{capture.path or 'recordings'}: state no shot and read: use --simulator {CALIBRATED}"
        )
    if simulator in (CALIBRATED, STATED):
        return Judged(capture, str(simulator), simulator == STATED)
    handed = open_simulator(simulator, capture, mechanisms)
    tell("draw: frames of the simulator at the settings of the recordings")
    drawn = simulate_like(capture, handed.draw, jax.random.fold_in(key, 1), handed.dark)
    return Judged(as_simulated(capture, drawn), handed.label, True, handed, drawn)


def as_simulated(capture: CaptureSet, drawn: CaptureSet) -> CaptureSet:
    """The recordings that the simulator could draw."""
    names = {(r.path, r.kind, r.exposure_s, r.iso) for r in drawn.recordings}
    kept = tuple(r for r in capture.recordings if (r.path, r.kind, r.exposure_s, r.iso) in names)
    return CaptureSet(capture.camera, kept, capture.path)


def own_effects(
    drawn: CaptureSet | None, entries: tuple[Entry, ...], allowed: frozenset[str], log_alpha: float
) -> tuple[Step, ...]:
    """What a simulator has beyond Poisson-Gaussian noise, by the same battery on its own draws."""
    if drawn is None:
        return ()
    prepared = splits_of(drawn, entries=searched(entries)).looking
    return stepwise(prepared.fields, prepared.signatures, allowed, log_alpha).steps


def _lines(record: Mechanism) -> Point | None:
    """The point of a mechanism of rows or columns, whatever its spectrum."""
    return (
        dataclasses.replace(record.point, spectrum="white")
        if record.point.over in ("row", "column")
        else None
    )


_SHOWN, _MORE = 2.0, 3.0
"""Standard errors from which on draws show something, and from which on recordings show more of it."""


def beyond_draws(
    fitted: Fitted, own: tuple[Step, ...], tell: Callable[[str], None] = lambda text: None
) -> Fitted:
    """Without the findings of which the simulator's own draws, with what was found in them taken out, show as
    much: a description of what it has that is a little off leaves the same in both."""
    if not own:
        return fitted
    kept = []
    for step in fitted.steps:
        signature, found = step.named.signature, step.named.score
        there = None if signature.beyond or signature.reads == FILES else signature.score(own[-1].left)
        if (
            there is not None
            and np.isfinite(there.error)
            and there.amplitude > _SHOWN * there.error
            and found.amplitude - there.amplitude < _MORE * float(np.hypot(found.error, there.error))
        ):
            tell(f"given up: {step.named.mechanism} ({signature.name}), the draws show as much")
        else:
            kept.append(step)
    return fitted._replace(steps=tuple(kept))


def without_own(
    prepared: Prepared, own: tuple[Step, ...], too_much: frozenset[str] = frozenset()
) -> Prepared:
    """A split with what the simulator has already taken out, and the signatures set aside that cannot be
    trusted beside it. Gain, read noise and levels of its draws hold as much of it as those of the recordings;
    its gain and read noise not, where it has too much. too_much: mechanisms that could not be lowered in it.
    """
    aside = {name for s in own for name in s.named.signature.covers} - {s.named.signature.name for s in own}
    unlike = {name for s in own if s.named.mechanism in too_much for name in s.named.signature.covers}
    return prepared._replace(
        fields=without_all(own, prepared.fields),
        signatures=tuple(
            p
            for p in prepared.signatures
            if p.name not in aside or (p.beyond and not (p.restates and p.name in unlike))
        ),
    )


def searched(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """What recordings are searched for: every mechanism of the package, and those from outside, which are
    looked for by their samplers where they bring no signature of their own."""
    return (*ENTRIES, *(_searchable(entry) for entry in entries if entry not in ENTRIES))


def _searchable(entry: Entry) -> Entry:
    if entry.looked_for:
        return entry
    looks = generic.by_sampling(
        entry.record,
        name=f"sampled_{entry.id}",
        known={},
        simulated=entry.term.kind == "sensor",
        maps_of=maps_of(entry),
    )
    return dataclasses.replace(entry, signatures=looks)
