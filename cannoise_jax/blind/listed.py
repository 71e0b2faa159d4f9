"""The names that injectors know: unit of the amplitude, and which others contain them as a special case.

A copy of what the vocabulary says of them, so that the injectors share no code with the mechanisms; a test
compares the two. A new injected effect that has a name is one line here and one record among the effects.
"""

from __future__ import annotations

from typing import NamedTuple


class Name(NamedTuple):
    """unit: of the amplitude. within: names of which some value of the parameters gives exactly this one."""

    unit: str
    within: tuple[str, ...] = ()


NAMES: dict[str, Name] = {
    "prnu": Name("1"),
    "dsnu": Name("DN"),
    "column_gain": Name("1", ("prnu",)),
    "nonlinearity": Name("1"),
    "saturation": Name("1"),
    "black_clipping": Name("DN"),
    "crosstalk": Name("1"),
    "dark_current": Name("e-/s"),
    "amp_glow": Name("DN"),
    "hot_pixels": Name("DN"),
    "heavy_tails": Name("1"),
    "pixel_read_noise_map": Name("1"),
    "rts": Name("DN"),
    "row_noise": Name("DN", ("row_pink_noise",)),
    "column_noise": Name("DN"),
    "row_fpn": Name("DN", ("dsnu",)),
    "column_fpn": Name("DN", ("dsnu",)),
    "pink_noise": Name("DN"),
    "row_pink_noise": Name("DN"),
    "banding": Name("DN"),
    "offset_drift": Name("DN"),
    "channel_offset": Name("DN", ("dsnu", "bookkeeping")),
    "amplifier_mismatch": Name("DN", ("dsnu",)),
    "green_imbalance": Name("1", ("prnu",)),
    "quantization": Name("DN", ("lossy_compression",)),
    "missing_codes": Name("code steps"),
    "in_camera_denoising": Name("1"),
    "excess_noise": Name("1"),
    "lens_shading": Name("1", ("prnu",)),
    "dead_pixels": Name("1", ("prnu",)),
    "cosmic_rays": Name("1/(Mpx s)"),
    "image_lag": Name("1"),
    "parallel_cti": Name("1"),
    "serial_cti": Name("1"),
    "lossy_compression": Name("DN"),
    "defect_correction": Name("1"),
    "hot_pixel_suppression": Name("1"),
    "flicker": Name("1"),
    "illumination_drift": Name("1"),
    "bookkeeping": Name("DN"),
}


def contains(general: str, special: str) -> bool:
    """Whether `general` is `special` or contains it as a special case, in any number of steps."""
    return general == special or any(contains(general, outer) for outer in NAMES[special].within)
