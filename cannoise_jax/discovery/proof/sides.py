"""The simulator before and after, as draws: what was judged, and what was found added to it."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Key

from cannoise_jax.discovery.frames.battery import Prepared, drawn_parameters
from cannoise_jax.discovery.frames.draws import Drawing, changed, drawing
from cannoise_jax.discovery.frames.simulate import Simulator, codes_of
from cannoise_jax.discovery.search.fit import Step
from cannoise_jax.discovery.search.maps import last_draw
from cannoise_jax.discovery.search.model import baseline_model, extended_model
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.pedestal import with_pedestals
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.fields import channel_index

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
    exposure; a camera model that was handed over has the levels that it has."""

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
    level: Callable[[SensorModel], SensorModel] = lambda model: model


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
    return Sides(of_model(plain), extended, (), control, model, True, calibrated, plain, bare, of, level)


def handed_simulators(
    capture: CaptureSet,
    first: Prepared,
    steps: tuple[Step, ...],
    own: tuple[Step, ...],
    handed: Simulator,
    drawn: CaptureSet,
) -> Sides:
    """Of a simulator that was handed over. A camera model is extended itself. A function or generator keeps
    its own draws, changed by what the findings change in a camera model; what is exported for it is the
    baseline with `own`, what its draws showed beyond that, and the findings."""
    bare = baseline_model(capture, first)
    control = of_model(bare)
    if handed.model is not None:
        of = partial(extended_model, capture, first, start=handed.model, drawn=last_draw())
        model = of(steps)
        extended = of_model(model) if steps else None
        return Sides(
            of_model(handed.model), extended, (), control, model, True, False, handed.model, bare, of
        )
    parameters = drawn_parameters(drawn, first.baselines, first.step)

    def plain(key: Key[Array, ""]) -> Drawing:
        return codes_of(handed.draw, capture, key, first.step, handed.dark)

    def changed_by(some: tuple[Step, ...]) -> Drawings:
        model = extended_model(capture, first, some)
        restated = {s.named.signature.restates for s in some if s.named.mechanism != UNKNOWN}
        ratio = noise_ratio(capture, first, parameters, "gain" in restated, "read" in restated)

        def draws(key: Key[Array, ""]) -> Drawing:
            own_key, same = jax.random.split(key)
            scaled = rescaled(plain(own_key), capture, first, ratio)
            return (
                scaled if not model.mechanisms else changed(scaled, drawing(bare, same), drawing(model, same))
            )

        return draws

    less = tuple(changed_by(tuple(s for s in steps if s is not gone)) for gone in steps)

    def beside_own(some: tuple[Step, ...]) -> SensorModel:
        return extended_model(capture, first, (*own, *some))

    extended = changed_by(steps) if steps else None
    exported = beside_own(steps)
    return Sides(plain, extended, less, control, exported, False, False, None, bare, beside_own)


def noise_ratio(capture: CaptureSet, first: Prepared, drawn: tuple, gain_too: bool, read_too: bool) -> Ratio:
    """How much noisier the recordings are than the draws by their wrong gain, read noise or both; `drawn`:
    gain (DN/e-) and read noise (DN) of the draws per gain setting."""
    order = {b.iso: n for n, b in enumerate(first.baselines)}

    def ratio(number: int, clean: np.ndarray) -> np.ndarray | None:
        recording = capture.recordings[number]
        n = order[recording.iso]
        gain, read = drawn[n]
        if gain is None or not (gain_too or read_too):
            return None
        channel = channel_index(clean.shape)
        baseline = first.baselines[n]
        signal = clean * (recording.white_level - np.mean(baseline.black_level))
        have = gain[channel] * signal + read[channel] ** 2
        better = (baseline.gain if gain_too else gain)[channel] * signal
        wanted = better + (baseline.read_noise if read_too else read)[channel] ** 2
        return np.sqrt(wanted / np.maximum(have, 1e-9))

    return ratio


def rescaled(base: Drawing, capture: CaptureSet, first: Prepared, ratio: Ratio) -> Drawing:
    """Draws with their noise about the expected value stretched, rounded to codes again."""

    def draw(number: int, clean, settings) -> np.ndarray | None:
        frames, factor = base(number, clean, settings), ratio(number, clean)
        if frames is None or factor is None:
            return frames
        recording = capture.recordings[number]
        expected = recording.black_map() + clean * (recording.white_level - recording.black_map())
        values = expected + factor * (frames - expected)
        highest = np.floor(min(recording.white_level, 65535.0) / first.step) * first.step
        return np.clip(np.round(values / first.step) * first.step, 0, highest).astype(np.uint16)

    return draw
