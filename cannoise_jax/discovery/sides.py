"""The simulator before and after, as draws: what was judged, and what was found added to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
from jaxtyping import Array, Key

from cannoise_jax.discovery.battery import Prepared
from cannoise_jax.discovery.draws import Drawing, changed, drawing
from cannoise_jax.discovery.fit import Step
from cannoise_jax.discovery.model import baseline_model, extended_model
from cannoise_jax.discovery.simulate import Simulator, codes_of
from cannoise_jax.physics.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet

Drawings = Callable[[Key[Array, ""]], Drawing]
"""A simulator's draws by key."""


class Sides(NamedTuple):
    """plain: the simulator that was judged. extended: with everything found; None: nothing was. less: the
    extended one without each finding. control: the fitted baseline. exported: the extended camera model.
    likelihood: whether the simulator has one."""

    plain: Drawings
    extended: Drawings | None
    less: tuple[Drawings, ...]
    control: Drawings
    exported: SensorModel
    likelihood: bool


def of_model(model: SensorModel) -> Drawings:
    """Draws of a camera model by key."""
    return lambda key: drawing(model, key)


def simulators(capture: CaptureSet, first: Prepared, steps: tuple[Step, ...], plain: SensorModel) -> Sides:
    """Of a run on Poisson-Gaussian noise; plain: the model that was judged, calibrated or as stated."""
    bare = baseline_model(capture, first)
    model = extended_model(capture, first, steps)
    extended = of_model(model) if steps else None
    return Sides(of_model(plain), extended, (), of_model(bare), model, True)


def handed_simulators(
    capture: CaptureSet, first: Prepared, steps: tuple[Step, ...], own: tuple[Step, ...], handed: Simulator
) -> Sides:
    """Of a simulator that was handed over. A camera model is extended itself. A function or generator keeps
    its own draws, changed by what the findings change in a camera model; what is exported for it is the
    baseline with `own`, what its draws showed beyond that, and the findings."""
    bare = baseline_model(capture, first)
    control = of_model(bare)
    if handed.model is not None:
        model = extended_model(capture, first, steps, handed.model)
        extended = of_model(model) if steps else None
        return Sides(of_model(handed.model), extended, (), control, model, True)

    def plain(key: Key[Array, ""]) -> Drawing:
        return codes_of(handed.draw, capture, key, first.step, handed.dark)

    def changed_by(some: tuple[Step, ...]) -> Drawings:
        model = extended_model(capture, first, some)

        def draws(key: Key[Array, ""]) -> Drawing:
            own_key, same = jax.random.split(key)
            return changed(plain(own_key), drawing(bare, same), drawing(model, same))

        return draws

    less = tuple(changed_by(tuple(s for s in steps if s is not gone)) for gone in steps)
    exported = extended_model(capture, first, (*own, *steps))
    return Sides(plain, changed_by(steps) if steps else None, less, control, exported, False)
