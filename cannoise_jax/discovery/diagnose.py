"""The verbs in a row: declare, calibrate, locate, name, fit, prove, gate, check; `report` writes down what
came out."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.remainder import with_remainder
from cannoise_jax.discovery.frames.battery import Prepared, Splits, splits_of, stated_parameters
from cannoise_jax.discovery.frames.calls import checked_capture, checked_key
from cannoise_jax.discovery.frames.simulate import Draw, Simulator, open_simulator, simulate_like
from cannoise_jax.discovery.proof.adequacy import doubts, withdrawn
from cannoise_jax.discovery.proof.check import Checked, check, source_of
from cannoise_jax.discovery.proof.gate import Gated, gate, remaining
from cannoise_jax.discovery.proof.prove import Proof, Proofs, prove, standing, unconfirmed, unproven
from cannoise_jax.discovery.proof.quality import Quality, composite_proofs, open_panel, quality_of
from cannoise_jax.discovery.proof.sides import Sides, handed_simulators, simulators
from cannoise_jax.discovery.proof.twosample import differs as told_apart
from cannoise_jax.discovery.proof.verdict import Verdict, verdict_of
from cannoise_jax.discovery.search import declare
from cannoise_jax.discovery.search.fit import Fitted, Step, part_of, stepwise
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.discovery.search.name import UNKNOWN, Doubt
from cannoise_jax.mechanisms import ENTRIES, VOCABULARY
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.recordings.usable import LeftOutWarning, usable
from cannoise_jax.signatures import generic
from cannoise_jax.signatures.fields import refit
from cannoise_jax.signatures.multiplicity import SHARED
from cannoise_jax.signatures.signature import NO_STRENGTH, Asked
from cannoise_jax.vocabulary import Term

CALIBRATED, STATED = "poisson-gaussian", "nlf"
"""Simulators by name: calibrated from the recordings, or as the files state it."""
AFTER = "the simulator handed back"


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a run found. `report.document` turns it into the report, `model` is the extended simulator.

    entries: mechanisms that may be named. splits: frames of every recording that looked for effects, and that
    proved them. steps of `fitted` and `proofs` go together; proven: also the likelihood of the frames held
    back; quality: draws of the simulator before and after against those, None where not measured."""

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
    gated: Gated | None = None
    remains: Checked | None = None
    entered: bool = True

    @property
    def verdict(self) -> Verdict:
        """What all of it says together: findings, the layer that knows no names, and the two-sample test."""
        handed_back = self.gated.steps if self.gated else self.fitted.steps if self.entered else ()
        aside = part_of(self.fitted.steps)
        kept = [
            s.named.mechanism
            for n, (s, p) in enumerate(zip(self.fitted.steps, self.proofs, strict=True))
            if n not in aside and (s in handed_back or p.confirmed)
        ]
        before, after = (self.differs(which) for which in (0, 1))
        return verdict_of(
            # Where nothing may be named, what is left of the battery still looks for structures.
            tested=bool(self.testable or self.fitted.first.scores),
            named=any(m != UNKNOWN for m in kept),
            unnamed=UNKNOWN in self.findings,
            differs_before=bool(before) or bool(self.findings),
            differs_after=after,
            remainder=self.gated is not None and self.gated.remainder,
        )

    def differs(self, which: int) -> bool | None:
        """Whether the simulator before (0) or after (1) is told from the recordings; None: unknown."""
        seen: list[bool] = []
        if self.remains is not None:
            seen.append(bool((self.remains.before, self.remains.after)[which].differences))
        if self.quality is not None and self.quality.two_sample is not None:
            areas = (self.quality.two_sample.before, self.quality.two_sample.after)
            seen.append(told_apart(areas[which], float(np.log(self.alpha * SHARED.network))))
        return any(seen) if seen else None

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
        from cannoise_jax.discovery.report.save import save

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
    test. tell: called with one line per stage. Frames without noise are left out with a `LeftOutWarning`.
    Raises BadInput for a simulator that cannot be judged and where too few frames are left, ValueError for
    unknown names or an alpha out of (0, 1), TypeError for what is no capture set or no key.
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}")
    capture, key = checked_capture(capture), checked_key(key)
    log_alpha = float(np.log(alpha * (SHARED.names if compare else 1.0)))
    entries = declare.registered(without, mechanisms)
    allowed = frozenset(entry.id for entry in entries)

    capture, left_out = usable(capture)
    for line in left_out:
        warnings.warn(line, LeftOutWarning, stacklevel=2)
    tell("calibrate: black level, gain and read noise")
    judged = opened(capture, simulator, key, tell)
    raw = splits_of(judged.capture, judged.stated, judged.drawn, searched(entries))
    own = own_effects(judged.drawn, entries, allowed, log_alpha)
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
        fitted, proven = standing(fitted, prove(fitted, splits), tell)
    sides = judged.sides(first, fitted.steps, own)
    gated = remains = quality = panel = None
    against: tuple[Doubt | None, ...] = (None,) * len(fitted.steps)
    model = sides.exported
    if compare and splits.can_prove:
        panel = open_panel(*judged_by(raw, fitted, sides, key))
    if panel is not None:
        tell("gate: draws of the simulator before and after")
        gated = gate(panel, sides, fitted.steps, proven)
        if sides.model is not None:
            chance, own_key = alpha * SHARED.layer, jax.random.fold_in(key, 5)
            against = doubts(judged.capture, splits.frames, fitted.steps, sides.of, own_key, chance, tell)
        tell("remainder: what is left, measured as it is")
        rest = partial(with_remainder, judged.capture, key=jax.random.fold_in(key, 3))
        well = tuple(s for s, doubt in zip(fitted.steps, against, strict=True) if doubt is None)
        gated = remaining(gated, panel, sides, well, rest)
    if compare:
        tell("check: what still differs")
        gated, remains, model = checked(judged, sides, gated, splits, alpha, jax.random.fold_in(key, 4))
    if panel is not None and gated is not None:
        quality = quality_of(panel, gated.before, gated.after)
        if not sides.likelihood:
            tell("prove: composite score without each finding")
            proven = composite_proofs(jax.random.fold_in(key, 2), proven, quality, sides)
        fitted, gated = withdrawn(fitted, gated, against)
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
        model,
        gated,
        remains,
        model is not sides.model,
    )


