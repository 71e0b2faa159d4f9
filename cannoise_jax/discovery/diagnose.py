"""The seven verbs in a row: declare, calibrate, locate, name, fit, prove; `report` writes down what
came out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery import declare
from cannoise_jax.discovery.battery import Prepared, Splits, splits_of, stated_parameters
from cannoise_jax.discovery.fit import Fitted, Step, part_of, stepwise
from cannoise_jax.discovery.locate import locate
from cannoise_jax.discovery.prove import Proof, Proofs, prove, unconfirmed, unproven
from cannoise_jax.discovery.quality import Quality, compare_models, composite_proofs
from cannoise_jax.discovery.sides import Sides, handed_simulators, simulators
from cannoise_jax.discovery.simulate import Draw, Simulator, open_simulator, simulate_like
from cannoise_jax.mechanisms import ENTRIES, VOCABULARY
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.signatures import generic
from cannoise_jax.signatures.fields import refit
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.signature import NO_STRENGTH, Asked, Axes
from cannoise_jax.vocabulary import Term

ROWS = Axes("readout", "row", "redrawn", "additive", "white")
"""Offsets of rows, of which some are added to draws for the control of the two-sample test."""
CALIBRATED, STATED = "poisson-gaussian", "nlf"
"""Simulators by name: calibrated from the recordings, or as the files state it."""


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a run found. `report.document` turns it into the report, `model` is the extended simulator.

    entries: mechanisms that may be named. splits: frames of every recording that looked for effects, and that
    proved them. steps of `fitted` and `proofs` go together; proven: also the likelihood of the frames held
    back; quality: draws of the simulator before and after against those, None where not measured.
    """

    capture: CaptureSet
    simulator: str
    alpha: float
    entries: tuple[Entry, ...]
    testable: tuple[str, ...]
    not_testable: tuple[tuple[str, str], ...]
    splits: list[tuple[list[int], list[int]]]
    first: Prepared
    second: Prepared | None
    fitted: Fitted
    proven: Proofs
    quality: Quality | None
    model: SensorModel

    @property
    def ids(self) -> tuple[str, ...]:
        """Names that may be given."""
        return tuple(entry.id for entry in self.entries)

    @property
    def terms(self) -> dict[str, Term]:
        """What names mean."""
        return {**VOCABULARY, **{entry.id: entry.term for entry in self.entries}}

    @property
    def proofs(self) -> tuple[Proof, ...]:
        """One for each step."""
        return self.proven.each

    @property
    def findings(self) -> list[str]:
        """Mechanisms found, in the order of acceptance; without what is part of another."""
        aside = part_of(self.fitted.steps)
        return [s.named.mechanism for n, s in enumerate(self.fitted.steps) if n not in aside]

    def save(self, folder: str | Path, *, force: bool = False) -> dict[str, Any]:
        """Writes report.html, report.json and sensor.json into a folder, and returns the report.

        Raises BadInput where one exists (without force) or cannot be written.
        """
        from cannoise_jax.discovery.save import save

        return save(self, folder, force=force)


