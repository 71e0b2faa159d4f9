import json
import resource
from dataclasses import replace

import numpy as np
import pytest

from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.packing import pack, to_packed_order
from cannoise_jax.recordings.patches import counts_by_split, open_patches, split_scenes, spread, write_patches
from cannoise_jax.recordings.pipeline import batches
from cannoise_jax.recordings.recording import BadInput, Recording, normalise
from cannoise_jax.recordings.references import leave_one_out


def recording(camera="A", cfa="RGGB", seed=0, count=3, size=(40, 48), clean=True, **stated):
    rng = np.random.default_rng(seed)
    frames = rng.integers(60, 4000, (count, *size)).astype(np.uint16)
    reference = rng.random((count, *size), np.float32) if clean else None
    fields = {"shot": (1.0, 2.0, 3.0, 4.0), "read": (5.0, 6.0, 7.0, 8.0), "iso": 100.0} | stated
    black, path = (60.0, 61.0, 62.0, 63.0), f"{camera}.h5"
    return Recording(frames, cfa, black, 4095.0, camera, clean=reference, path=path, **fields)


def where(patch, image):
    """Places of a packed patch in a packed image."""
    size = patch.shape[0]
    corners = np.argwhere(image[: 1 - size, : 1 - size, 0] == patch[0, 0, 0])
    return [(t, c) for t, c in corners.tolist() if np.array_equal(image[t : t + size, c : c + size], patch)]


@pytest.mark.parametrize("cfa", ["RGGB", "GRBG", "MONO"])
def test_patches_are_windows_of_the_frames_with_their_reference(tmp_path, cfa):
    source = recording(cfa=cfa)
    store = write_patches(tmp_path / "store", [(source, "1")], 20, seed=0, tile=8)
    assert len(store) == 20 and store.cameras == ("A",)
    noisy = pack(normalise(source.frames, source), cfa)
    clean = pack(source.clean, cfa)
    places = []
    for n in range(len(store)):
        patch = store[n]
        assert all(patch[name].dtype == np.float32 for name in patch)
        found = [(t, *place) for t in range(3) for place in where(patch["noisy"], noisy[t])]
        assert len(found) == 1
        t, top, left = found[0]
        np.testing.assert_array_equal(patch["clean"], clean[t, top : top + 8, left : left + 8])
        np.testing.assert_array_equal(patch["shot"], to_packed_order(source.shot, cfa))
        np.testing.assert_array_equal(patch["read"], to_packed_order(source.read, cfa))
        places.append(found[0])
    assert len(set(places)) > 15 and {t for t, *_ in places} == {0, 1, 2}


def test_without_a_reference_the_other_frames_give_it(tmp_path):
    source = recording(clean=False)
    store = write_patches(tmp_path / "store", [(source, "1")], 10, seed=0, tile=8)
    ((_, frames, references),) = leave_one_out(source)
    for n in range(10):
        patch = store[n]
        t, top, left = next((t, *p) for t in range(3) for p in where(patch["noisy"], pack(frames[t], "RGGB")))
        window = pack(references[t], "RGGB")[top : top + 8, left : left + 8]
        np.testing.assert_array_equal(patch["clean"], window)
    with pytest.raises(BadInput, match="A.h5: 1 frame"):
        write_patches(tmp_path / "one", [(recording(clean=False, count=1), "1")], 4, seed=0, tile=8)


def test_equal_arguments_give_equal_bytes(tmp_path):
    sources = [(recording(), "1"), (recording("B", seed=1), "2")]
    for name, seed in (("a", 0), ("b", 0), ("c", 1)):
        write_patches(tmp_path / name, sources, 9, seed=seed, tile=8)
    a, b, c = ((tmp_path / name / "patches.array_record").read_bytes() for name in "abc")
    assert a == b != c
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b", "c"]


def test_cameras_scenes_and_the_split(tmp_path):
    places = [("A", "001"), ("B", "001"), ("A", "003"), ("B", "002")]
    sources = [(recording(camera, seed=n), scene) for n, (camera, scene) in enumerate(places)]
    store = write_patches(tmp_path / "s", sources, 20, seed=0, tile=8)
    assert store.cameras == ("A", "B") and store.scenes == ("001", "002", "003")
    np.testing.assert_array_equal(np.bincount(store.camera), [10, 10])
    assert set(store.iso) == {100}
    train, test = split_scenes(store, ("001", "002"))
    assert len(train) == 5 and len(test) == 15
    assert {store.scenes[store.scene[n]] for n in test.indices} == {"001", "002"}
    assert {store.scenes[store.scene[n]] for n in train.indices} == {"003"}
    with pytest.raises(BadInput, match="holds no scene 009: it has 001, 002, 003"):
        split_scenes(store, ("001", "009"))
    for everything in (("001", "002", "003"), ()):
        with pytest.raises(BadInput, match="leaves one side without"):
            split_scenes(store, everything)