def searched(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """What recordings are searched for: every mechanism of the package, and those from outside, which are
    looked for by their samplers where they bring no signature of their own."""
    return (*ENTRIES, *(_searchable(entry) for entry in entries if entry not in ENTRIES))


def _searchable(entry: Entry) -> Entry:
    if entry.looked_for:
        return entry
    looks = generic.by_sampling(
        entry.record, name=f"sampled_{entry.id}", known={}, simulated=entry.term.kind == "sensor"
    )
    return dataclasses.replace(entry, signatures=looks)


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


def judged_by(
    raw: Splits, fitted: Fitted, sides: Sides, key: Key[Array, ""]
) -> tuple[Key[Array, ""], Prepared, Prepared, Sides, float | None]:
    """What draws of simulators are measured with: frames that looked and frames held back, and the row
    noise (DN) of the control of the two-sample test."""
    seen, unseen = raw.looking, raw.held_back
    row = fitted.first.scores.get(next((s.name for s in seen.signatures if s.control), ""))
    # The smallest detectable effect of all frames, four times: of the shift, sigma^2.
    share = contrasts(seen) / max(contrasts(seen) + contrasts(unseen), 1)
    return jax.random.fold_in(key, 2), seen, unseen, sides, 2 * row.mde * share**0.25 if row else None


def checked(
    judged: Judged, sides: Sides, gated: Gated | None, splits: Splits, alpha: float, key: Key[Array, ""]
) -> tuple[Gated | None, Checked | None, SensorModel]:
    """What differs between the frames held back and draws before and after (None: none can be drawn), and the
    simulator that is handed back. Where more differs than before, the remainder goes; where too few frames
    were held back for the gate, all that was found does."""
    before = source_of(sides.model, sides.plain, judged.label, key)
    model = sides.exported if gated is None else gated.model

    def against(model: SensorModel) -> Checked:
        after = None if model is sides.model else lambda: source_of(model, sides.plain, AFTER, key)
        return check(judged.capture, splits.frames, before, after, alpha * SHARED.layer)

    try:
        found = against(model)
        if not (found.left or 0.0) > 1:
            return gated, found, model
        if gated is None and sides.model is not None:
            return None, found.unchanged, sides.model
        if gated is not None and gated.remainder:
            without = against(gated.without_remainder.model)
            if without.nats < found.nats:
                return gated.without_remainder, without, gated.without_remainder.model
    except BadInput:
        return gated, None, model
    return gated, found, model


def as_simulated(capture: CaptureSet, drawn: CaptureSet) -> CaptureSet:
    """The recordings that the simulator could draw."""
    names = {(r.path, r.kind, r.exposure_s, r.iso) for r in drawn.recordings}
    kept = tuple(r for r in capture.recordings if (r.path, r.kind, r.exposure_s, r.iso) in names)
    return CaptureSet(capture.camera, kept, capture.path)


def contrasts(prepared: Prepared) -> int:
    """Number of contrasts between frames."""
    return sum(len(f.contrasts) for f in prepared.fields)


def own_effects(
    drawn: CaptureSet | None, entries: tuple[Entry, ...], allowed: frozenset[str], log_alpha: float
) -> tuple[Step, ...]:
    """What a simulator has beyond Poisson-Gaussian noise, by the same battery on its own draws."""
    if drawn is None:
        return ()
    prepared = splits_of(drawn, entries=searched(entries)).looking
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
    share = SHARED.names if diagnosis.remains else 1.0
    log_p = float(np.log(diagnosis.alpha * share / diagnosis.fitted.first.tests))
    looks = tuple(p.fields for p in (diagnosis.first, diagnosis.second) if p is not None)
    share = SHARED.together if diagnosis.second else 1.0
    found = [
        s.detectable(Asked(looks, log_p, share, s.weight), scores[s.name], mechanism)
        for s in mine
        if s.detectable is not NO_STRENGTH
    ]
    best = min(found, default=np.inf)
    return (float(best), diagnosis.terms[mechanism].unit) if np.isfinite(best) else None


def absorbed_by(diagnosis: Diagnosis, mechanism: str) -> list[str]:
    """Findings that took away what spoke for a mechanism; none where nothing ever spoke for it. Its
    statistic stood out before anything was taken out, so that no limit says that it is not there."""
    first, steps = diagnosis.fitted.first, diagnosis.fitted.steps
    mine = [s for s in diagnosis.first.signatures if s.mechanism == mechanism and s.name in first.scores]
    level = float(np.log(diagnosis.alpha))
    if not any(first.log_p.get(s.name, 0.0) < level for s in mine):
        return []
    names = {s.name for s in mine}
    over = {s.axes.varies_over for s in mine}
    taken = [
        s.named for s in steps if names & {*s.named.signature.covers, *s.named.signature.hides(s.named.score)}
    ]
    taken = taken or [s.named for s in steps if s.named.signature.axes.varies_over in over]
    return list(dict.fromkeys(n.mechanism for n in taken or [s.named for s in steps]))
