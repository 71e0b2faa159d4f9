import dataclasses
import json

import numpy as np
import pytest

from cannoise_jax.recordings.augment import mirror_packed
from cannoise_jax.recordings.pipeline import ArrayPatches, Subset, batches
from cannoise_jax.recordings.recording import BadInput


def patches(counts=(7, 3, 5), size=6, seed=0):
    """Patches whose noisy values tell their number: n + a pattern below 1."""
    total = sum(counts)
    rng = np.random.default_rng(seed)
    pattern = rng.random((total, size, size, 4), np.float32) * 0.5
    noisy = np.arange(total, dtype=np.float32)[:, None, None, None] + pattern
    camera = np.repeat(np.arange(len(counts)), counts)
    levels = np.arange(total, dtype=np.float32)[:, None] * np.ones(4, np.float32)
    names = tuple("ABCDE"[: len(counts)])
    return ArrayPatches(
        noisy + 0.25, noisy, levels, -levels, camera, names, ("GRBG", "RGGB", "BGGR")[: len(names)]
    )


def take(iterator, count):
    return [next(iterator) for _ in range(count)]


def numbers(images):
    """The number of the patch that each image was cut from."""
    return np.floor(images[:, 0, 0, 0]).astype(int)


def test_an_element_is_what_the_contract_says():
    source = patches()
    for batch in take(batches(source, 4, seed=0, size=None), 20):
        assert set(batch) == {"clean", "noisy", "anchor", "positive", "negative", "shot", "read", "camera"}
        for name in ("clean", "noisy", "anchor", "positive", "negative"):
            assert batch[name].shape == (4, 6, 6, 4) and batch[name].dtype == np.float32
        i, j, k, n = (numbers(batch[name]) for name in ("noisy", "anchor", "positive", "negative"))
        np.testing.assert_array_equal(batch["noisy"], source.noisy[i])
        np.testing.assert_array_equal(batch["clean"], source.clean[i])
        np.testing.assert_array_equal(batch["shot"], source.shot[i])
        np.testing.assert_array_equal(batch["read"], source.read[i])
        assert batch["camera"].dtype == np.int32 and batch["shot"].dtype == np.float32
        own = source.camera[i]
        np.testing.assert_array_equal(batch["camera"], own)
        np.testing.assert_array_equal(source.camera[j], own)
        np.testing.assert_array_equal(source.camera[k], own)
        assert (source.camera[n] != own).all()
        assert (i != j).all() and (i != k).all() and (j != k).all()  # the target is never shown


def test_the_anchor_is_of_the_setting_where_settings_are_told():
    source = patches((12, 12))
    setting = np.tile([0, 0, 0, 1, 1, 2], 4)
    told = dataclasses.replace(source, setting=setting)
    for part in (told, Subset(told, np.arange(24))):
        for batch in take(batches(part, 6, seed=1, size=None), 10):
            i, j, k = (numbers(batch[name]) for name in ("noisy", "anchor", "positive"))
            np.testing.assert_array_equal(setting[j], setting[i])
            assert (i != j).all() and (i != k).all() and (j != k).all()


def test_cameras_are_balanced_and_every_patch_is_used():
    source = patches((12, 3, 5))
    seen = np.concatenate([numbers(b["noisy"]) for b in take(batches(source, 6, seed=1, size=None), 6)])
    assert (np.bincount(source.camera[seen]) == 12).all()  # one pass: each camera 12 times
    counts = np.bincount(seen, minlength=20)
    assert (counts[:12] == 1).all() and (counts[12:15] == 4).all() and set(counts[15:]) == {2, 3}


def test_other_draws_are_uniform():
    source = patches((4, 4, 4))
    drawn = take(batches(source, 60, seed=2, size=None), 25)
    names = ("noisy", "anchor", "positive", "negative")
    i, j, k, n = (np.concatenate([numbers(b[name]) for b in drawn]) for name in names)
    for others, cells in ((j, 3), (k, 3), (n, 8)):
        for target in (0, 5, 11):
            counts = np.bincount(others[i == target], minlength=12)
            expected = (i == target).sum() / cells
            assert (counts > 0).sum() == cells
            chi_squared = ((counts[counts > 0] - expected) ** 2 / expected).sum()
            assert chi_squared < 30  # 99.9 % quantile: 13.8 for 2, 24.3 for 7 degrees of freedom


def test_order_depends_on_the_seed_and_changes_from_epoch_to_epoch():
    source = patches((8, 8))
    first, again, other = (take(batches(source, 16, seed=s, size=None), 2) for s in (3, 3, 4))
    for a, b in zip(first, again, strict=True):
        for name in a:
            np.testing.assert_array_equal(a[name], b[name])
    assert not np.array_equal(numbers(first[0]["noisy"]), numbers(other[0]["noisy"]))
    one, two = (numbers(b["noisy"]) for b in first)
    assert sorted(one) == sorted(two) and not np.array_equal(one, two)
    assert not np.array_equal(numbers(first[0]["noisy"]), np.arange(16))


