"""What the simulator getframes has beyond shot and read noise, rounding and clipping: mechanisms here, fields
of a `CameraConfig` there, so that both can be given the same camera."""

from __future__ import annotations

from typing import Any

DARK_E_S, HOT_E_S = 2.0, 300.0
"""Dark current of pixels, and what hot ones have beyond, e-/s: chosen; there the latter is a factor of it."""
_DARK: dict[str, Any] = {"dark_current_e_per_s": DARK_E_S}

GETFRAMES: dict[str, tuple[dict[str, dict[str, float]], dict[str, Any]]] = {
    "PRNU": ({"prnu": {"sigma": 0.01}}, {"prnu": 0.01}),
    "dark current": ({"dark_current": {"e_per_s": DARK_E_S}}, _DARK),
    "hot pixels": (
        {"dark_current": {"e_per_s": DARK_E_S}, "hot_pixels": {"e_per_s": HOT_E_S, "fraction": 0.002}},
        {**_DARK, "hot_pixel_fraction": 0.002, "hot_pixel_factor": HOT_E_S / DARK_E_S},
    ),
    "fixed offsets": ({"dsnu": {"sigma_dn": 1.0}}, {"bias_pixel_spread_adu": 1.0}),
    "pixel read noise": ({"pixel_read_noise_map": {"spread": 0.2}}, {"read_noise_nonuniformity": 0.2}),
    "crosstalk": ({"crosstalk": {"fraction": 0.04}}, {"ipc_coupling": 0.01}),
    "dead pixels": ({"dead_pixels": {"fraction": 0.001}}, {"dead_pixel_fraction": 0.001}),
}
TOGETHER = ("PRNU", "dark current", "hot pixels")
