"""The seven verbs in a row: declare, calibrate, locate, name, fit, prove; `report` writes down what
came out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery import declare
from cannoise_jax.discovery.battery import (
    Prepared,
    all_frames,
    prepare,
    prepare_split,
    split_recordings,
    stated_parameters,
)
from cannoise_jax.discovery.fit import SPENT, Fitted, Step, part_of, stepwise
from cannoise_jax.discovery.prove import Proof, Proofs, prove, unconfirmed, unproven
from cannoise_jax.discovery.quality import Quality, compare_models, composite_proofs
from cannoise_jax.discovery.sides import handed_simulators, simulators
from cannoise_jax.discovery.simulate import Draw, open_simulator, simulate_like
from cannoise_jax.mechanisms import VOCABULARY
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.signatures.fields import refit
from cannoise_jax.signatures.signature import NO_STRENGTH, Asked, Axes

ROWS = Axes("readout", "row", "redrawn", "additive", "white")
"""Offsets of rows, of which some are added to draws for the control of the two-sample test."""
SIMULATORS = ("poisson-gaussian", "nlf")


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What a run found. `report.document` turns it into the report, `model` is the extended simulator.

    splits: frames of every recording that looked for effects, and that proved them. steps of `fitted` and
    `proofs` go together; proven: also the likelihood of the frames held back; quality: draws of the simulator
    before and after against those, None where not measured.
    """

    capture: CaptureSet
    simulator: str
    alpha: float
    ids: tuple[str, ...]
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
    def proofs(self) -> tuple[Proof, ...]:
        """One for each step."""
        return self.proven.each

    @property
    def findings(self) -> list[str]:
        """Mechanisms found, in the order of acceptance; without what is part of another."""
        aside = part_of(self.fitted.steps)
        return [s.named.mechanism for n, s in enumerate(self.fitted.steps) if n not in aside]


def diagnose(
    capture: CaptureSet,
    simulator: str | Path | SensorModel | Draw = "poisson-gaussian",
    key: Key[Array, ""] | None = None,
    *,
    alpha: float = 0.01,
    without: tuple[str, ...] = (),
    mechanisms: tuple[str, ...] | None = None,
    compare: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> Diagnosis:
    """Finds where a simulator and recordings of a camera differ, names and fits what was left out, and shows
    the gain on frames that took no part in finding it.

    simulator: 'poisson-gaussian', calibrated from the recordings; 'nlf', the files' shot and read as stated;
    a sensor model or its sensor.json, a training folder, or any function (key, clean, settings) -> DN.
    alpha: false-alarm rate of the whole run. without, mechanisms: ids that may not, or may alone, be
    named. compare: also run the two-sample test. tell: called with one line per stage.
    Raises BadInput for a simulator that cannot be judged, ValueError for unknown ids or an alpha out
    of (0, 1).
    """
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}")
    key = jax.random.key(0) if key is None else key
    ids = declare.registered(without, mechanisms)
    judged = simulator != "poisson-gaussian"
    if simulator == "nlf" and not any(r.shot and r.read for r in capture.recordings):
        raise BadInput(
            f"{capture.path or 'recordings'}: state no shot and read: use --simulator poisson-gaussian"
        )
    tell("calibrate: black level, gain and read noise")
    drawn, handed = None, None
    if simulator not in SIMULATORS:
        handed = open_simulator(simulator, capture)
        tell("draw: frames of the simulator at the settings of the recordings")
        drawn = simulate_like(capture, handed.draw, jax.random.fold_in(key, 1), handed.dark)
        capture = as_simulated(capture, drawn)
    splits = split_recordings(capture)
    seen = prepare_split(capture, splits, judged, drawn)
    own = _own_effects(drawn, frozenset(ids), float(np.log(alpha))) if drawn else ()
    first = _without(seen, own)
    tell(f"locate: {len(first.signatures)} signatures on {sum(len(a) for a, _ in splits)} frames")
    chosen = [b for _, b in splits]

    @cache
    def every() -> Prepared:
        return _without(prepare(capture, all_frames(splits), judged, drawn), own)

    log_alpha = float(np.log(alpha))
    again = (lambda: every().fields) if any(chosen) else None
    fitted = stepwise(first.fields, first.signatures, frozenset(ids), log_alpha, tell, again)
    yes, no = declare.testable(fitted.first, first.signatures, ids)
    second = unseen = None
    proven = unproven(fitted.steps)
    if any(chosen):
        tell("prove: on the frames held back")
        unseen = prepare_split(capture, splits, judged, drawn, held_back=True)
        second = _without(unseen, own)
        proven = prove(fitted, first, second, chosen, every)
    if handed is None:
        stated = stated_parameters(capture, first.baselines) if judged else None
        sides = simulators(capture, first, fitted.steps, stated)
    else:
        assert drawn is not None
        sides = handed_simulators(capture, first, fitted.steps, own, handed, drawn)
    quality = None
    if compare and unseen is not None:
        tell("prove: draws of the simulator before and after")
        row = fitted.first.scores.get(next((s.name for s in first.signatures if s.axes == ROWS), ""))
        # The smallest detectable effect of all frames, four times: of the shift, sigma^2.
        share = contrasts(seen) / max(contrasts(seen) + contrasts(unseen), 1)
        sigma = 2 * row.mde * share**0.25 if row else None
        composite = proven.after is None or not sides.likelihood
        quality = compare_models(jax.random.fold_in(key, 2), seen, unseen, sides, sigma, composite)
        if quality is not None and not sides.likelihood:
            tell("prove: composite score without each finding")
            proven = composite_proofs(jax.random.fold_in(key, 2), proven, quality, sides)
    if not sides.likelihood:
        proven = proven._replace(before=None, after=None)
    proven = unconfirmed(proven, fitted.steps)
    label = str(simulator) if handed is None else handed.label
    return Diagnosis(
        capture, label, alpha, ids, yes, no, splits, first, second, fitted, proven, quality, sides.exported
    )


def as_simulated(capture: CaptureSet, drawn: CaptureSet) -> CaptureSet:
    """The recordings that the simulator could draw."""
    names = {(r.path, r.kind, r.exposure_s, r.iso) for r in drawn.recordings}
    kept = tuple(r for r in capture.recordings if (r.path, r.kind, r.exposure_s, r.iso) in names)
    return CaptureSet(capture.camera, kept, capture.path)


def contrasts(prepared: Prepared) -> int:
    """Number of contrasts between frames."""
    return sum(len(f.contrasts) for f in prepared.fields)


def _own_effects(drawn: CaptureSet, ids: frozenset[str], log_alpha: float) -> tuple[Step, ...]:
    """What the simulator has beyond Poisson-Gaussian noise, by the same battery on its own draws."""
    prepared = prepare_split(drawn, split_recordings(drawn))
    return stepwise(prepared.fields, prepared.signatures, ids, log_alpha).steps


def _without(prepared: Prepared, own: tuple[Step, ...]) -> Prepared:
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
    share = SPENT[1] if diagnosis.second else 1.0
    found = [
        s.detectable(Asked(looks, log_p, share, s.weight), scores[s.name], mechanism)
        for s in mine
        if s.detectable is not NO_STRENGTH
    ]
    best = min(found, default=np.inf)
    return (float(best), VOCABULARY[mechanism].unit) if np.isfinite(best) else None
