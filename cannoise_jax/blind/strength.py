"""The injector's own minimum detectable effect (MDE) of every mechanism, apart from the tool under test.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, is
shifted by five null standard deviations over all frames of a set; `shifts` and `sparse` hold the laws. Of
blur (crosstalk, in_camera_denoising) only the correlation of the noise counts: that scenes are smeared
against the reference could as well be the reference's fault.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cannoise_jax.blind import shifts, sparse
from cannoise_jax.blind.chain import Camera, tile
from cannoise_jax.blind.shifts import Exposed, Law
from cannoise_jax.recordings.recording import LIT

_RANDOM: dict[str, tuple[str, shifts.Load, str, bool]] = {
    "prnu": ("lit", shifts.signal, "pixel", True),
    "column_gain": ("lit", shifts.signal, "column", True),
    "dsnu": ("all", shifts.one, "pixel", True),
    "row_fpn": ("all", shifts.one, "row", True),
    "column_fpn": ("all", shifts.one, "column", True),
    "row_noise": ("all", shifts.one, "row", False),
    "column_noise": ("all", shifts.one, "column", False),
    "offset_drift": ("all", shifts.one, "frame", False),
    # Of no listed family:
    "tile_noise": ("all", shifts.one, "tile", False),
    "row_gain_noise": ("lit", shifts.signal, "row", False),
    "diagonal_noise": ("all", shifts.one, "diagonal", False),
    "parity_jitter": ("all", shifts.one, "frame", False),
    "column_breathing": ("lit", shifts.signal, "column", False),
}
"""Random terms: recordings that show them, what they multiply, what shares a draw, whether frozen."""


def strength(mechanism: str, camera: Camera, sets: Sequence[Exposed]) -> Law | None:
    """How the shift of `mechanism` grows with its amplitude in these recordings; None: no law known here."""
    lit = [r for r in sets if r.kind in LIT]
    height, width = sets[0].electrons.shape
    full = (camera.white - np.mean(camera.black)) / camera.gain
    greens = tile((0, 1, -1, 0) if camera.cfa in ("RGGB", "BGGR") else (1, 0, 0, -1), (height, width))
    y, x = np.mgrid[:height, :width]
    radius = ((2 * y / (height - 1) - 1) ** 2 + (2 * x / (width - 1) - 1) ** 2) / 2
    if mechanism in _RANDOM:
        recordings, load, group, frozen = _RANDOM[mechanism]
        return shifts.random(camera, lit if recordings == "lit" else sets, load, group, frozen)
    match mechanism:
        case "hot_pixels":
            information = sum(r.frames * float(np.mean(r.exposure**2 / r.variance(camera))) for r in sets)
            return sparse.hot(information, height * width)
        case "rts":
            dark = min(float(np.mean(r.variance(camera))) for r in sets)
            alike = sum(r.frames * float(np.mean((dark / r.variance(camera)) ** 2)) for r in sets)
            return sparse.telegraph(dark, max(4 * round(alike / 4), 2), height * width)
        case "row_pink_noise":
            return shifts.row_pink(camera, sets)
        case "pink_noise":
            return shifts.raster_pink(camera, sets)
        case "banding":
            return shifts.sinusoid(camera, sets, shifts.one)
        case "flicker":
            return shifts.sinusoid(camera, lit, shifts.signal)
        case "illumination_drift":
            moving = [r for r in lit if r.frames > 1]
            return shifts.pooled(camera, moving, lambda c, r: shifts.signal(c, r) ** 2 / r.variance(c), 1)
        case "nonlinearity":
            return shifts.template(camera, sets, lambda c, r: shifts.signal(c, r) * r.electrons / full)
        case "lens_shading":
            return shifts.template(camera, sets, lambda c, r: shifts.signal(c, r) * radius)
        case "green_imbalance":
            return shifts.template(camera, sets, lambda c, r: shifts.signal(c, r) * greens)
        case "amp_glow":
            return shifts.template(camera, sets, shifts.corner)
        case "amplifier_mismatch":
            return shifts.template(camera, sets, lambda c, r: (x >= width // 2) - 0.5)
        case "channel_offset":
            return shifts.template(camera, sets, shifts.site, channels=False)
        case "dark_current":
            return shifts.template(
                camera, sets, lambda c, r: np.full_like(r.electrons, c.gain * r.exposure_s)
            )
        case "heavy_tails":
            return shifts.pooled(camera, sets, lambda c, r: shifts.read_share(c, r) ** 4 / 24, 1)
        case "pixel_read_noise_map":
            return shifts.read_map(camera, sets)
        case "crosstalk":
            return shifts.pooled(camera, lit, shifts.neighbours, 1)
        case "in_camera_denoising":
            return shifts.pooled(camera, sets, lambda c, r: np.full_like(r.electrons, 2 * 0.5**2), 1)
        case _:
            return None


LARGEST = {
    "prnu": 0.1,
    "column_gain": 0.1,
    "green_imbalance": 0.2,
    "nonlinearity": 0.4,
    "lens_shading": 0.6,
    "crosstalk": 0.3,
    "in_camera_denoising": 0.8,
    "heavy_tails": 20.0,
    "pixel_read_noise_map": 1.5,
    "flicker": 0.3,
    "illumination_drift": 0.3,
}
"""Amplitudes beyond which an effect is no small departure any more; others: some times the pixel noise."""


def reachable(mechanism: str, multiple: float, camera: Camera, sets: Sequence[Exposed]) -> float | None:
    """Amplitude of the mechanism at a multiple of its MDE; None where no moderate amplitude shows so much."""
    law = strength(mechanism, camera, sets)
    if law is None:
        return None
    dark = float(np.sqrt(camera.gain**2 * camera.read_e**2 + camera.step**2 / 12))
    amplitude = law.amplitude_at(multiple)
    return amplitude if amplitude <= LARGEST.get(mechanism, 10 * dark) else None
