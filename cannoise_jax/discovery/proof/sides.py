"""The simulator before and after, as draws: what was judged, and what was found added to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.frames.battery import Prepared
from cannoise_jax.discovery.frames.draws import Drawing, drawing
from cannoise_jax.discovery.frames.simulate import Simulator, codes_of
from cannoise_jax.discovery.frames.simulated import drawn_parameters
from cannoise_jax.discovery.search.maps import last_draw
from cannoise_jax.discovery.search.model import baseline_model, extended_model
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.pedestal import with_pedestals
from cannoise_jax.discovery.search.steps import Step
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet

Drawings = Callable[[Key[Array, ""]], Drawing]
"""A simulator's draws by key."""
Ratio = Callable[[int, np.ndarray], np.ndarray | None]
"""(number of the recording, clean signal) -> standard deviation of the noise wanted over that drawn."""


class Sides(NamedTuple):
    """plain: the simulator that was judged. extended: with everything found; None: nothing was. less: the
    extended one without each finding, where it has no likelihood. control: the fitted baseline. exported: the
    extended camera model. likelihood: whether the simulator has one. calibrated: whether it is the baseline
    itself. model: the judged simulator where it is a camera model. bare: the fitted baseline. of:
    the camera model with some of the findings alone. level: adds to it where its darks lie, exposure by
    exposure; a camera model that was handed over has the levels that it has. lowered: whether `of` starts
    from less than what was judged, which has too much of something."""

    plain: Drawings
    extended: Drawings | None
    less: tuple[Drawings, ...]
    control: Drawings
    exported: SensorModel
    likelihood: bool
    calibrated: bool
    model: SensorModel | None
    bare: SensorModel
    of: Callable[..., SensorModel]
    level: Callable[[SensorModel], SensorModel]
    lowered: bool


def as_it_is(model: SensorModel) -> SensorModel:
    """The model with the levels that it has."""
    return model


def of_model(model: SensorModel) -> Drawings:
    """Draws of a camera model by key."""
    return lambda key: drawing(model, key)


def simulators(
    capture: CaptureSet, first: Prepared, steps: tuple[Step, ...], stated: tuple | None = None
) -> Sides:
    """Of a run on Poisson-Gaussian noise, calibrated or with gain and read noise as `stated`."""
    plain, bare = baseline_model(capture, first, stated), baseline_model(capture, first)
    of = partial(extended_model, capture, first, drawn=last_draw())
    level = partial(with_pedestals, prepared=first)
    model = level(of(steps)) if steps else of(steps)
    extended = of_model(model) if steps else None
    calibrated = stated is None
    control = of_model(bare)
    return Sides(
        plain=of_model(plain), extended=extended, less=(), control=control, exported=model,
        likelihood=True, calibrated=calibrated, model=plain, bare=bare, of=of, level=level, lowered=False,
    )  # fmt: skip


def handed_simulators(
    capture: CaptureSet,
    first: Prepared,
    steps: tuple[Step, ...],
    own: tuple[Step, ...],
    *,
    handed: Simulator,
    drawn: CaptureSet,
    given: SensorModel | None,
    less: bool,
) -> Sides:
    """Of a simulator that was handed over, of which frames like the recordings were drawn. A camera model is
    extended itself; given: as it was, where it had too much of something. For a function or generator what is
    exported, and drawn from, is the baseline with `own`, what its draws showed beyond that, and the findings.
    less: whether it had too much of something."""
    bare = baseline_model(capture, first)
    control = of_model(bare)
    if handed.model is not None:
        of = partial(extended_model, capture, first, start=handed.model, drawn=last_draw())
        model, judged = of(steps), handed.model if given is None else given
        changed = bool(steps) or judged is not handed.model
        extended = of_model(model) if changed else None
        return Sides(
            plain=of_model(judged), extended=extended, less=(), control=control, exported=model,
            likelihood=True, calibrated=False, model=judged, bare=bare, of=of, level=as_it_is,
            lowered=given is not None,
        )  # fmt: skip

    def plain(key: Key[Array, ""]) -> Drawing:
        return codes_of(handed.draw, capture, key, first.step, handed.dark)

    def beside_own(some: tuple[Step, ...]) -> SensorModel:
        return with_pedestals(extended_model(capture, first, (*own, *some)), prepared=first)

    stated = drawn_parameters(drawn, first.baselines, first.step)

    def without(gone: Step) -> SensorModel:
        model = beside_own(tuple(s for s in steps if s is not gone))
        kind = gone.named.signature.restates if gone.named.mechanism != UNKNOWN else None
        return model if kind is None else as_stated(model, baseline_model(capture, first, stated), kind)

    each = tuple(of_model(without(gone)) for gone in steps)
    exported = beside_own(steps)
    extended = of_model(exported) if steps or less else None
    return Sides(
        plain=plain, extended=extended, less=each, control=control, exported=exported,
        likelihood=False, calibrated=False, model=None, bare=bare, of=beside_own, level=as_it_is,
        lowered=False,
    )  # fmt: skip


def as_stated(model: SensorModel, stated: SensorModel, kind: str) -> SensorModel:
    """The model with the gain, or the read noise in DN, of another one."""
    gain, read = np.asarray(model.gain_dn_per_e), np.asarray(model.read_noise_e)
    theirs, noise = np.asarray(stated.gain_dn_per_e), np.asarray(stated.read_noise_e)
    if kind == "gain":
        return dataclasses.replace(model, gain_dn_per_e=theirs, read_noise_e=read * gain / theirs)
    return dataclasses.replace(model, read_noise_e=noise * theirs / gain)
