"""Half-real recordings: a known scene, computed shot noise, and the floor of a real camera.

A dark frame holds everything that a camera adds without light: read noise, its tails, rows, hot pixels, clamp
and codes. Adding counted photons of a known scene to it gives a recording with real dark structure whose
clean signal is known exactly.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from cannoise_jax.physics.core.poisson_gaussian import sample_poisson
from cannoise_jax.recordings.codes import detect_code_step
from cannoise_jax.recordings.recording import BadInput, Recording


def half_real_recording(
    key: Key[Array, ""], clean: Float[np.ndarray, "h w"], dark: Recording, gain_dn_per_e: float
) -> Recording:
    """Every frame of `dark` with the photons of `clean` (mosaic, normalised) on top: a scene recording.

    frames = dark + K Poisson(clean (white - black) / K), rounded to the camera's code step and clipped at the
    white level. `clean` is cut to the size of the frames, or must be as large. The dark signal of a long
    exposure is not part of `clean`. gain_dn_per_e: the system gain K; shot is known from it, read is not.
    Raises BadInput for a scene smaller than the frames or a gain that is not positive.
    """
    height, width = dark.size
    if clean.shape[0] < height or clean.shape[1] < width:
        raise BadInput(
            f"{dark.path or dark.camera}: frames of {height} x {width} need a scene at least as large, "
            f"got {clean.shape[0]} x {clean.shape[1]}"
        )
    if not gain_dn_per_e > 0:
        raise BadInput(f"{dark.path or dark.camera}: the system gain must be positive, got {gain_dn_per_e}")
    clean = np.asarray(clean[:height, :width], np.float32)
    span = np.float32(dark.white_level) - dark.black_map()
    floor = np.asarray(dark.frames[0 : dark.count])
    mean_e = jnp.asarray(clean * span / np.float32(gain_dn_per_e))
    charge = sample_poisson(key, jnp.broadcast_to(mean_e, floor.shape))
    step = dark.code_step if dark.code_step is not None else detect_code_step(floor)
    step = step or 1.0
    signal = np.round(np.asarray(charge) * gain_dn_per_e / step) * step
    codes = np.minimum(floor + signal, np.floor(dark.white_level / step) * step)
    shot = gain_dn_per_e / (dark.white_level - np.asarray(dark.black_level))
    return dataclasses.replace(
        dark,
        frames=codes.astype(np.uint16),
        kind="scene",
        clean=clean,
        shot=(float(shot[0]), float(shot[1]), float(shot[2]), float(shot[3])),
        read=None,
        code_step=step,
        reference="independent",
        reference_frames=None,
    )
