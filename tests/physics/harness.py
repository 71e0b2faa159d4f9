"""What the tests of all mechanisms share: a small camera with one mechanism, its frames, and numbers that see
what the frames do."""

import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve

SIZE = (8, 12)
FRAMES = 1500
SETTINGS = Settings(iso=100.0, exposure_s=0.5, frames=FRAMES)

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
    return base.with_mechanism(id, **MECHANISMS[id].examples.strong)


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