@pytest.mark.parametrize("threads", [0, 2])
@pytest.mark.parametrize("at", [0, 1, 7])
def test_resumed_mid_epoch_bit_exactly(at, threads):
    source = patches()
    whole = take(batches(source, 4, seed=5, size=4), 12)
    iterator = batches(source, 4, seed=5, size=4, threads=threads)
    take(iterator, at)
    state = json.loads(json.dumps(iterator.get_state()))
    take(iterator, 2)
    resumed = batches(source, 4, seed=5, size=4, threads=threads)
    resumed.set_state(state)
    for iterator_after in (resumed, iterator):
        iterator_after.set_state(state)
        for expected, batch in zip(whole[at:], take(iterator_after, 12 - at), strict=True):
            for name in expected:
                np.testing.assert_array_equal(batch[name], expected[name])


def test_parts_of_a_batch_are_its_rows_and_their_state_is_that_of_the_whole():
    source = patches()
    whole = batches(source, 6, seed=5, size=4)
    expected = take(whole, 12)  # beyond an epoch
    parts = [batches(source, 6, seed=5, size=4, part=n, parts=3) for n in range(3)]
    for batch, *rows in zip(expected, *(take(part, 12) for part in parts), strict=True):
        for name in batch:
            np.testing.assert_array_equal(np.concatenate([r[name] for r in rows]), batch[name])
    assert [part.get_state() for part in parts] == [whole.get_state()] * 3


def test_windows_are_crops_and_mirrored_crops_of_the_stored_patch():
    source = patches((3, 3), size=6)
    kinds = set()
    for batch in take(batches(source, 8, seed=6, size=4), 40):
        for clean, noisy, number in zip(batch["clean"], batch["noisy"], numbers(batch["noisy"]), strict=True):
            np.testing.assert_array_equal(clean, noisy + np.float32(0.25))  # the same window of both
            stored = source.noisy[number]
            found = [
                (mirrored, top, left)
                for mirrored, image in ((False, stored), (True, mirror_packed(stored, source.cfa(number))))
                for top in range(3)
                for left in range(image.shape[1] - 3)
                if np.array_equal(noisy, image[top : top + 4, left : left + 4])
            ]
            assert len(found) == 1
            kinds.add(found[0])
    assert len(kinds) == 9 + 6  # every offset, mirrored and not


def test_references_may_be_larger_than_targets():
    batch = next(batches(patches((3, 3), size=6), 4, seed=0, size=2, reference_size=6))
    sizes = {name: value.shape[1:3] for name, value in batch.items() if value.ndim == 4}
    assert sizes == {
        "clean": (2, 2),
        "noisy": (2, 2),
        **dict.fromkeys(("anchor", "positive", "negative"), (6, 6)),
    }
    with pytest.raises(BadInput, match="stored patches of 6 x 6.*smaller than 8"):
        batches(patches((3, 3), size=6), 4, seed=0, size=2, reference_size=8)


def test_patches_without_a_column_to_spare_are_never_mirrored():
    source = patches((3, 3), size=4)
    for batch in take(batches(source, 8, seed=7, size=4), 10):
        np.testing.assert_array_equal(batch["noisy"], source.noisy[numbers(batch["noisy"])])


def test_one_camera_has_no_triplet_unless_it_is_left_out():
    source = patches((4,))
    with pytest.raises(BadInput, match="A: the triplet loss needs two cameras.*--config.loss.triplet=0"):
        batches(source, 2, seed=0)
    batch = next(batches(source, 2, seed=0, size=None, triplet=False))
    assert set(batch) == {"clean", "noisy", "anchor", "shot", "read", "camera"}
    assert (numbers(batch["noisy"]) != numbers(batch["anchor"])).all()


def test_too_few_or_too_small_patches():
    with pytest.raises(BadInput, match="B: 1 patches"):
        batches(patches((4, 1)), 2, seed=0)
    with pytest.raises(BadInput, match="6 x 6.*smaller than 8"):
        batches(patches((4, 4)), 2, seed=0, size=8)
    two = next(batches(patches((2, 2)), 4, seed=0, size=None))
    np.testing.assert_array_equal(two["anchor"], two["positive"])


def test_subsets_keep_the_cameras():
    source = patches((4, 4))
    subset = Subset(source, np.array([1, 2, 5, 7]))
    assert len(subset) == 4 and subset.cameras == source.cameras
    np.testing.assert_array_equal(subset.camera, [0, 0, 1, 1])
    seen = {n for b in take(batches(subset, 4, seed=0, size=None), 8) for n in numbers(b["negative"])}
    assert seen == {1, 2, 5, 7}
