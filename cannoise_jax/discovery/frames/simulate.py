"""Simulators as they are handed over: anything that draws frames becomes a capture set like the recordings.

What a simulator already has is found on its own draws, by the battery that looks at the recordings, and is
then taken out of the recordings with the simulator's own strengths; what is left is the mismatch. So a sensor
model, a trained generator and a user's function are judged alike, with or without a likelihood.
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.discovery.frames.calibrate import gain_groups
from cannoise_jax.discovery.frames.contrasts import MOST_FRAMES, code_step, stack
from cannoise_jax.discovery.frames.dust import beside_dust
from cannoise_jax.discovery.frames.smooth import smooth_mean
from cannoise_jax.discovery.frames.splits import split_recordings
from cannoise_jax.model_file import load_model
from cannoise_jax.physics.core.mechanism import HasRecord
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import baseline_at, black_at, settings_of
from cannoise_jax.recordings.packing import pack, unpack
from cannoise_jax.recordings.recording import DARK, LIT, BadInput, CaptureSet, Recording, iso_numbers
from cannoise_jax.sampling import SMALLEST, Model, of_camera, sample_noise

_ALONE = threading.Lock()
"""Held by whoever calls a function of someone else, which need not bear two calls at once."""
Draw = Callable[[Key[Array, ""], Float[Array, "h w"], Settings], Any]
"""(key, clean mosaic, normalised, settings) -> DN, `[H, W]` or `[T, H, W]`."""


class Simulator(NamedTuple):
    """A simulator that was handed over: its name, how it draws, whether it also draws darks, and the camera
    model that it is, if it is one."""

    label: str
    draw: Draw
    dark: bool
    model: SensorModel | None = None


def open_simulator(
    simulator: str | Path | SensorModel | Draw, capture: CaptureSet, mechanisms: Sequence[HasRecord] = ()
) -> Simulator:
    """The simulator of a model, a function, a sensor.json or a training folder. mechanisms: entries from
    outside the package that a sensor.json may name. Raises BadInput for what is none."""
    if isinstance(simulator, SensorModel):
        label = "sensor model" if simulator.camera == SensorModel.camera else simulator.camera
        return Simulator(label, simulator.sample, True, simulator)
    if callable(simulator):
        return Simulator(getattr(simulator, "__name__", "function"), simulator, True)
    if not isinstance(simulator, (str, Path)):
        raise TypeError(
            f"simulator is a {type(simulator).__name__}: expected a SensorModel, a function (key, clean, "
            "settings) -> DN, or the name of a sensor.json, a training folder, poisson-gaussian or nlf"
        )
    path = Path(simulator)
    if path.suffix == ".json" and path.is_file():
        model = SensorModel.load(path, mechanisms)
        return Simulator(str(path), model.sample, True, model)
    if path.exists():
        trained = load_model(path)
        if getattr(trained, "exposure_s", None) is not None:
            return Simulator(str(path), _at_exposure(path, trained, capture), True)
        return Simulator(str(path), _generator(path, trained, capture), False)
    raise BadInput(
        f"{simulator}: no such simulator: poisson-gaussian, nlf, a sensor.json, or a training folder"
    )


def check_file(simulator: str | Path, mechanisms: Sequence[HasRecord] = ()) -> None:
    """Reads the file or folder of a simulator. mechanisms: see `open_simulator`. Raises BadInput for what is
    none."""
    path = Path(simulator)
    if path.suffix == ".json" and path.is_file():
        SensorModel.load(path, mechanisms)
    else:
        load_model(path)


def _at_exposure(path: Path, model: Model, capture: CaptureSet) -> Draw:
    """A generator that starts from a camera model at one exposure: darks included. Frames of other exposures,
    of which it learned nothing, are that camera model's own."""
    try:
        model = of_camera(model, capture.camera)
    except ValueError as error:
        raise BadInput(f"{path}: {error}") from error
    sensor, exposure_s = model.sensors[0], float(model.exposure_s or 0)
    sample, reference = jax.jit(sample_noise), jnp.zeros((SMALLEST, SMALLEST, 4))

    def draw(key, clean, settings: Settings):
        if not np.isclose(settings.exposure_s, exposure_s, rtol=1e-3):
            return sensor.placed(np.shape(clean)).sample(key, clean, settings)
        black = float(np.mean(np.asarray(black_at(sensor, settings.iso))))
        span = float(np.asarray(sensor.white_level)) - black
        height, width = clean.shape
        more = [(0, max(-n % 4, 2 * SMALLEST - n)) for n in clean.shape]
        packed = pack(jnp.asarray(np.pad(np.asarray(clean), more, mode="reflect")), sensor.cfa)
        gain, _ = baseline_at(sensor, settings.iso)
        noise = sample(model, key, packed, reference, (jnp.mean(gain) / span, 0.0))
        noisy = jnp.clip(packed + noise, -black / span, 1)
        return black + span * np.asarray(unpack(noisy, sensor.cfa))[:height, :width]

    return draw