def test_totals_of_training_and_test_patches(tmp_path):
    assert spread(10, 4) == [2, 3, 2, 3] and sum(spread(650_001, 97)) == 650_001
    scenes = ["001", "003", "004", "003", "008"]
    counts = counts_by_split(scenes, ("001", "002", "008"), train=10, test=7)
    assert counts == [3, 3, 3, 4, 4]
    sources = [(recording(seed=n), scene) for n, scene in enumerate(scenes)]
    store = write_patches(tmp_path / "s", sources, counts, seed=0, tile=8)
    train, test = split_scenes(store, ("001", "008"))
    assert len(train) == 10 and len(test) == 7
    with pytest.raises(BadInput, match="empties a side"):
        counts_by_split(["003"], ("001",), 1, 1)


def test_batches_from_the_store_resume_bit_exactly(tmp_path):
    sources = [(recording(c, seed=n), "1") for n, c in enumerate("ABC")]
    write_patches(tmp_path / "s", sources, 30, seed=0, tile=10)
    iterator = batches(open_patches(tmp_path / "s"), 4, seed=0, size=8)
    for _ in range(3):
        next(iterator)
    state = iterator.get_state()
    expected = [next(iterator) for _ in range(9)]
    resumed = batches(open_patches(tmp_path / "s"), 4, seed=0, size=8, threads=2)
    resumed.set_state(state)
    for batch in expected:
        after = next(resumed)
        assert batch["noisy"].shape == (4, 8, 8, 4)
        for name in batch:
            np.testing.assert_array_equal(after[name], batch[name])


def test_the_index_stays_small_however_many_patches(tmp_path):
    write_patches(tmp_path / "s", [(recording(), "1")], 500, seed=0, tile=8)
    assert (tmp_path / "s" / "index.json").stat().st_size < 500
    assert len(open_patches(tmp_path / "s")) == 500


def test_what_cannot_be_cut(tmp_path):
    for source, message in (
        (recording(size=(14, 48)), "A.h5: 14 x 48 pixels: patches of 16 x 16 do not fit"),
        (recording(shot=None), "A.h5: shot and read are unknown"),
    ):
        with pytest.raises(BadInput, match=message):
            write_patches(tmp_path / "s", [(source, "1")], 4, seed=0, tile=8)
    with pytest.raises(BadInput, match="no recordings"):
        write_patches(tmp_path / "s", [], 4, seed=0, tile=8)
    assert list(tmp_path.iterdir()) == []
    write_patches(tmp_path / "s", [(recording(), "1")], 4, seed=0, tile=8)
    with pytest.raises(BadInput, match="holds a patch store already"):
        write_patches(tmp_path / "s", [(recording(), "1")], 4, seed=0, tile=8)


def test_damaged_stores(tmp_path):
    folder = tmp_path / "s"
    write_patches(folder, [(recording(), "1")], 12, seed=0, tile=8)
    records, index = folder / "patches.array_record", folder / "index.json"
    whole, text = records.read_bytes(), index.read_text()
    records.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(BadInput, match="array_record: (cut short|not a readable)"):
        open_patches(folder)
    records.write_bytes(b"x" * len(whole))
    with pytest.raises(BadInput, match="patches.array_record"):
        open_patches(folder)
    records.write_bytes(whole)
    for broken, message in (
        ("{", "not a readable index"),
        (text.replace("patches/2", "patches/9"), "schema 'cannoise/patches/9'"),
        (json.dumps(json.loads(text) | {"tile": None}), "index.json"),
        (text.replace('"patches": 12', '"patches": 11'), "holds 12 patches, the index says 11"),
    ):
        index.write_text(broken)
        with pytest.raises(BadInput, match=message):
            open_patches(folder)
    index.unlink()
    with pytest.raises(BadInput, match="holds no patch store"):
        open_patches(folder)


def test_a_full_disk_leaves_nothing_behind(tmp_path):
    """A limit on file size stands in for a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        with pytest.raises(
            BadInput, match="/s: cannot be written|/patches.array_record: cut short"
        ) as caught:
            write_patches(tmp_path / "s", [(recording(), "1")], 50, seed=0, tile=16)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_real_flats(tmp_path, real_data):
    sources = []
    for camera in ("asi178", "asi120"):
        (flat,) = load_capture_set(real_data / camera).of_kind("flat")
        few = replace(flat, frames=flat.frames[:4], shot=(1e-4,) * 4, read=(1e-6,) * 4)
        sources.append((few, camera))
    store = write_patches(tmp_path / "s", sources, 24, seed=0)
    batch = next(batches(store, 8, seed=0))
    assert batch["noisy"].shape == (8, 64, 64, 4) and set(batch["camera"]) == {0, 1}
    residual = (batch["noisy"] - batch["clean"]).std(axis=(1, 2, 3))
    assert (residual > 0.002).all() and (residual < 0.05).all()
