"""Names that are no mistake, beside the one that each listed effect of the plain cameras should get."""

from __future__ import annotations

ARGUABLE = {
    "zipper": ("odd_even_row_noise",),
    "wandering_columns": ("column_noise", "column_fpn"),
    "row_memory": ("row_noise",),
    "clouds": ("offset_drift",),
    "tear": ("offset_drift",),
    "quadrants": ("offset_drift", "amplifier_drift"),
    "inl_wave": ("bookkeeping",),
    "noisy_edges": ("column_read_noise_map",),
    "smoothed_colours": ("in_camera_denoising",),
}
"""Names that are true of an effect without a name of its own: means of frames or the black level do move,
columns are offset, rows are noisy, single columns louder. Any other is wrong."""
BESIDE = {
    "uneven_rows": ("bookkeeping",),
    "slow_rows": ("offset_drift",),
    "slow_raster": ("offset_drift",),
    "late_charge": ("hot_pixels",),
}
"""Names that are true of a listed effect as well, but not its own: the mean of the rows is off the stated
black level, slow noise moves the means of frames, tails are behind hot pixels."""