def _generator(path: Path, model: Model, capture: CaptureSet) -> Draw:
    """A trained generator, conditioned on frames that look for effects, never on those that prove."""
    if model.level == "given":
        raise BadInput(f"{path}: this model must be told its level: train it with config.level=both")
    lit = capture.of_kind(*LIT)
    if not lit:
        raise BadInput(f"{path}: a trained generator is judged on scenes and flats: record some")
    looking = [r for r, (a, _) in zip(capture.recordings, split_recordings(capture), strict=True) if a]
    shown = [r for r in looking if r.kind in LIT and r.size == lit[0].size] or lit[:1]
    isos = iso_numbers(gain_groups(capture))
    # By setting: the model reads the level of the noise off them.
    references: dict[tuple[float, float], list[Any]] = {}
    for r in shown:
        setting = isos[r.iso], settings_of(r, isos[r.iso], 1).exposure_s
        references.setdefault(setting, []).append(jnp.asarray(_packed_frame(r)))
    cfa = lit[0].cfa

    levels = {isos[r.iso]: (float(np.mean(r.black_level)), float(r.white_level)) for r in reversed(lit)}
    sample = jax.jit(sample_noise)

    def draw(key, clean, settings: Settings):
        height, width = clean.shape
        # Mirrored on to a size that the networks take, which keeps the order of the colours.
        more = [(0, max(-n % 4, 2 * SMALLEST - n)) for n in clean.shape]
        packed = pack(jnp.asarray(np.pad(np.asarray(clean), more, mode="reflect")), cfa)
        wanted = (float(settings.iso), float(settings.exposure_s))
        nearest = min(references, key=lambda have: _distance(have, wanted))
        black, white = levels[min(levels, key=lambda iso: abs(np.log2(iso / settings.iso)))]
        span = white - black
        # What lies below black is kept, as a sensor keeps it.
        noise = sample(model, key, packed, jnp.stack(references[nearest][:4]))
        noisy = jnp.clip(packed + noise, -black / span, 1)
        return black + span * np.asarray(unpack(noisy, cfa))[:height, :width]

    return draw


def _distance(have: tuple[float, float], wanted: tuple[float, float]) -> tuple[float, float]:
    """How far two settings are: first in gain, then in exposure, octaves."""
    return abs(np.log2(have[0] / wanted[0])), abs(np.log2(have[1] / wanted[1]))


def _packed_frame(recording: Recording) -> np.ndarray:
    frame = np.asarray(recording.frames[0:1])[0].astype(np.float32)
    black = recording.black_map()
    height, width = (n - n % 2 for n in recording.size)
    values = (frame - black) / (recording.white_level - black)
    return np.asarray(pack(values[:height, :width], recording.cfa))


