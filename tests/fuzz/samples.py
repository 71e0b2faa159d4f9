"""One small sound file of every format, to be damaged."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import tifffile
from astropy.io import fits

from tests.recordings.dng import write_dng
from tests.recordings.test_sidd import write_instance

FIELDS = {
    "cfa": "RGGB", "black_level": [64.0, 64.0, 64.0, 64.0], "white_level": 1023.0, "camera": "made",
    "kind": "flat", "iso": 100.0, "exposure_s": 0.01, "temperature_c": 20.0, "shot": [0.002] * 4,
    "read": [1e-5] * 4, "code_step": 1.0, "reference": "independent", "reference_frames": 4,
}  # fmt: skip
"""What a recording may state, all of it plausible."""


def frames(seed: int = 0) -> np.ndarray:
    """Four noisy flats of 10 bits, 24 x 32."""
    rng = np.random.default_rng(seed)
    return (64 + rng.poisson(200, (4, 24, 32)) + rng.integers(0, 4, (4, 24, 32))).astype(np.uint16)


def write_samples(folder: Path) -> dict[str, Path]:
    """Every file by the name of its format. A FITS file needs --black-level and --white-level, as always."""
    stack, made = frames(), {}

    def put(name: str) -> Path:
        made[name] = folder / name
        return made[name]

    native(put("native.h5"), stack, FIELDS)
    native(put("chunked.h5"), stack, FIELDS, chunks=(1, 24, 32), compression="gzip")
    header = {"BAYERPAT": "RGGB", "EXPTIME": 0.01, "GAIN": 10, "CCD-TEMP": -5.0, "INSTRUME": "made"}
    unit = fits.PrimaryHDU(stack)
    unit.header.update(header)
    unit.writeto(put("stack.fits"))
    fits.PrimaryHDU(stack[0], unit.header).writeto(put("frame.fits.gz"))
    packed = fits.CompImageHDU(stack[0], compression_type="RICE_1")
    packed.header.update(header)
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(put("packed.fits"))
    tifffile.imwrite(put("stack.tif"), stack, photometric="minisblack")
    tifffile.imwrite(put("deflated.tif"), stack, photometric="minisblack", compression="zlib")
    np.save(put("stack.npy"), stack)
    np.savez_compressed(put("stack.npz"), frames=stack, clean=np.full((24, 32), 0.2, np.float32))
    for name in ("stack.tif", "deflated.tif", "stack.npy", "stack.npz"):
        (folder / name).with_suffix(".json").write_text(json.dumps(FIELDS))
    write_dng(put("raw.dng"), np.tile(stack[0], (2, 2)), noise_profile=(1e-3, 1e-6))
    made["sidd"], _ = write_instance(folder)
    return made


def native(path: Path, stack: np.ndarray, fields: dict, **options) -> None:
    """A recording in the native format by h5py alone, so that fields need not be sound."""
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", data=stack, **options)
        for name, value in fields.items():
            if value is not None:
                file.attrs[name] = value
