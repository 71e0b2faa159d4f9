"""Cameras beyond the prior that training draws from: gains and read noises that no model has seen."""

from __future__ import annotations

import jax

from cannoise_jax.evaluation.noise_models import Bench
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.synthetic.virtual import Nlf, VirtualCamera, virtual_patches

BEYOND = (
    (2e-5, 2.0),
    (5e-2, 2.0),
    (0.15, 1.0),
    (1e-3, 30.0),
    (5e-3, 25.0),
    (1e-2, 0.05),
)
"""Shot coefficients, normalised, and read noises, e-: the prior has 1e-4 to 2.5e-2, and 0.25 to 10."""
_BLACK, _WHITE = 256.0, 4095.0


def beyond_bench(scenes: int, per_scene: int, seed: int = 0) -> Bench:
    """Test patches of these cameras; 12 bits, heavy tails in the read noise."""
    cameras = tuple(_camera(shot, read_e) for shot, read_e in BEYOND)
    test = virtual_patches(jax.random.key(seed), "test", scenes, per_scene, cameras)
    return Bench(test, test, cameras)


def _camera(shot: float, read_e: float) -> VirtualCamera:
    read = (shot * read_e) ** 2
    sensor = SensorModel.from_nlf(shot, read, _BLACK, _WHITE).with_mechanism("heavy_tails", tukey_lambda=-0.1)
    return VirtualCamera(f"shot {shot:g}, read {read_e:g} e-", "RGGB", {100: Nlf(shot, read)}, sensor)
