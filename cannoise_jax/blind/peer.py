"""A second engine: frames by `getframes`, which others wrote, so that no code recognises itself.

It draws light, charge, read noise and converter and the effects it knows; two that it lacks, row noise and
a difference between the greens, are added to its input and output. Installed with the extra `blind`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from cannoise_jax.blind.chain import Camera, Context, Effect, Shot, digitise
from cannoise_jax.recordings.recording import BadInput

OPTIONS: dict[str, Callable[[float, Camera], dict[str, Any]]] = {
    "prnu": lambda a, c: {"prnu": a},
    "dsnu": lambda a, c: {"bias_pixel_spread_adu": a},
    "pixel_read_noise_map": lambda a, c: {"read_noise_nonuniformity": a},
    "crosstalk": lambda a, c: {"ipc_coupling": a / 4},
    "nonlinearity": lambda a, c: {"nonlinearity": a, "full_well_e": float(c.electrons(np.ones(1))[0])},
    "amplifier_mismatch": lambda a, c: {
        "amplifier_layout": (1, 2),
        "amplifier_offsets_adu": (-a / 2, a / 2),
    },
    "dark_current": lambda a, c: {"dark_current_e_per_s": a},
}
"""What getframes does by itself: amplitude (DN in units of its converter) and camera -> its settings."""
ADDED = ("row_noise", "green_imbalance")
"""What is added to it."""
MARGIN = 2
"""Pixels around the frame, cut off: getframes lets charge that couples out of the array disappear."""


def able(mechanisms: tuple[str, ...]) -> bool:
    """Whether this engine makes all of these effects."""
    return all(m in OPTIONS or m in ADDED for m in mechanisms)


def expose(camera: Camera, shot: Shot, effects: tuple[Effect, ...], rng: np.random.Generator) -> np.ndarray:
    """Records `shot` by getframes: `uint16[T, H, W]`. Raises BadInput where it is not installed."""
    try:
        import getframes
    except ImportError as error:
        raise BadInput("getframes is not installed: pip install 'cannoise-jax[blind]'") from error
    outside = [e for e in effects if e.mechanism in ADDED]
    # Where noise is added after it, its own converter gets 64 codes to one of the camera's.
    unit = camera.step / 64 if any(e.mechanism == "row_noise" for e in outside) else camera.step
    expected = camera.electrons(shot.clean)
    context = Context(camera, shot, rng, expected)
    rate = expected / shot.exposure_s
    for effect in outside:
        if effect.stage == "photons":
            rate = effect.apply(rate, context)
    options: dict[str, Any] = {"full_well_e": 1e9, "dark_current_e_per_s": 0.0}
    for effect in effects:
        if effect.mechanism in OPTIONS:
            in_unit = effect.amplitude / (unit if effect.mechanism in ("dsnu", "amplifier_mismatch") else 1)
            options |= OPTIONS[effect.mechanism](in_unit, camera)
    height, width = expected.shape
    config = getframes.CameraConfig(
        name="camera",
        sensor_type=getframes.SensorType.CMOS,
        resolution=(height + 2 * MARGIN, width + 2 * MARGIN),
        pixel_size_um=3.0,
        quantum_efficiency=1.0,
        bit_depth=int(np.ceil(np.log2(camera.white / unit + 1))),
        gain_e_per_adu=unit / camera.gain,
        bias_offset_adu=camera.black[0] / unit,
        read_noise_e=camera.read_e,
        fixed_pattern_seed=camera.unit,
        **options,
    )
    source = getframes.Camera(config, seed=int(rng.integers(2**31)))
    padded = np.pad(rate, MARGIN, mode="symmetric")
    inner = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    frames = [
        source.expose(
            padded, shot.exposure_s, config.dark_current_ref_temp_c, include_truth=False
        ).data[inner]
        for _ in range(shot.frames)
    ]  # fmt: skip
    values = np.stack(frames).astype(np.float64) * unit
    for effect in outside:
        if effect.stage == "analog":
            values = effect.apply(values, context)
    return digitise(values, camera).astype(np.uint16)
