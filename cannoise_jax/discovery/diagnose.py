"""The verbs in a row: declare, calibrate, locate, name, fit, prove, gate, check; `report` writes down what
came out."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.compare.remainder import with_remainder
from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.calls import check_one_size, checked_capture, checked_key, seed_of
from cannoise_jax.discovery.frames.faults import (
    FaultWarning,
    at_one_temperature,
    check_measurable,
    fault_lines,
    faults_of,
    within_light,
    without_moving,
    without_moving_flats,
    without_spots,
)
from cannoise_jax.discovery.frames.simulate import Draw
from cannoise_jax.discovery.frames.smooth import shades
from cannoise_jax.discovery.frames.splits import Splits, read_once, splits_of
from cannoise_jax.discovery.proof.adequacy import described, doubts, withdrawn
from cannoise_jax.discovery.proof.excess import Excess, excess
from cannoise_jax.discovery.proof.gate import Gated, gate, lesser, remaining, sure_of
from cannoise_jax.discovery.proof.handed_back import checked, worth_telling
from cannoise_jax.discovery.proof.in_full import in_full
from cannoise_jax.discovery.proof.judged import (
    CALIBRATED,
    Judged,
    beyond_draws,
    opened,
    own_effects,
    searched,
    with_less,
    without_own,
)
from cannoise_jax.discovery.proof.lowered import at_shares, shares
from cannoise_jax.discovery.proof.prove import (
    Proofs,
    prove,
    standing,
    unconfirmed,
    unproven,
    without_doubted_gain,
)
from cannoise_jax.discovery.proof.quality import Panel, composite_proofs, open_panel, quality_of
from cannoise_jax.discovery.proof.sides import Sides
from cannoise_jax.discovery.report.save import save
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search import declare
from cannoise_jax.discovery.search.fit import stepwise
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.discovery.search.maps import beside_others
from cannoise_jax.discovery.search.name import Doubt
from cannoise_jax.discovery.search.steps import Fitted, Step
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.mechanisms.checked import check_draws
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.recordings.usable import LeftOutWarning, usable
from cannoise_jax.signatures.multiplicity import SHARED


class Diagnosis(Result):
    """What a run found, which writes itself down."""

    def __repr__(self) -> str:
        found = ", ".join(self.findings) or "nothing"
        return f"<Diagnosis of {self.capture.camera}: {self.verdict}; found: {found}>"

    def save(self, folder: str | Path, *, force: bool = False) -> dict[str, Any]:
        """Writes report.html, report.json and sensor.json into a folder, and returns the report.

        Raises BadInput where one exists (without force) or cannot be written.
        """
        return save(self, folder, force=force)


Entered = tuple[Sides, Panel | None, Gated | None, tuple[Doubt | None, ...]]
"""Both sides with some findings, what judges draws of them (None: nothing can), what of the findings enters,
and what speaks against the name of each."""


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
    `mechanisms` may hold entries of one's own, which are looked for too, and which a sensor.json may name.
    compare: also run the two-sample test. tell: called with one line per stage. Frames without noise, moving
    scenes beside flats and flats whose light moves are left out with a `LeftOutWarning`; faults are said with
    a `FaultWarning`.
    Raises BadInput for a simulator that cannot be judged, functions of one's own that fail, frames of several
    sizes, where too few are left, for flats and darks of two gains, and for scenes that move where no flats
    are, ValueError for unknown names or an alpha out of (0, 1), TypeError for what is no capture set or no
    key.
    """
    started = time.monotonic()
    if isinstance(alpha, bool) or not isinstance(alpha, int | float | np.number):
        raise TypeError(f"alpha is {alpha!r}: give a number between 0 and 1")
    if not 0 < alpha < 1:
        raise ValueError(f"alpha must lie between 0 and 1, got {alpha}")
    capture, key = checked_capture(capture), checked_key(key)
    check_one_size(capture)
    log_alpha = float(np.log(alpha * (SHARED.names if compare else 1.0)))
    entries = declare.registered(without, mechanisms)
    allowed = frozenset(entry.id for entry in entries)
    check_draws((e for e in entries if e not in ENTRIES), capture.recordings[0].size)

    capture, left_out = usable(capture, unsteady=True)
    capture, moved = without_moving(capture)
    capture, warmer = at_one_temperature(capture)
    for line in (*left_out, *moved, *warmer):
        warnings.warn(line, LeftOutWarning, stacklevel=2)
    capture = read_once(capture)
    faults = faults_of(capture)
    check_measurable(capture, faults)
    capture, faults = within_light(capture, faults)
    for line in fault_lines(faults):
        warnings.warn(line, FaultWarning, stacklevel=2)
    capture, unsteady = without_moving_flats(capture, faults)
    for line in unsteady:
        warnings.warn(line, LeftOutWarning, stacklevel=2)
    capture = without_spots(capture, faults)
    tell("calibrate: black level, gain and read noise")
    judged = opened(capture, simulator, key, tell, [m for m in mechanisms or () if isinstance(m, Entry)])
    raw = splits_of(judged.capture, judged.stated, judged.drawn, searched(entries))
    own = own_effects(judged.drawn, entries, judged.own_names(allowed, entries), log_alpha)
    too_much = excess(own, raw.looking, judged.held)
    judged, raw, own, kept, still = less_of(
        too_much, judged, raw, own, entries=entries, allowed=allowed, log_alpha=log_alpha, key=key
    )
    splits = raw.less(partial(without_own, own=own, too_much=still))
    first = splits.looking

    looked, alone = sum(len(a) for a, _ in splits.frames), "" if splits.can_prove else ", none held back"
    tell(f"locate: {len(first.signatures)} signatures on {looked} frames{alone}")
    located = locate(first.fields, first.signatures)
    testable, not_testable = declare.testable(located, first.signatures, entries)
    every = (lambda: splits.together.fields) if splits.can_prove else None
    fitted = stepwise(
        first.fields, first.signatures, allowed, log_alpha, tell=tell, every=every, located=located
    )

    fitted = beyond_draws(fitted, own, tell)
    fitted = fitted._replace(steps=beside_others(fitted.steps))
    proven = unproven(fitted.steps)
    if splits.can_prove:
        tell("prove: on the frames held back")
        fitted, proven = standing(fitted, prove(fitted, splits, tell), tell)
    fitted, proven = in_full(fitted, proven, own, raw.looking)
    light = shades(first.stacks) if compare else {}

    def entered(fitted: Fitted, proven: Proofs) -> Entered:
        sides = judged.sides(first, fitted.steps, kept, less=bool(too_much))
        none: tuple[Doubt | None, ...] = (None,) * len(fitted.steps)
        proves = compare and splits.can_prove
        panel = open_panel(*judged_by(raw, fitted, sides, key)) if proves else None
        if panel is None:
            return sides, None, None, none
        tell("gate: draws of the simulator before and after")
        gated = gate(panel, sides, fitted.steps, proven, tell)
        if sides.model is None:
            return sides, panel, gated, none
        chance, own_key = alpha * SHARED.layer, jax.random.fold_in(key, 5)
        shown = [p.confirmed for p in unconfirmed(proven, fitted.steps).each]
        against = doubts(
            judged.capture, splits.frames, fitted.steps, sides.of,
            key=own_key, alpha=chance, confirmed=shown, tell=tell, shades=light,
        )  # fmt: skip
        return sides, panel, gated, against

    sides, panel, gated, against = entered(fitted, proven)
    if less := without_doubted_gain(fitted, proven, against):
        fitted, proven = less
        sides, panel, gated, against = entered(fitted, proven)
    remains = quality = None
    model = sides.exported
    if panel is not None and gated is not None:
        tell("remainder: what is left, measured as it is")
        rest = partial(with_remainder, judged.capture, key=jax.random.fold_in(key, 3), tell=tell)
        well, sure = described(fitted.steps, against), sure_of(fitted.steps, against)
        gated = remaining(gated, panel, sides, described=well, sure=sure, with_rest=rest, tell=tell)
    if compare:
        tell("check: what still differs")
        fewer = partial(lesser, panel=panel, sides=sides, against=against, steps=fitted.steps)
        own_key = jax.random.fold_in(key, 4)
        layer = alpha * SHARED.layer
        gated, remains, model = checked(
            judged, sides, gated, fewer, splits.frames, light=light, alpha=layer, key=own_key, tell=tell
        )
    if panel is not None and gated is not None:
        quality = quality_of(panel, gated.before, gated.after)
        if not sides.likelihood:
            tell("prove: composite score without each finding")
            proven = composite_proofs(jax.random.fold_in(key, 2), proven, quality, sides)
        fitted, gated = withdrawn(fitted, gated, against)
        fitted, proven = worth_telling(fitted, proven, gated.steps, tell)
    return Diagnosis(
        capture=judged.capture,
        simulator=judged.label,
        alpha=alpha,
        entries=entries,
        testable=testable,
        not_testable=not_testable,
        splits=splits.frames,
        first=first,
        second=splits.held_back if splits.can_prove else None,
        fitted=fitted,
        proven=unconfirmed(proven if sides.likelihood else proven.without_likelihood(), fitted.steps),
        quality=quality,
        model=model,
        gated=gated,
        remains=remains,
        entered=model is not sides.model,
        faults=faults,
        excess=too_much,
        key=seed_of(key),
        seconds=time.monotonic() - started,
    )


def less_of(
    too_much: Sequence[Excess],
    judged: Judged,
    raw: Splits,
    own: tuple[Step, ...],
    *,
    entries: tuple[Entry, ...],
    allowed: frozenset[str],
    log_alpha: float,
    key: Key[Array, ""],
) -> tuple[Judged, Splits, tuple[Step, ...], tuple[Step, ...], frozenset[str]]:
    """The simulator without what it has too much of, the recordings beside it, what it has beyond
    Poisson-Gaussian noise then, what of that goes into what is handed back, and mechanisms of which it still
    has too much. Of what is no camera model only what is handed back is changed."""
    if not too_much:
        return judged, raw, own, own, frozenset()
    share = shares(too_much, judged.model)
    less = with_less(judged, share, key)
    if less is None:
        return judged, raw, own, at_shares(own, share), frozenset(e.mechanism for e in too_much)
    again = splits_of(less.capture, less.stated, less.drawn, searched(entries))
    own = own_effects(less.drawn, entries, less.own_names(allowed, entries), log_alpha)
    return less, again, own, own, frozenset()


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


def contrasts(prepared: Prepared) -> int:
    """Number of contrasts between frames."""
    return sum(len(f.contrasts) for f in prepared.fields)
