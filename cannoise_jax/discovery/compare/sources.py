"""What is compared with the recordings: anything that draws frames, or a folder of frames drawn already.

A source gives sets of frames, one frame stack per recording and set. Models draw new frozen patterns in every
set where none were measured, so that a set is another unit of the camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key, UInt16

from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.contrasts import code_step
from cannoise_jax.discovery.frames.draws import drawing
from cannoise_jax.discovery.frames.simulate import Draw, codes_of, open_simulator
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.mechanisms.outside import function_at
from cannoise_jax.physics.core.mechanism import HasRecord
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import black_at
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

Frames = UInt16[np.ndarray, "t h w"]


class Source(NamedTuple):
    """A simulator to compare with.

    frames(set, number, clean, settings): its frames of one recording; None for one that it does not draw.
    sets: how many it can give; None: any number.
    black (of an ISO), white: its own levels, DN; None: those of the recordings.
    read, gain: variance of the read noise (DN^2) and gain (DN/e-) of a camera model's first gain setting.
    """

    label: str
    frames: Callable[[int, int, Float[np.ndarray, "h w"], Settings], Frames | None]
    sets: int | None = None
    black: Callable[[float], Float[np.ndarray, "4"]] | None = None
    white: float | None = None
    read: float | None = None
    gain: float | None = None


def open_source(
    simulator: str | Path | SensorModel | CaptureSet | Draw,
    capture: CaptureSet,
    key: Key[Array, ""],
    mechanisms: Sequence[HasRecord] = (),
) -> Source:
    """The source of a model, a function or `module:function`, a sensor.json, a training folder, a capture set
    of simulated frames or a folder of them, or 'poisson-gaussian', calibrated from the recordings.
    mechanisms: entries from outside the package that a sensor.json may name.

    Raises BadInput for what is none.
    """
    if isinstance(simulator, CaptureSet):
        return _recorded(simulator, capture)
    if isinstance(simulator, SensorModel):
        return modelled(simulator, key)
    if isinstance(simulator, str) and simulator == "poisson-gaussian":
        prepared = prepare(capture, all_frames(split_recordings(capture)), False)
        return modelled(baseline_model(capture, prepared), key)._replace(label=simulator)
    if isinstance(simulator, str) and ":" in simulator and not Path(simulator).exists():
        draw: Draw = function_at(simulator)
        simulator = draw
    elif isinstance(simulator, (str, Path)) and Path(simulator).is_dir() and _holds_frames(Path(simulator)):
        return _recorded(load_capture_set(simulator), capture)._replace(label=str(simulator))
    opened = open_simulator(simulator, capture, mechanisms)
    if opened.model is not None:
        return modelled(opened.model, key)._replace(label=opened.label)
    step = code_step(capture)

    def frames(number_of_set: int, number: int, clean, settings: Settings):
        own = jax.random.fold_in(key, number_of_set)
        return codes_of(opened.draw, capture, own, step, opened.dark)(number, clean, settings)

    return Source(opened.label, frames)


def _holds_frames(folder: Path) -> bool:
    try:
        load_capture_set(folder)
    except BadInput:
        return False
    return True


def modelled(model: SensorModel, key: Key[Array, ""]) -> Source:
    """Draws of a sensor model; of every set those of another unit, where its maps were not measured."""

    def frames(number_of_set: int, number: int, clean, settings: Settings):
        own = dataclasses.replace(model, unit_key=jax.random.fold_in(model.unit_key, number_of_set))
        return drawing(own, jax.random.fold_in(key, number_of_set))(number, clean, settings)

    def black(iso: float) -> Float[np.ndarray, "4"]:
        return np.asarray(black_at(model, iso), float)

    white, gain = float(np.asarray(model.white_level)), np.asarray(model.gain_dn_per_e)[0]
    read = float(np.mean((gain * np.asarray(model.read_noise_e)[0]) ** 2))
    return Source(model.camera, frames, None, black, white, read=read, gain=float(np.mean(gain)))


def shaded(source: Source, shades: Mapping[int, Float[np.ndarray, "h w"]]) -> Source:
    """The source under lights with shadows of dust in them, by number of the recording as shares of it: the
    smooth surface of a flat holds none, and they are no mismatch."""
    if not shades:
        return source

    def frames(number_of_set: int, number: int, clean, settings: Settings):
        lit = clean * (1 + shades[number]) if number in shades else clean
        return source.frames(number_of_set, number, np.asarray(lit, np.float32), settings)

    return source._replace(frames=frames)


def _recorded(simulated: CaptureSet, capture: CaptureSet) -> Source:
    """Frames drawn already, matched to the recordings by kind and settings, in the order of both where
    several are alike."""
    matched: dict[int, Recording] = {}
    free = list(simulated.recordings)
    for number, r in enumerate(capture.recordings):
        alike = [s for s in free if _settings(s) == _settings(r)]
        named = [s for s in alike if s.path and r.path and Path(s.path).stem == Path(r.path).stem]
        if named or alike:
            matched[number] = (named or alike)[0]
            free = [s for s in free if s is not matched[number]]
    if not matched:
        raise BadInput(
            f"{simulated.path or 'simulated frames'}: no recording of the kind, exposure, ISO and size of "
            f"any of {capture.path or 'the recordings'}: simulate those settings"
        )
    sets = min(max(matched[n].count // max(min(capture.recordings[n].count, 16), 1), 1) for n in matched)

    def frames(number_of_set: int, number: int, clean, settings: Settings):
        if number not in matched:
            return None
        mine = matched[number]
        count = min(settings.frames, mine.count)
        start = number_of_set * count
        return np.asarray(mine.frames[start : start + count])

    return Source(simulated.path or simulated.camera, frames, sets)


def _settings(r: Recording) -> tuple:
    return (r.kind, r.size, r.exposure_s, r.iso, r.temperature_c)
