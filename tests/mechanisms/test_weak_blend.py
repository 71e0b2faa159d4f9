"""A blend that moves values by less than a code shows in the codes that are stored."""

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.sensor import SensorModel, Settings

WEIGHT = 0.02


@pytest.mark.parametrize("step", [1.0, 4.0])
def test_neighbours_of_one_colour_are_alike_behind_the_rounding(step):
    model = SensorModel.poisson_gaussian(2.0, 4.0, 528.0, 16380.0, "RGGB", code_step=step)
    blended = model.with_mechanism("in_camera_denoising", weight=WEIGHT)
    frames = np.asarray(
        blended.sample(jax.random.key(0), np.zeros((160, 192), np.float32), Settings(frames=24)), float
    )
    noise = frames - frames.mean(0)
    chance = 1 / np.sqrt(noise.size)
    for a, b in ((noise[:, 2:], noise[:, :-2]), (noise[..., 2:], noise[..., :-2])):
        assert np.mean(a * b) / noise.var() == pytest.approx(2 * WEIGHT / 4, abs=4 * chance)
