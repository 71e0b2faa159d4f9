"""The extended simulator: the baseline and every finding as a `SensorModel`, named or from the grammar.

Everything comes from the frames that looked for effects, so that the frames that prove it have had no part
in it: strengths, measured maps of frozen patterns, and the noise of the baseline, which was fitted with the
effects in it and is lowered by what they now add.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from cannoise_jax.discovery.frames.balance import balanced
from cannoise_jax.discovery.frames.battery import Prepared, first_gain
from cannoise_jax.discovery.search.dark_level import added_level
from cannoise_jax.discovery.search.maps import one_draw
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core import registry
from cannoise_jax.physics.core.grammar import Point, mechanism_from_grammar
from cannoise_jax.physics.core.mechanism import Mechanism
from cannoise_jax.physics.core.ranges import clipped
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import black_at, with_black_levels
from cannoise_jax.physics.transfer.model import measured_at
from cannoise_jax.recordings.recording import DARK, CaptureSet, per_channel
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.recorded import Stated

_SAME_LEVEL = 1e-3
"""DN that a level may differ by through rounding of single precision."""


def baseline_model(
    capture: CaptureSet, prepared: Prepared, stated: tuple[Stated | None, ...] | None = None
) -> SensorModel:
    """The fitted Poisson-Gaussian baseline of the recordings; with gain and read noise as `stated` per gain
    setting where given."""
    first = capture.recordings[0]
    order = np.argsort([prepared.isos[b.iso] for b in prepared.baselines])
    gains, reads = [], []
    for n in order:
        baseline = prepared.baselines[n]
        said = None if stated is None else stated[n]
        gains.append(np.maximum((said or baseline).gain, 1e-6))
        reads.append((said or baseline).read_noise / gains[-1])
    baselines = [prepared.baselines[n] for n in order]
    return SensorModel.poisson_gaussian(
        np.stack(gains),
        np.stack(reads),
        np.stack([b.pedestal for b in baselines]),
        min(first.white_level, 65535.0),  # a wrong one may lie above every code
        first.cfa,
        iso=tuple(prepared.isos[b.iso] for b in baselines),
        code_step=prepared.step,
        camera=capture.camera,
    )


def extended_model(
    capture: CaptureSet,
    prepared: Prepared,
    steps: tuple[Step, ...],
    start: SensorModel | None = None,
    silent: Step | None = None,
    drawn: Callable[[tuple[Step, ...]], list[np.ndarray | None]] = one_draw,
) -> SensorModel:
    """The baseline of the recordings with every finding that can be simulated added, sorted along the chain.

    steps: the accepted findings. start: the camera model that was judged; what was found is added to it.
    silent: a step that is added at strength zero, so that all else is as with it. drawn(steps) -> the frozen
    map of each. Errors of the reference and its description, and what is of the capture by a mechanism from
    outside, are not the camera's: they are not in it.
    """
    bare = baseline_model(capture, prepared)
    model = bare if start is None else start
    if not steps:
        return model
    shown = zip(steps, drawn(steps), strict=True)
    added = _merged([(step, addition(step, prepared, pattern)) for step, pattern in shown], silent)
    levelled = any(a is not None and a.fitted_black for _, a in added)
    if levelled:
        model = _levelled(model, bare)
    temperature = measured_at(capture.recordings)
    names = {_id(step) for step, more in added if more is not None}
    for step, more in added:
        if more is not None:
            instead = [more.beside[id] for id in names if id in more.beside]
            more = more._replace(values={**more.values, **{k: v for d in instead for k, v in d.items()}})
            more = _silenced(step, more) if step is silent else more
            model = with_addition(model, step, more, temperature)
    if start is not None and np.size(model.iso) != np.size(bare.iso):
        return model
    measured = start is None or levelled
    return balanced(bare, _as_dark(model, bare, prepared) if measured else model, prepared)


def _as_dark(model: SensorModel, bare: SensorModel, prepared: Prepared) -> SensorModel:
    """The model, which has the black levels of the fitted baseline, with these lowered by what it adds to the
    shortest dark of each gain setting: they were measured there, with the charge of that exposure."""
    isos = [float(iso) for iso in np.asarray(model.iso)]
    levels = np.stack([np.asarray(black_at(model, iso), float) for iso in isos])
    moved = levels.copy()
    for n, iso in enumerate(isos):
        darks = [
            s
            for s in prepared.stacks
            if s.recording.kind in DARK and np.float32(prepared.isos[s.recording.iso]) == np.float32(iso)
        ]
        if not darks:
            continue
        shortest = min(darks, key=lambda s: s.recording.exposure_s or 0.0)
        r = shortest.recording
        settings = Settings(iso, r.exposure_s or 0.0, r.temperature_c)
        moved[n] -= added_level(model, bare, shortest, settings)
    return model if np.allclose(moved, levels, atol=_SAME_LEVEL) else with_black_levels(model, moved)


def _levelled(model: SensorModel, bare: SensorModel) -> SensorModel:
    """The model with the black levels of another one."""
    levels = np.stack([np.asarray(black_at(bare, iso)) for iso in np.asarray(model.iso)])
    return with_black_levels(model, levels)


def _merged(
    added: list[tuple[Step, Addition | None]], silent: Step | None
) -> list[tuple[Step, Addition | None]]:
    """What findings add, what another one's mechanism can hold within that. A silent one stays apart."""
    found = {_id(step): n for n, (step, more) in enumerate(added) if more is not None and step is not silent}
    out = list(added)
    for n, (step, more) in enumerate(added):
        if more is None or step is silent:
            continue
        for id, merge in more.into.items():
            at = found.get(id)
            holder = None if at is None else out[at][1]
            whole = None if holder is None else merge(holder)
            if at is not None and whole is not None:
                out[at], out[n] = (out[at][0], whole), (step, None)
                break
    return out