def diagnose(
    capture: CaptureSet,
    simulator: str | Path | SensorModel | Draw = CALIBRATED,
    key: Key[Array, ""] | None = None,
    *,
    alpha: float = 0.01,
    without: Sequence[str] = (),
    mechanisms: Sequence[str | Entry] | None = None,
    compare: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> Diagnosis:
    """Finds where a simulator and recordings of a camera differ, names and fits what was left out, and shows
    the gain on frames that took no part in finding it.

    simulator: 'poisson-gaussian', calibrated from the recordings; 'nlf', the files' shot and read as stated;
    a sensor model or its sensor.json, a training folder, or any function (key, clean, settings) -> DN.
    alpha: false-alarm rate of the whole run. without, mechanisms: names that may not, or may alone, be given;
    `mechanisms` may hold entries of one's own, which are looked for too. compare: also run the two-sample
    test. tell: called with one line per stage.
    Raises BadInput for a simulator that cannot be judged, ValueError for unknown names or an alpha out
    of (0, 1).
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}")
    key = jax.random.key(0) if key is None else key
    log_alpha = float(np.log(alpha))
    entries = declare.registered(without, mechanisms)
    allowed = frozenset(entry.id for entry in entries)

    tell("calibrate: black level, gain and read noise")
    judged = opened(capture, simulator, key, tell)
    raw = splits_of(judged.capture, judged.stated, judged.drawn, searched(entries))
    own = own_effects(judged.drawn, allowed, log_alpha)
    splits = raw.less(partial(without_own, own=own))
    first = splits.looking

    tell(f"locate: {len(first.signatures)} signatures on {sum(len(a) for a, _ in splits.frames)} frames")
    located = locate(first.fields, first.signatures)
    testable, not_testable = declare.testable(located, first.signatures, entries)
    every = (lambda: splits.together.fields) if splits.can_prove else None
    fitted = stepwise(first.fields, first.signatures, allowed, log_alpha, tell, every, located)

    proven = unproven(fitted.steps)
    if splits.can_prove:
        tell("prove: on the frames held back")
        proven = prove(fitted, splits)
    sides = judged.sides(first, fitted.steps, own)
    quality = compared(raw, fitted, proven, sides, key, tell) if compare and splits.can_prove else None
    if quality is not None and not sides.likelihood:
        tell("prove: composite score without each finding")
        proven = composite_proofs(jax.random.fold_in(key, 2), proven, quality, sides)
    return Diagnosis(
        judged.capture,
        judged.label,
        alpha,
        entries,
        testable,
        not_testable,
        splits.frames,
        first,
        splits.held_back if splits.can_prove else None,
        fitted,
        unconfirmed(proven if sides.likelihood else proven.without_likelihood(), fitted.steps),
        quality,
        sides.exported,
    )


def searched(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """What recordings are searched for: every mechanism of the package, and those from outside, which are
    looked for by their samplers where they bring no signature of their own."""
    return (*ENTRIES, *(_searchable(entry) for entry in entries if entry not in ENTRIES))


def _searchable(entry: Entry) -> Entry:
    if entry.looked_for:
        return entry
    unit = next(p.unit for p in entry.record.parameters if p.name == generic.strength_of(entry.record))
    by_sampling = generic.by_sampling(entry.record, name=entry.id, unit=unit, known={})
    return dataclasses.replace(entry, signatures=by_sampling)


@dataclass(frozen=True, eq=False)
class Judged:
    """The simulator that is judged, and the recordings that it can draw. stated: whether gain and read noise
    of the files are judged. handed, drawn: a simulator that was handed over, and frames of it like the
    recordings."""

    capture: CaptureSet
    label: str
    stated: bool
    handed: Simulator | None = None
    drawn: CaptureSet | None = None

    def sides(self, first: Prepared, steps: tuple[Step, ...], own: tuple[Step, ...]) -> Sides:
        """The simulator before and after, as draws."""
        if self.handed is not None and self.drawn is not None:
            return handed_simulators(self.capture, first, steps, own, self.handed, self.drawn)
        stated = stated_parameters(self.capture, first.baselines) if self.stated else None
        return simulators(self.capture, first, steps, stated)


def opened(
    capture: CaptureSet,
    simulator: str | Path | SensorModel | Draw,
    key: Key[Array, ""],
    tell: Callable[[str], None],
) -> Judged:
    """The simulator as it is judged. Raises BadInput for one that cannot be."""
    if simulator == STATED and not any(r.shot and r.read for r in capture.recordings):
        raise BadInput(
            f"{capture.path or 'recordings'}: state no shot and read: use --simulator {CALIBRATED}"
        )
    if simulator in (CALIBRATED, STATED):
        return Judged(capture, str(simulator), simulator == STATED)
    handed = open_simulator(simulator, capture)
    tell("draw: frames of the simulator at the settings of the recordings")
    drawn = simulate_like(capture, handed.draw, jax.random.fold_in(key, 1), handed.dark)
    return Judged(as_simulated(capture, drawn), handed.label, True, handed, drawn)


def compared(
    raw: Splits,
    fitted: Fitted,
    proven: Proofs,
    sides: Sides,
    key: Key[Array, ""],
    tell: Callable[[str], None],
) -> Quality | None:
    """Draws of the simulator before and after against the frames held back."""
    tell("prove: draws of the simulator before and after")
    seen, unseen = raw.looking, raw.held_back
    row = fitted.first.scores.get(next((s.name for s in seen.signatures if s.axes == ROWS), ""))
    # The smallest detectable effect of all frames, four times: of the shift, sigma^2.
    share = contrasts(seen) / max(contrasts(seen) + contrasts(unseen), 1)
    sigma = 2 * row.mde * share**0.25 if row else None
    composite = proven.after is None or not sides.likelihood
    return compare_models(jax.random.fold_in(key, 2), seen, unseen, sides, sigma, composite)


def as_simulated(capture: CaptureSet, drawn: CaptureSet) -> CaptureSet:
    """The recordings that the simulator could draw."""
    names = {(r.path, r.kind, r.exposure_s, r.iso) for r in drawn.recordings}
    kept = tuple(r for r in capture.recordings if (r.path, r.kind, r.exposure_s, r.iso) in names)
    return CaptureSet(capture.camera, kept, capture.path)


def contrasts(prepared: Prepared) -> int:
    """Number of contrasts between frames."""
    return sum(len(f.contrasts) for f in prepared.fields)


def own_effects(drawn: CaptureSet | None, allowed: frozenset[str], log_alpha: float) -> tuple[Step, ...]:
    """What a simulator has beyond Poisson-Gaussian noise, by the same battery on its own draws."""
    if drawn is None:
        return ()
    prepared = splits_of(drawn).looking
    return stepwise(prepared.fields, prepared.signatures, allowed, log_alpha).steps


def without_own(prepared: Prepared, own: tuple[Step, ...]) -> Prepared:
    """A split with what the simulator has already taken out, and the signatures set aside that cannot be
    trusted beside it."""
    fields = prepared.fields
    for step in own:
        fields = refit(step.named.signature.absorb(fields, step.named.score))
    aside = {name for s in own for name in s.named.signature.covers} - {s.named.signature.name for s in own}
    return prepared._replace(
        fields=fields, signatures=tuple(p for p in prepared.signatures if p.name not in aside)
    )


def detectable(diagnosis: Diagnosis, mechanism: str) -> tuple[float, str] | None:
    """Amplitude of a mechanism that this run would find with probability one half, and its unit; None for
    one whose amplitude is no strength but a level or a period."""
    scores = diagnosis.fitted.first.scores
    mine = [s for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in scores]
    mine = [s for s in mine if s.decides][:1] or mine
    log_p = float(np.log(diagnosis.alpha / diagnosis.fitted.first.tests))
    looks = tuple(p.fields for p in (diagnosis.first, diagnosis.second) if p is not None)
    share = SHARED.together if diagnosis.second else 1.0
    found = [
        s.detectable(Asked(looks, log_p, share, s.weight), scores[s.name], mechanism)
        for s in mine
        if s.detectable is not NO_STRENGTH
    ]
    best = min(found, default=np.inf)
    return (float(best), diagnosis.terms[mechanism].unit) if np.isfinite(best) else None
