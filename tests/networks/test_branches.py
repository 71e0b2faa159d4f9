"""The physical branches: each does what its name says, and nothing where there is nothing to do."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks import branches
from cannoise_jax.networks.branches import (
    NoiseLevel,
    Physics,
    branch_draws,
    line_variance,
    physical_noise,
    physics_of,
)
from cannoise_jax.physics.core.tukey_lambda import excess_kurtosis

COUNT, SIDE = 4, 64
SHOT, READ = 1e-3, 4e-5
LEVEL = NoiseLevel(jnp.full((COUNT, 4), SHOT), jnp.full((COUNT, 4), READ), jnp.ones(COUNT), jnp.ones(COUNT))
NONE = Physics(
    *(jnp.zeros(COUNT) for _ in range(2)), jnp.full(COUNT, branches.GAUSSIAN_TAIL),
    *(jnp.zeros(COUNT) for _ in range(4)), jnp.zeros((COUNT, 4)),
)  # fmt: skip


@jax.jit
def make(key, z, clean, level, physics):
    return physical_noise(branch_draws(key, z.shape), z, clean, level, physics)


def drawn(clean, seed=0, **changed):
    """Noise of unit-normal initial numbers, with some parameters changed; and those numbers."""
    z = jax.random.normal(jax.random.key(seed), (COUNT, SIDE, SIDE, 4))
    physics = NONE._replace(
        **{name: jnp.broadcast_to(v, getattr(NONE, name).shape) for name, v in changed.items()}
    )
    image = jnp.full(z.shape, clean)
    return np.asarray(make(jax.random.key(seed + 1), z, image, LEVEL, physics)), np.asarray(z)


def test_nothing_to_add_leaves_the_initial_noise():
    noise, z = drawn(0.2)
    sigma = (SHOT * 0.2 + READ) ** 0.5
    # Photon noise is a little skewed, the shape 0.135 nearly normal: a hundredth of the noise.
    assert np.std(noise - sigma * z) < 0.03 * sigma


@pytest.mark.parametrize(("clean", "name"), [(0.5, "log_shot"), (0.0, "log_read")])
def test_levels_scale_their_own_part(clean, name):
    noise, _ = drawn(clean, **{name: np.log(2.0)})
    physics = NONE._replace(**{name: jnp.full(COUNT, np.log(2.0))})
    wanted = line_variance(physics, LEVEL, jnp.full(noise.shape, clean))
    assert np.var(noise) == pytest.approx(float(jnp.mean(wanted)), rel=0.03)
    plain = SHOT * clean + READ
    part = SHOT * clean if name == "log_shot" else READ
    assert float(jnp.mean(wanted)) == pytest.approx(plain + part, rel=1e-4)


def test_tails_have_the_kurtosis_of_their_shape_and_unit_variance():
    noise, _ = drawn(0.0, tail=-0.05)
    z = noise / READ**0.5
    assert np.var(z) == pytest.approx(1, abs=0.05)
    assert np.mean(z**4) / np.var(z) ** 2 - 3 == pytest.approx(float(excess_kurtosis(-0.05)), rel=0.25)


def test_rows_and_columns_are_common_to_their_line():
    share = 0.2
    for name, axis, shared in (("row", 2, (0, 1)), ("column", 1, (0, 2))):
        noise, _ = drawn(0.0, **{name: share})
        means = noise.mean(axis) / READ**0.5
        assert np.var(means) == pytest.approx(share + (1 - share) / SIDE, rel=0.25)
        a, b = (means[..., c].ravel() for c in shared)
        assert np.corrcoef(a, b)[0, 1] > 0.8
        assert abs(np.corrcoef(a, means[..., 3].ravel())[0, 1]) < 0.25
        assert np.var(noise) == pytest.approx(READ, rel=0.05)


def test_slow_rows_wander_and_white_rows_do_not():
    def neighbours(name):
        rows = drawn(0.0, **{name: 0.25})[0].reshape(COUNT, SIDE, SIDE, 2, 2).mean((2, 4)).reshape(COUNT, -1)
        return np.mean([np.corrcoef(r[1:], r[:-1])[0, 1] for r in rows])

    assert neighbours("slow_row") > 0.5 > 0.15 > abs(neighbours("row"))


def test_neighbours_are_mixed_at_unchanged_variance():
    noise, _ = drawn(0.0, blend=0.3)
    assert np.var(noise) == pytest.approx(READ, rel=0.03)
    lag = np.mean(noise[:, 1:] * noise[:, :-1]) / np.var(noise)
    assert lag == pytest.approx(2 * 0.7 * 0.075 / (0.7**2 + 0.3**2 / 4), abs=0.02)


def test_offsets_shift_their_channel():
    noise, _ = drawn(0.0, offset=jnp.array([0.3, 0.0, 0.0, -0.2]))
    np.testing.assert_allclose(noise.mean((0, 1, 2)) / READ**0.5, [0.3, 0, 0, -0.2], atol=0.03)


def test_parameters_stay_in_their_bounds_and_start_as_white_normal_noise():
    extreme = physics_of(jnp.array([[1e3] * branches.OUTPUTS, [-1e3] * branches.OUTPUTS]))
    assert (np.abs(np.asarray(extreme.tail)) < 0.27).all()
    shares = np.asarray(extreme.row + extreme.slow_row + extreme.column)
    assert (shares >= 0).all() and (shares < 1).all()
    start = physics_of(jnp.zeros((1, branches.OUTPUTS)))
    assert float(start.tail[0]) == pytest.approx(branches.GAUSSIAN_TAIL)
    assert float(start.row[0]) < 0.01 and not np.any(start.offset)


def test_every_parameter_and_the_clean_image_have_finite_slopes():
    z = jax.random.normal(jax.random.key(0), (COUNT, 16, 16, 4))
    draws = branch_draws(jax.random.key(1), z.shape)

    @jax.jit
    @partial(jax.grad, argnums=(0, 1))
    def slopes(raw, clean):
        return jnp.mean(physical_noise(draws, z, clean, LEVEL, physics_of(raw)) ** 4)

    for clean in (jnp.zeros(z.shape), jnp.full(z.shape, 0.3)):
        for raw in (jnp.zeros((COUNT, branches.OUTPUTS)), jnp.full((COUNT, branches.OUTPUTS), -6.0)):
            assert all(bool(jnp.isfinite(s).all()) for s in slopes(raw, clean))
    of_start, _ = slopes(jnp.zeros((COUNT, branches.OUTPUTS)), jnp.full(z.shape, 0.3))
    assert (np.abs(np.asarray(of_start)).sum(0) > 0).all()
