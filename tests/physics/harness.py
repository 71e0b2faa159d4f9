"""What the tests of all mechanisms share: a small camera with one mechanism, its frames, and numbers that see
what the frames do."""

import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.registry import MECHANISMS
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve

SIZE = (8, 12)
FRAMES = 1500
SETTINGS = Settings(iso=100.0, exposure_s=0.5, frames=FRAMES)

# Strong enough to be seen in a small simulation, and no special case of anything weaker.
STRONG = {
    "gain_error": {"error": 0.4},
    "read_noise_error": {"error": 0.5},
    "dual_gain": {"iso_switch": 50.0, "gain_ratio": 1.3, "read_ratio": 0.5},
    "prnu": {"sigma": 0.1},
    "column_gain": {"sigma": 0.1},
    "green_imbalance": {"sigma": 0.05},
    "lens_shading": {"sigma": 0.3},
    "dead_pixels": {"fraction": 0.1},
    "defect_correction": {"fraction": 0.2},
    "hot_pixels": {"fraction": 0.1, "e_per_s": 100.0},
    "clock_induced_charge": {"charge_e": 5.0},
    "dsnu": {"sigma_dn": 3.0},
    "nonlinearity": {"loss": 0.2},
    "saturation": {"full_well_e": 420.0},
    "crosstalk": {"fraction": 0.3},
    "brighter_fatter": {"a00": 3e-4},
    "image_lag": {"fraction": 0.2},
    "smear": {"fraction": 0.1},
    "rts": {"jump_dn": 12.0, "fraction": 0.3},
    "cosmic_rays": {"rate": 40000.0, "charge_e": 60.0},
    "row_noise": {"sigma_dn": 3.0},
    "column_noise": {"sigma_dn": 3.0},
    "row_fpn": {"sigma_dn": 3.0},
    "column_fpn": {"sigma_dn": 3.0},
    "pink_noise": {"sigma_dn": 4.0, "exponent": 1.2},
    "row_pink_noise": {"sigma_dn": 4.0, "exponent": 0.8},
    "banding": {"amplitude_dn": 6.0, "frequency": 0.13},
    "offset_drift": {"sigma_dn": 3.0},
    "channel_offset": {"sigma_dn": 3.0},
    "amplifier_mismatch": {"step_dn": 5.0},
    "flicker": {"amplitude": 0.08, "frequency": 0.11},
    "illumination_drift": {"sigma": 0.05},
    "temperature_drift": {"sigma_k": 4.0, "e_per_s": 120.0, "memory_frames": 1.5},
    "reference_error": {"sigma_dn": 5.0, "blur": 0.2, "shift_y": 0.6, "shift_x": -0.8, "scale": 0.03},
    "misregistration": {"shift_px": 1.5, "angle": 0.7},
    "bookkeeping": {"black_dn": 4.0, "white_error": 0.1},
    "missing_codes": {"period": 4.0},
    "lossy_compression": {"step_dn": 30.0},
    "in_camera_denoising": {"weight": 0.4},
    "black_clipping": {"level_dn": 60.0},
    "dark_current": {"e_per_s": 60.0},
    "amp_glow": {"e_per_s": 200.0, "length": 0.4},
    "hot_pixel_suppression": {"weight": 0.7},
}
EACH = pytest.mark.parametrize("id", MECHANISMS)
# These move the scene with time, or are fixed within a recording and new in the next.
PER_RECORDING = ("reference_error",)


def scene(size=SIZE) -> np.ndarray:
    """A clean mosaic with slopes, a dark corner and differing colours."""
    y, x = np.indices(size)
    return (0.08 + 0.15 * x / size[1] + 0.05 * y / size[0] + 0.05 * ((y + x) % 2)).astype(np.float32)


def camera(id: str, **more) -> SensorModel:
    base = SensorModel.poisson_gaussian(
        0.5, 4.0, (60, 61, 62, 63), 1060, "GRBG", unit_key=jax.random.key(5), **more
    )
    return base.with_mechanism(id, **STRONG.get(id, {}))


def prepared(model: SensorModel, size=SIZE, settings=SETTINGS):
    context = context_of(model, jnp.asarray(scene(size))[None], settings)
    values = resolve(model, context)
    maps = [chain.maps_of(model, i, values[i], context) for i in range(len(model.mechanisms))]
    return context, values, maps


def numpy_context(context) -> dict:
    def wide(v):
        return np.asarray(v, np.float64)

    return {
        "gain": wide(context.gain_dn_per_e),
        "read": wide(context.read_noise_e),
        "black": wide(context.black_level),
        "white": wide(context.white_level),
        "mean": wide(context.mean_dn),
        "step": float(context.code_step),
        "exposure": float(context.exposure_s),
        "iso": float(context.iso),
    }


def key_of(id: str) -> jax.Array:
    return jax.random.key(zlib.crc32(id.encode()))


def frames_of(model: SensorModel, key, settings=SETTINGS, size=SIZE) -> np.ndarray:
    """Codes of the fast chain, run eagerly: compiling fifty chains would take minutes."""
    context, values, _ = prepared(model, size, settings)
    with_step = chain.run_chain(model, key, context, values, settings.frames)
    return np.asarray(chain.to_codes(model, key, *with_step, context, values), np.float64)


def summaries(y: np.ndarray) -> dict[str, np.ndarray]:
    """Independent numbers, one per frame or block of frames, that see means, rows, columns, lags and
    tails."""
    z = y - y.mean(axis=0)
    return {
        "pixel": y[:, 1, 3],
        "other pixel": y[:, 6, 8],
        "row": y[:, 2].mean(axis=1),
        "column": y[:, :, 5].mean(axis=1),
        "frame": y.mean(axis=(1, 2)),
        "power": (z**2).mean(axis=(1, 2)),
        "right": (z[:, :, :-1] * z[:, :, 1:]).mean(axis=(1, 2)),
        "down": (z[:, :-1] * z[:, 1:]).mean(axis=(1, 2)),
        "right 2": (z[:, :, :-2] * z[:, :, 2:]).mean(axis=(1, 2)),
        "later": (z[:-1:2] * z[1::2]).mean(axis=(1, 2)),
        "extreme": z.max(axis=(1, 2)),
    }
