"""Cameras beyond the prior that training draws from: gains and read noises that no model has seen."""

from __future__ import annotations

import jax

from cannoise_jax.evaluation.noise_models import Bench
from cannoise_jax.physics.synthetic.virtual import camera_of_level, virtual_patches

BEYOND = (
    (2e-5, 2.0),
    (5e-2, 2.0),
    (0.15, 1.0),
    (1e-3, 30.0),
    (5e-3, 25.0),
    (1e-2, 0.05),
)
"""Shot coefficients, normalised, and read noises, e-: the prior has 1e-4 to 2.5e-2, and 0.25 to 10."""


def beyond_bench(scenes: int, per_scene: int, seed: int = 0) -> Bench:
    """Test patches of these cameras; 12 bits, heavy tails in the read noise."""
    cameras = tuple(camera_of_level(shot, read_e) for shot, read_e in BEYOND)
    test = virtual_patches(jax.random.key(seed), "test", scenes, per_scene, cameras)
    return Bench(test, test, cameras)
