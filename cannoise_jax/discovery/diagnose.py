"""The seven verbs in a row: declare, calibrate, locate, name, fit, prove; `report` writes down what
came out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key
from scipy import stats

from cannoise_jax.discovery import declare
from cannoise_jax.discovery.battery import (
    Prepared,
    all_frames,
    prepare,
    prepare_split,
    split_recordings,
    stated_parameters,
)
from cannoise_jax.discovery.fields import Fields, refit
from cannoise_jax.discovery.fit import SPENT, Fitted, Step, part_of, stepwise
from cannoise_jax.discovery.limits import NO_STRENGTH
from cannoise_jax.discovery.locate import weight
from cannoise_jax.discovery.prove import Proof, Proofs, prove, unconfirmed, unproven
from cannoise_jax.discovery.quality import Quality, compare_models, composite_proofs
from cannoise_jax.discovery.sides import handed_simulators, simulators
from cannoise_jax.discovery.simulate import Draw, open_simulator, simulate_like
from cannoise_jax.discovery.sparse import hot_found, telegraph_found
from cannoise_jax.discovery.statistics.patterns import pixel_sums
from cannoise_jax.discovery.statistics.reference import quoted
from cannoise_jax.discovery.statistics.shape import DARK, darks
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.vocabulary import VOCABULARY

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

    def save(self, folder: str | Path, *, force: bool = False) -> dict[str, Any]:
        """Writes report.html, report.json and sensor.json into a folder, and returns the report.

        Raises BadInput where one exists (without force) or cannot be written.
        """
        from cannoise_jax.discovery.save import save

        return save(self, folder, force=force)


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
    tell(f"locate: {len(first.probes)} probes on {sum(len(a) for a, _ in splits)} frames")
    chosen = [b for _, b in splits]

    @cache
    def every() -> Prepared:
        return _without(prepare(capture, all_frames(splits), judged, drawn), own)

    log_alpha = float(np.log(alpha))
    again = (lambda: every().fields) if any(chosen) else None
    fitted = stepwise(first.fields, first.probes, frozenset(ids), log_alpha, tell, again)
    yes, no = declare.testable(fitted.first, first.probes, ids)
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
        row = first.probes and fitted.first.scores.get("row_additive_temporal")
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
    return stepwise(prepared.fields, prepared.probes, ids, log_alpha).steps


def _without(prepared: Prepared, own: tuple[Step, ...]) -> Prepared:
    """A split with what the simulator has already taken out, and the probes set aside that cannot be trusted
    beside it."""
    fields = prepared.fields
    for step in own:
        fields = refit(step.named.probe.absorb(fields, step.named.score))
    aside = {name for s in own for name in s.named.probe.covers} - {s.named.probe.name for s in own}
    return prepared._replace(fields=fields, probes=tuple(p for p in prepared.probes if p.name not in aside))


def detectable(diagnosis: Diagnosis, mechanism: str) -> tuple[float, str] | None:
    """Amplitude of a mechanism that this run would find with probability one half, and its unit; None for
    one whose amplitude is no strength but a level or a period."""
    if mechanism in NO_STRENGTH:
        return None
    log_alpha = np.log(diagnosis.alpha / diagnosis.fitted.first.tests)
    if mechanism in ("hot_pixels", "rts"):
        best = _sparse_detectable(diagnosis, mechanism, log_alpha)
        return (best, VOCABULARY[mechanism].unit) if np.isfinite(best) else None
    if mechanism == "banding" and "wave_redrawn" in diagnosis.fitted.first.scores:
        return _wave_detectable(diagnosis, log_alpha), VOCABULARY[mechanism].unit
    threshold = float(stats.norm.isf(np.exp(log_alpha)))
    best = np.inf
    for probe in diagnosis.first.probes:
        score = diagnosis.fitted.first.scores.get(probe.name)
        if probe.mechanism == mechanism and score is not None and np.isfinite(score.shift):
            best = min(best, quoted(score, mechanism).shift * threshold ** (1 / score.power))
    return (float(best), VOCABULARY[mechanism].unit) if np.isfinite(best) else None


def _looks(diagnosis: Diagnosis) -> list[tuple[Fields, ...]]:
    """The fields of the frames that looked, and of those held back where there are any."""
    return [p.fields for p in (diagnosis.first, diagnosis.second) if p is not None]


def _sparse_detectable(diagnosis: Diagnosis, mechanism: str, log_alpha: float) -> float:
    """Of a few far pixels no shift in standard deviations tells how often they are found: their probe's own
    p-value does, of all frames where those held back get a second look."""
    looks = _looks(diagnosis)
    probes = [p for p in diagnosis.first.probes if p.mechanism == mechanism]
    if not probes:
        return float("inf")
    log_p = float(log_alpha + np.log(weight(probes[0]) * (SPENT[1] if diagnosis.second else 1.0)))
    if mechanism == "rts":
        frames: dict[int, int] = {}
        for f in (f for fields in looks for f in darks(fields)):
            frames[f.number] = frames.get(f.number, 0) + f.frames
        seen = darks(looks[0])
        sigma = float(np.mean([np.median(f.sigma) for f in seen])) if seen else 0.0
        return telegraph_found(tuple(frames.values()), sigma, looks[0][0].mean.size, log_p)
    # Their charge grows with the exposure where the files state one.
    longest = max((f.exposure_s or 0.0 for f in looks[0] if not f.lit), default=0.0)
    scaling = "thermal" if longest else "additive"
    sums = [s for s in (pixel_sums(fields, scaling, DARK) for fields in looks) if s is not None]
    if not sums:
        return float("inf")
    return hot_found(np.sum([s.information for s in sums], axis=0), log_p) * (longest or 1.0)


def _wave_detectable(diagnosis: Diagnosis, log_alpha: float) -> float:
    """A wave whose phase is new in every frame is found where the mean power of all frames, by their
    information, exceeds what the strongest of all frequencies tried has by chance: a gamma law."""
    looks = _looks(diagnosis)
    each = [
        (float(np.sum(f.weight.astype(np.float64) ** 2)), f.contrasts) for fields in looks for f in fields
    ]
    # Between two points of the padded grid of frequencies a wave shows less of its power.
    shown = float(np.mean(np.sinc(np.linspace(0, 0.25, 101)) ** 2)) ** 2
    information = np.array([i * shown for i, contrasts in each for _ in contrasts])
    tried = 2 * looks[0][0].mean.size
    p = np.exp(log_alpha) * (SPENT[1] if diagnosis.second else 1.0) / tried
    shape = float(np.sum(information) ** 2 / np.sum(information**2))
    excess = (float(stats.gamma.isf(p, shape)) - shape) / np.sqrt(shape)
    return float(np.sqrt(4 * excess / np.sqrt(np.sum(information**2))))
