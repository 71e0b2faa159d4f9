"""What a diagnosis costs: recordings of a camera with and without an effect, and a run of the command in a
process of its own, by the side of one pass over the same frames with NumPy."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from cannoise_jax.mechanisms.peers import GETFRAMES
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording

SIZE, FRAMES = (256, 384), 8
"""Rows and columns of a frame, and frames of a recording: with three of them 2.36 megapixel-frames."""
GAIN, READ_E, BLACK, WHITE = 0.8, 2.5, 200.0, 4095.0
LEVELS = {"dark_10ms": 0.0, "flat_dim": 0.1, "flat_bright": 0.6}
"""Light of the recordings, normalised."""
EFFECT = "fixed offsets"
"""Of the camera that has one, as `peers.GETFRAMES` has it."""
_CACHE = ("JAX_COMPILATION_CACHE", "JAX_PERSISTENT_CACHE")


class Run(NamedTuple):
    """One run of the command: seconds, seconds of all cores, and most memory, MiB."""

    seconds: float
    cpu: float
    mib: float


class Cost(NamedTuple):
    """Of a set: millions of pixels in all frames; what it cost with nothing compiled and again, and the
    seconds of a NumPy pass, which takes mean and variance of every pixel."""

    megapixels: float
    cold: Run
    warm: Run
    numpy: float


def camera(effect: str | None = None) -> SensorModel:
    """A camera of 12 bits, with an effect of `peers.GETFRAMES` or with none."""
    model = SensorModel.poisson_gaussian(GAIN, READ_E, BLACK, WHITE, "MONO")
    for id, parameters in (GETFRAMES[effect][0] if effect else {}).items():
        model = model.with_mechanism(id, **parameters)  # type: ignore[arg-type]
    return model


def write_set(folder: Path, model: SensorModel) -> None:
    """Recordings of the camera: darks and flats at two levels."""
    for number, (name, level) in enumerate(LEVELS.items()):
        settings = Settings(exposure_s=0.01, frames=FRAMES)
        clean = np.full(SIZE, level, np.float32)
        frames = np.asarray(model.sample(jax.random.key(number), clean, settings))
        shot = Recording(
            frames, "MONO", (BLACK,) * 4, WHITE, "bench", "flat" if level else "dark", exposure_s=0.01
        )
        write_recording(folder / f"{name}.h5", shot)


def cost(recordings: Path, folder: Path, flags: Sequence[str] = ()) -> Cost:
    """What a diagnosis of a capture set costs; folder: for what it writes and compiles. Raises BadInput where
    it is refused."""
    capture = load_capture_set(recordings)
    pixels = sum(r.count * r.size[0] * r.size[1] for r in capture.recordings) / 1e6
    # With a cache of its own: what was compiled before would be found.
    own = {k: v for k, v in os.environ.items() if not k.startswith(_CACHE)}
    own["XDG_CACHE_HOME"] = str(folder.resolve() / "cache")
    asked = ["--recordings", str(recordings), "--out", str(folder / "report"), "--force", *flags]
    cold, warm = (_run(asked, own) for _ in (0, 1))
    return Cost(pixels, cold, warm, numpy_pass(capture))


def _run(flags: Sequence[str], environment: dict[str, str]) -> Run:
    command = [sys.executable, "-m", "cannoise_jax.commands.start", "diagnose", *flags]
    start = time.perf_counter()
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    ) as child:
        assert child.stderr is not None
        said = child.stderr.read().decode(errors="replace").strip().splitlines()
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise BadInput(f"diagnose: {said[-1] if said else f'ended with status {child.returncode}'}")
    return Run(time.perf_counter() - start, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)


def numpy_pass(capture: CaptureSet) -> float:
    """Seconds of one pass over frames in memory: mean and variance of every pixel of every recording; the
    best of three."""
    held = [dataclasses.replace(r, frames=np.asarray(r.frames[:])) for r in capture.recordings]
    best = np.inf
    for _ in range(3):
        start = time.perf_counter()
        for r in held:
            r.frames.mean(0), r.frames.var(0)  # type: ignore[union-attr]
        best = min(best, time.perf_counter() - start)
    return best
