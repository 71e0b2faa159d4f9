"""Estimators: the parameters of a mechanism from recordings that show it, with errors.

Each takes the statistics of a camera's recordings (any kinds, it picks what it needs) and the baseline, and
returns estimates by parameter name, as the mechanism names them, or `NotMeasurable` with what to record.
Strengths hold at the setting of the recording they come from (exposure-driven ones per second).
"""

from __future__ import annotations

from collections.abc import Callable

from cannoise_jax.physics.transfer.estimate import Estimates
from cannoise_jax.physics.transfer.estimators import (
    charge,
    codes,
    light,
    lines,
    maps,
    neighbours,
    noise,
    spectra,
)

Estimator = Callable[..., Estimates]

ESTIMATORS: dict[str, Estimator] = {
    "gain_error": noise.gain_error,
    "read_noise_error": noise.read_noise_error,
    "prnu": maps.prnu,
    "dsnu": maps.dsnu,
    "column_gain": maps.column_gain,
    "nonlinearity": light.nonlinearity,
    "saturation": light.saturation,
    "black_clipping": codes.black_clipping,
    "crosstalk": neighbours.crosstalk,
    "dark_current": charge.dark_current,
    "amp_glow": charge.amp_glow,
    "hot_pixels": charge.hot_pixels,
    "heavy_tails": noise.heavy_tails,
    "pixel_read_noise_map": maps.pixel_read_noise_map,
    "rts": noise.rts,
    "row_noise": lines.row_noise,
    "column_noise": lines.column_noise,
    "row_fpn": lines.row_fpn,
    "column_fpn": lines.column_fpn,
    "pink_noise": spectra.pink_noise,
    "row_pink_noise": spectra.row_pink_noise,
    "banding": spectra.banding,
    "offset_drift": lines.offset_drift,
    "channel_offset": codes.channel_offset,
    "amplifier_mismatch": codes.amplifier_mismatch,
    "green_imbalance": maps.green_imbalance,
    "quantization": codes.quantization,
    "missing_codes": codes.missing_codes,
    "in_camera_denoising": neighbours.in_camera_denoising,
    "flicker": light.flicker,
    "illumination_drift": light.illumination_drift,
    "reference_error": light.reference_error,
    "bookkeeping": codes.bookkeeping,
}
