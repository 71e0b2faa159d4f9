"""Cameras from a distribution: their levels, their settings, and that the phones are not among them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.presets import read_table
from cannoise_jax.physics.synthetic import prior
from cannoise_jax.physics.synthetic.prior import analogue_drawn, another_setting, draw_camera, stored_drawn


@pytest.fixture(scope="module")
def cameras():
    return jax.jit(jax.vmap(draw_camera))(jax.random.split(jax.random.key(0), 400))


def test_cameras_spread_over_the_grammar(cameras):
    shot, electrons = np.asarray(cameras.shot), np.sqrt(cameras.read) / np.asarray(cameras.shot)
    assert np.quantile(shot, 0.9) / np.quantile(shot, 0.1) > 30
    assert np.median(electrons) == pytest.approx(1.7, rel=0.5)
    for name in ("row", "slow_row", "column", "blend"):
        share = np.mean(np.asarray(getattr(cameras, name)) > 0)
        assert 0.2 < share < 0.8, (name, share)
    assert np.min(cameras.tail) < -0.15 and np.max(cameras.tail) > 0.12
    assert {int(np.log2(w + 1)) for w in np.asarray(cameras.white)} == {10, 12, 14}


def test_the_same_key_gives_the_same_camera():
    first, again, other = (jax.jit(draw_camera)(jax.random.key(k)) for k in (3, 3, 4))
    assert float(first.shot) == float(again.shot) != float(other.shot)


def test_the_test_cameras_are_in_no_table_of_the_prior():
    phones = read_table("phones")
    tables = [c for part in ("published", "recalibrated") for c in phones[part].values()]
    levels = [nlf for table in tables if isinstance(table, dict) for nlf in table.values()]
    known = prior._preset_table()
    for shot, read in levels:
        assert not np.any((np.abs(known[:, 0] / shot - 1) < 1e-3) & (np.abs(known[:, 1] / read - 1) < 1e-3))


def test_another_setting_has_another_gain_and_the_same_structure():
    camera = draw_camera(jax.random.key(1))
    other = another_setting(jax.random.key(2), camera)
    assert float(other.shot) != float(camera.shot)
    assert all(float(getattr(other, n)) == float(getattr(camera, n)) for n in ("tail", "row", "blend"))


def test_the_line_that_comes_with_recordings_is_that_of_their_variance(cameras):
    few = jax.tree.map(lambda v: v[:4], cameras)
    clean = jnp.concatenate([jnp.full((4, 4, 32, 32, 4), x) for x in (0.05, 0.4)], 1)
    keys = jax.random.split(jax.random.key(5), 4)
    analogue = jax.jit(jax.vmap(analogue_drawn))(keys, few, clean)
    noise, line = jax.jit(jax.vmap(stored_drawn))(keys, few, clean, analogue)
    for found, (shot, read), camera in zip(np.asarray(noise), np.asarray(line), range(4), strict=True):
        for part, x in ((found[:4], 0.05), (found[4:], 0.4)):
            # Rows are few and heavy tails few in number: a tenth.
            spread = np.mean(np.var(part, (1, 2)))
            assert spread == pytest.approx(shot * x + read, rel=0.15), camera


def test_a_recording_in_two_halves_is_the_sensors_own_noise(cameras):
    """By the same keys; a value that lies next to the middle of two codes may be rounded the other way."""
    few = jax.tree.map(lambda v: v[:4], cameras._replace(stripes=jnp.zeros_like(cameras.stripes)))
    assert (few.blend > 0).any()
    clean = jnp.full((4, 1, 32, 32, 4), 0.1)
    keys = jax.random.split(jax.random.key(6), 4)

    def whole(key, camera, clean):
        levels = (jnp.full((1, 4), v) for v in (camera.shot, camera.read))
        own = jax.random.split(jax.random.split(key)[0], 1)[0]
        return prior.sensor_of(camera).n_init()(own, clean, *levels)[0]

    analogue = jax.jit(jax.vmap(analogue_drawn))(keys, few, clean)
    made, _ = jax.jit(jax.vmap(stored_drawn))(keys, few, clean, analogue)
    wanted = jax.jit(jax.vmap(whole))(keys, few, clean)
    assert np.std(wanted) > 1e-3
    assert np.mean(np.abs(np.asarray(made - wanted)) > 1e-6) < 1e-3
