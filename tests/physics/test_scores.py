"""Scores of mechanisms: standard normal where a mechanism is not, large where it is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.registry import MECHANISMS, mechanism
from cannoise_jax.physics.core.settings import context_of, resolve
from tests.physics.harness import (
    SETTINGS,
    camera,
    key_of,
    prepared,
    scene,
)

SCORED = [id for id, m in MECHANISMS.items() if m.score is not None]


@pytest.mark.parametrize("id", SCORED)
def test_score_is_standard_normal_without_the_mechanism(id):
    size, record, draws = (32, 48), mechanism(id), 64
    context, values, maps = prepared(camera(id), size)
    z = np.random.default_rng(11).normal(size=(draws, 4, *size))
    score = jax.vmap(lambda z: record.score(z, values[0], maps[0], context))
    scores = np.asarray(score(jnp.asarray(z, jnp.float32)))
    assert abs(scores.mean()) < 4.5 / np.sqrt(draws)
    assert 0.75 < scores.std() < 1.3


@pytest.mark.parametrize("id", SCORED)
def test_score_sees_the_mechanism(id):
    # Peaks are few, and a third of the pixels of a colour either way stand for them.
    size = (128, 192) if id == "hot_pixel_suppression" else (32, 48)
    model, record = camera(id), mechanism(id)
    # Effects on the noise of a flat; photons are few enough to be skewed in a dark one.
    clean = scene(size)
    if id in ("brighter_fatter", "hot_pixel_suppression"):
        clean = np.full(size, 0.2, np.float32)
    if id == "poisson_skew":
        clean, model = (
            np.full(size, 0.01, np.float32),
            camera(id).without(id).with_mechanism(id, strength=1.0),
        )
    context = context_of(model, jnp.asarray(clean)[None], SETTINGS)
    values = resolve(model, context)
    maps = chain.maps_of(model, 0, values[0], context)
    y, step = chain.run_chain(model, key_of(id), context, values, 8)
    y = np.asarray(chain.to_codes(model, key_of(id), y, step, context, values), np.float64)
    sigma = np.sqrt(np.asarray(context.own_variance()) + 1 / 12)
    z = (y - np.asarray(context.black_level + context.mean_dn)) / sigma
    assert float(record.score(jnp.asarray(z, jnp.float32), values[0], maps, context)) > 3.5