def codes_of(
    draw: Draw, capture: CaptureSet, key: Key[Array, ""], step: float, dark: bool
) -> Callable[[int, np.ndarray, Settings], np.ndarray | None]:
    """Draws of a function as stored codes, `uint16[T, H, W]` by number of the recording: as many calls as
    frames where it returns one frame a call, rounded to the step and clipped at the rails. None for darks
    unless it draws `dark`.

    Raises BadInput when frames come back in another size or number, or with values that are not finite.
    """

    def codes(number: int, clean: np.ndarray, settings: Settings) -> np.ndarray | None:
        recording = capture.recordings[number]
        if recording.kind in DARK and not dark:
            return None
        own = jax.random.fold_in(key, number)
        given = jnp.asarray(clean)
        with _ALONE:
            frames = _drawn_dn(draw(own, given, settings))
            if frames.ndim == 2:
                more = [draw(jax.random.fold_in(own, t), given, settings) for t in range(1, settings.frames)]
                frames = np.stack([frames, *map(_drawn_dn, more)])
        if frames.shape != (settings.frames, *recording.size):
            raise BadInput(
                f"simulator: drew frames of shape {frames.shape}: it must return finite DN of the size of "
                f"clean, {recording.size}, one frame or all {settings.frames}"
            )
        if not np.isfinite(frames).all():
            raise BadInput("simulator: drew values that are not finite: it must return finite DN")
        highest = np.floor(min(recording.white_level, 65535.0) / step) * step
        return np.clip(np.round(frames / step) * step, 0, highest).astype(np.uint16)

    return codes


def _drawn_dn(value: Any) -> np.ndarray:
    try:
        return np.asarray(value, np.float64)
    except (TypeError, ValueError) as error:
        raise BadInput(
            f"simulator: returned a {type(value).__name__}: it must return an array of DN"
        ) from error


def simulate_like(capture: CaptureSet, draw: Draw, key: Key[Array, ""], dark: bool) -> CaptureSet:
    """As many frames as every recording has, at its settings and of its clean signal, rounded and clipped.

    Recordings whose signal is not known (a scene without a reference) are left out, darks too unless `dark`.
    Raises BadInput for what `codes_of` refuses, and for frames without noise.
    """
    step = code_step(capture)
    codes = codes_of(draw, capture, key, step, dark)
    isos = iso_numbers(gain_groups(capture))
    out = []
    for n, (recording, (look, _)) in enumerate(
        zip(capture.recordings, split_recordings(capture), strict=True)
    ):
        clean = expected_signal(recording, n, step, look)
        if clean is None:
            continue
        settings = settings_of(recording, isos[recording.iso], min(recording.count, MOST_FRAMES))
        frames = codes(n, clean, settings)
        if frames is None:
            continue
        if len(frames) > 1 and (frames == frames[0]).all():
            name = recording.path or recording.kind
            raise BadInput(
                f"simulator: draws one and the same frame for {name}: there is no noise of it to judge; "
                "give one that draws noise by its key, in DN"
            )
        out.append(
            dataclasses.replace(recording, frames=frames, clean=clean.astype(np.float32), code_step=step)
        )
    if not out:
        raise BadInput("simulator: none of the recordings has a signal that it could draw: record flats")
    return CaptureSet(capture.camera, tuple(out), capture.path)


def expected_signal(recording: Recording, number: int, step: float, look: list[int]) -> np.ndarray | None:
    """Normalised noise-free signal: 0 for darks, the reference, or the smooth surface of a flat."""
    if recording.kind in DARK:
        return np.zeros(recording.size, np.float32)
    if recording.clean is not None:
        clean = np.asarray(recording.clean, np.float32)
        return clean.mean(0) if clean.ndim == 3 else clean
    if recording.kind != "flat":
        return None
    black = recording.black_map()
    mean = smooth_mean(beside_dust([stack(recording, number, look or [0], step)])[0])
    return np.maximum((mean - black) / (recording.white_level - black), 0).astype(np.float32)