def addition(step: Step, prepared: Prepared, pattern: np.ndarray | None) -> Addition | None:
    """What a finding with this frozen map adds to a camera model, by its name or else by its place in the
    grammar; None: nothing."""
    found, signature = _found(step, prepared, pattern), step.named.signature
    return signature.place(found) if step.named.mechanism == UNKNOWN else signature.simulate(found)


def adds(step: Step, prepared: Prepared) -> bool:
    """Whether a finding adds anything to a camera model. One that has lost its name is in it as what it was
    called."""
    found, signature = _found(step, prepared, np.ones(prepared.fields[0].mean.shape)), step.named.signature
    ways = [signature.place if step.named.mechanism == UNKNOWN else signature.simulate]
    if step.named.doubt is not None:
        ways.append(signature.simulate)
        found = found._replace(mechanism=step.named.doubt.nearest)
    return any(way(found) is not None for way in ways)


def _found(step: Step, prepared: Prepared, pattern: np.ndarray | None) -> Found:
    score = step.named.score
    exposures = [f.exposure_s for f in prepared.fields]
    first = first_gain(prepared.baselines, prepared.isos)
    return Found(
        mechanism=step.named.mechanism,
        score=score,
        fields=step.before,
        pattern=pattern,
        gain=float(np.mean(first.gain)) or 1.0,
        read_dn=float(np.mean(first.read_noise)),
        seconds=max(e or 1.0 for e in exposures),
        longest=max(e or 0.0 for e in exposures),
        span=prepared.span,
        size=prepared.fields[0].mean.shape,
    )


def _record(id: str, point: Point | None) -> Mechanism:
    return registry.mechanism(id) if point is None else mechanism_from_grammar(point, id=id)


def _silenced(step: Step, more: Addition) -> Addition:
    """The same at strength zero, its maps likewise."""
    record = more.record or _record(_id(step), more.point)
    strength = record.scales or record.parameters[0].name
    maps = {name: 0 * np.asarray(values) for name, values in more.maps.items()}
    return more._replace(values={**more.values, strength: 0.0}, maps=maps, black_shift=None)


def _id(step: Step) -> str:
    unnamed = step.named.mechanism == UNKNOWN
    return f"{UNKNOWN}_{step.named.signature.name}" if unnamed else step.named.mechanism


def with_addition(
    model: SensorModel, step: Step, more: Addition, temperature_c: float | None = None
) -> SensorModel:
    """The model with one more mechanism, its measured strengths moved into the ranges that it can have; the
    model as it was where one of them is no number. temperature_c: at which the strengths were measured."""
    if more.black_shift is not None:
        black = per_channel(np.asarray(model.black_level) - more.black_shift)
        model = dataclasses.replace(model, black_level=np.asarray(black, np.float32))
    if more.bare:
        return model
    id, point = _id(step), more.point
    record = more.record or _record(id, point)
    values: dict = clipped(record, more.values)
    if not np.isfinite(list(values.values())).all():
        return model
    law = more.scaling or record.scaling
    if law.doubling_c is not None and law.reference_temperature_c is None:
        law = dataclasses.replace(law, reference_temperature_c=temperature_c)
    return model.with_mechanism(
        more.record or id, point=point, scaling=law, maps=more.maps, again=True, **values
    )
