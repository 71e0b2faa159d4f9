"""Batches of drawn cameras: reproducible, resumed bit-exactly, and what they say of themselves is true."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from cannoise_jax.physics.core.mosaic_ops import neighbour_mean
from cannoise_jax.recordings.packing import pack, unpack
from cannoise_jax.training.drawn import DrawnBatches, drawn_cameras


@pytest.fixture(scope="module")
def cameras():
    return drawn_cameras(jax.random.key(0), "train", 6, 2, 2)


def take(source, count):
    return [next(source) for _ in range(count)]


def same(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_the_same_key_records_the_same_bits(cameras):
    again = drawn_cameras(jax.random.key(0), "train", 6, 2, 2)
    np.testing.assert_array_equal(again.noise, cameras.noise)
    same(again.truth, cameras.truth)


def test_batches_go_on_where_they_stopped(cameras):
    whole = take(DrawnBatches(cameras, 4, 1, 32), 5)
    iterator = DrawnBatches(cameras, 4, 1, 32)
    same(take(iterator, 2), whole[:2])
    resumed = DrawnBatches(cameras, 4, 1, 32)
    resumed.set_state(iterator.get_state())
    same(take(resumed, 3), whole[2:])
    other = next(DrawnBatches(cameras, 4, 2, 32))
    assert not np.array_equal(other["clean"], whole[0]["clean"])


def test_parts_of_a_batch_are_its_rows(cameras):
    whole = take(DrawnBatches(cameras, 4, 1, 32), 3)
    parts = [take(DrawnBatches(cameras, 4, 1, 32, n, 2), 3) for n in range(2)]
    for batch, *halves in zip(whole, *parts, strict=True):
        same(jax.tree.map(lambda *rows: np.concatenate(rows), *halves), batch)


def test_an_element_is_of_one_camera_and_every_camera_has_its_turn(cameras):
    drawn = take(DrawnBatches(cameras, 3, 0, 32), 4)
    assert sorted(np.concatenate([b["camera"] for b in drawn[:2]])) == list(range(6))
    for batch in drawn:
        assert batch["clean"].shape == batch["noisy"].shape == (3, 32, 32, 4)
        assert batch["anchor"].shape == (3, 2, 64, 64, 4) and batch["positive"].shape == (3, 64, 64, 4)
        for i, camera in enumerate(batch["camera"]):
            assert batch["shot"][i, 0] == cameras.level[camera, 0]
            assert batch["truth"]["tail"][i] == cameras.truth["tail"][camera]
            alike = np.array_equal(batch["anchor"][i, 0], batch["anchor"][i, 1])
            assert alike == (batch["shown"][i] == 1)
            images = [cameras.noisy(camera, p) for p in range(3)]
            shown = [next(p for p in range(3) if np.array_equal(a, images[p])) for a in batch["anchor"][i]]
            target = {0, 1, 2} - set(shown)
            assert target  # what is to be imitated is never shown
            np.testing.assert_array_equal(batch["positive"][i], cameras.noisy(camera, 3))


def test_shares_are_below_one_and_levels_positive(cameras):
    assert (cameras.level > 0).all()
    lines = cameras.truth["row"] + cameras.truth["slow_row"] + cameras.truth["column"]
    assert (lines >= 0).all() and (lines < 0.5).all()


def test_codes_at_the_black_level_are_zeros(cameras):
    """As in recordings: statistics that count zeros must see in training what they see in use. Stripes are
    added to codes, so one camera may be without a lattice."""
    found = 0
    for camera in range(len(cameras)):
        images = cameras.noisy(camera, np.arange(4))
        off_black = np.abs(images[images != 0]).min()
        found += off_black > 0.9 / (2**14 - 1)
    assert found >= len(cameras) - 1


def test_what_denoising_takes_from_a_scene_is_no_noise(cameras):
    """Beside its clean signal a camera that denoises has the noise of its level, however sharp the scene."""
    edges = 0.2 + 0.1 * (np.arange(64) // 4 % 2)[:, None, None].astype(np.float32)
    scene = np.broadcast_to(edges, (64, 64, 4))
    weight = np.float32(0.2)
    denoising = replace(
        cameras,
        scenes=np.broadcast_to(scene, cameras.scenes.shape),
        truth={**cameras.truth, "blend": np.full(len(cameras), weight)},
    )
    clean = denoising.clean(0, 0)
    shown = denoising.shown(0, 0)
    mosaic = np.asarray(unpack(shown, "RGGB"))
    wanted = pack(np.asarray((1 - weight) * mosaic + weight * neighbour_mean(mosaic, 2)), "RGGB")
    np.testing.assert_allclose(clean, wanted, atol=1e-6)
    assert np.std(clean - shown) > 0.001
    np.testing.assert_array_equal(denoising.noisy(0, 0), shown + denoising.noise[0, 0])
    untouched = replace(denoising, truth={**cameras.truth, "blend": np.zeros(len(cameras), np.float32)})
    np.testing.assert_array_equal(untouched.clean(0, 0), shown)
