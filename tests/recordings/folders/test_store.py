"""What a plan leaves where it is carried out: files in place or nothing, and a cache that is sound."""

import dataclasses
import gc
import json
import os
import pickle
import subprocess
import sys

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

from cannoise_jax.recordings.folders import store
from cannoise_jax.recordings.folders.aside import used_of
from cannoise_jax.recordings.folders.plan import plan_folder
from cannoise_jax.recordings.folders.store import Options, capture_of, write_plan
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.usable import usable
from tests.recordings.folders.night import night, shot


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    plan = plan_folder(night(tmp_path / "in"))
    out = tmp_path / "a" / "b"
    assert all(path.exists() for path, _ in list(write_plan(plan, out)))
    files = write_plan(plan, tmp_path / "c" / "d")
    next(files)
    with pytest.raises(KeyboardInterrupt):
        files.throw(KeyboardInterrupt())
    assert not (tmp_path / "c").exists()
    with pytest.raises(BadInput, match="exists: name another folder, or replace it with --force"):
        list(write_plan(plan, out))
    assert len(list(write_plan(plan, out, force=True))) == 3


def test_an_interrupt_right_after_a_file_is_in_place_leaves_nothing(tmp_path, monkeypatch):
    plan, out, write = plan_folder(night(tmp_path / "in")), tmp_path / "out", store.write_recording

    def interrupted(path, recording):
        write(path, recording)
        raise KeyboardInterrupt

    monkeypatch.setattr(store, "write_recording", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(write_plan(plan, out))
    assert not out.exists()


def test_a_conversion_that_fails_takes_away_what_it_made_and_no_more(tmp_path, monkeypatch):
    plan, out = plan_folder(night(tmp_path / "in")), tmp_path / "out"
    (out / "mine" / "empty").mkdir(parents=True)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(store, "write_recording", full)
    for folder in (out, tmp_path / "new" / "deep"):
        with pytest.raises(BadInput, match="No space left"):
            list(write_plan(plan, folder))
    assert [p.name for p in out.rglob("*")] == ["mine", "empty"] and not (tmp_path / "new").exists()


def sets(folder, **modes):
    """Two darks and two flats for each name, with keywords of their own."""
    for name, more in modes.items():
        for n in (1, 2):
            about = {"INSTRUME": "Acme 100", "EXPTIME": 2.0, "seed": 9 * sum(map(ord, name)) + n} | more
            shot(folder / f"dark_{name}_{n}.fits", "dark", IMAGETYP="Dark", **about)
            shot(folder / f"flat_{name}_{n}.fits", "flat", IMAGETYP="Flat", **about)
    return folder


def test_what_of_several_sets_is_used_and_what_not_is_said(tmp_path):
    folder, cache = sets(tmp_path / "in", a={"GAIN": 0}, b={"GAIN": 100}, c={"GAIN": 200}), tmp_path / "cache"
    for _ in range(2):  # converted, and from the cache
        capture, said = capture_of(folder, Options({}), cache)
        last = said.splitlines()[-1]
        assert last == used_of(said) and said.endswith("itself\n")
        assert last.startswith("used: 4 of 12 files (gain 0); not used: 4 as gain_100/ (flat_b_1")
        assert "4 as gain_200/ (flat_c_1.fits" in last and f"bin/convert {folder} OUT" in last
        assert sum(r.count for r in capture.recordings) == 4
    written = {path.parent.name for path, _ in write_plan(plan_folder(folder), tmp_path / "out")}
    assert written == {"out", "gain_100", "gain_200"}
    one, said = capture_of(folder, Options({}, leave_out=("*_b_*", "*_c_*")), cache)
    assert used_of(said) == "" and len(one.recordings) == 2


@pytest.mark.parametrize(
    "modes, size",
    [
        ({"a": {"size": (12, 16)}, "b": {}}, (24, 32)),
        ({"a": {"size": (12, 16), "XBINNING": 2, "YBINNING": 2}, "b": {}}, (24, 32)),
        ({"a": {"size": (12, 16)}, "b": {}, "a2": {"size": (12, 16)}}, (12, 16)),
    ],
)
def test_the_set_of_most_frames_is_used_and_of_as_many_the_largest(modes, size, tmp_path):
    capture, said = capture_of(sets(tmp_path / "in", **modes), Options({}), tmp_path / "cache")
    assert {r.size for r in capture.recordings} == {size}
    assert f"size {size[0]}x{size[1]}" in used_of(said)


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_files_of_one_image_with_side_cars_are_joined_and_stacks_are_not(tmp_path, suffix):
    about = {"cfa": "MONO", "black_level": 64, "white_level": 1023, "camera": "Acme 100"}
    rng, one, stacks = np.random.default_rng(3), tmp_path / "one", tmp_path / "stacks"
    for folder in (one, stacks):
        folder.mkdir()
    for kind, exposure, level in (("dark", 0.01, 64), ("flat", 0.02, 500)):
        more = json.dumps(about | {"kind": kind, "exposure_s": exposure})
        frames = rng.normal(level, 4, (3, 24, 32)).round().astype(np.uint16)
        np.save(stacks / f"{kind}.npy", frames)
        (stacks / f"{kind}.json").write_text(more)
        for n, frame in enumerate(frames):
            np.save(one / f"{kind}_{n}.npy", frame) if suffix == ".npy" else Image.fromarray(frame).save(
                one / f"{kind}_{n}.png"
            )
            (one / f"{kind}_{n}.json").write_text(more)
    joined, stacked = (capture_of(f, Options({}), tmp_path / "cache")[0] for f in (one, stacks))
    assert {r.kind: r.count for r in joined.recordings} == {"dark": 3, "flat": 3}
    assert {r.kind: r.count for r in stacked.recordings} == {"dark": 3, "flat": 3}
    for r, other in zip(joined.recordings, stacked.recordings, strict=True):
        np.testing.assert_array_equal(r.frames, other.frames)


@pytest.mark.parametrize("kind", ["scene", None])
def test_images_that_may_be_of_anything_stay_apart(tmp_path, kind):
    about = {"cfa": "MONO", "black_level": 64, "white_level": 1023, "camera": "Acme 100"}
    for n in range(3):
        Image.fromarray(np.full((24, 32), 200 + 100 * n, np.uint16)).save(tmp_path / f"view{n}.png")
        (tmp_path / f"view{n}.json").write_text(json.dumps(about | ({"kind": kind} if kind else {})))
    capture, said = capture_of(tmp_path, Options({}), tmp_path / "cache")
    assert [r.count for r in capture.recordings] == [1, 1, 1] and said == ""


def test_a_folder_is_converted_once(tmp_path):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    steps = []
    capture, said = capture_of(folder, Options({}), cache, lambda n, total: steps.append(n))
    assert {r.kind for r in capture.recordings} == {"bias", "dark", "flat"} and "flat_2s.h5" in said
    assert capture.path == str(folder) and steps
    steps.clear()
    again, said_again = capture_of(folder, Options({}), cache, lambda n, total: steps.append(n))
    assert not steps and said_again == said and len(again.recordings) == 3
    other, _ = capture_of(folder, Options({"black_level": (990.0,)}), cache)
    assert {r.black_level for r in other.recordings} == {(990.0,) * 4}
    shot(folder / "dark_3.fits", "dark", IMAGETYP="Dark Frame", EXPTIME=60.0, INSTRUME="Acme 100")
    changed, _ = capture_of(folder, Options({}), cache)
    assert max(r.count for r in changed.recordings) == 3
    prepared = tmp_path / "out"
    for _ in write_plan(plan_folder(folder), prepared):
        pass
    assert capture_of(prepared, Options({}), tmp_path / "unused")[1] == ""
    assert not (tmp_path / "unused").exists()


def test_files_replaced_by_others_of_the_same_size_and_time_are_converted_again(tmp_path):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    before, _ = capture_of(folder, Options({}), cache)
    for path in folder.glob("flat*"):
        about = path.stat()
        other = np.asarray(fits.getdata(path)) + 500
        fits.PrimaryHDU(other.astype(np.uint16), fits.getheader(path)).writeto(path, overwrite=True)
        os.utime(path, ns=(about.st_atime_ns, about.st_mtime_ns))
        assert (path.stat().st_size, path.stat().st_mtime_ns) == (about.st_size, about.st_mtime_ns)
    after, _ = capture_of(folder, Options({}), cache)
    levels = [np.mean(next(r for r in c.recordings if r.kind == "flat").frames[:]) for c in (before, after)]
    assert levels[1] - levels[0] == 500


def test_recordings_of_a_converted_folder_are_named_after_its_files(tmp_path, caplog):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    for cached in (False, True):
        caplog.clear()
        capture, _ = capture_of(folder, Options({"white_level": 9100.0}), cache)
        dark = capture.of_kind("dark")[0]
        assert dark.path == f"{folder / 'dark_1.fits'} and 1 more", cached
        assert dark.sources == (str(folder / "dark_1.fits"), str(folder / "dark_2.fits"))
        (line,) = (record.getMessage() for record in caplog.records)
        assert line.startswith(f"{folder / 'flat_1.fits'} and 1 more: ") and line.endswith("saturated")


def test_a_damaged_conversion_in_the_cache_is_made_anew(tmp_path):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    first, said = capture_of(folder, Options({}), cache)
    frames = first.recordings[0].frames[:]
    for damaged in ("*.h5", "sources.json"):
        path = next(cache.glob(f"*/{damaged}"))
        path.write_bytes(path.read_bytes()[:50])
        again, said_again = capture_of(folder, Options({}), cache)
        assert said_again == said and (again.recordings[0].frames[:] == frames).all()


def test_what_a_kill_left_in_the_cache_is_removed_and_a_full_one_is_named(tmp_path, monkeypatch):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    (cache / ".making-999999999-x").mkdir(parents=True)
    capture_of(folder, Options({}), cache)
    assert len(list(cache.iterdir())) == 1

    def full(path, recording):
        raise BadInput(f"{path}: cannot be written: no space left on the disk")

    monkeypatch.setattr("cannoise_jax.recordings.folders.store.write_recording", full)
    with pytest.raises(BadInput, match="cache of converted folders.*no space.*XDG_CACHE_HOME"):
        capture_of(folder, Options({"camera": "X"}), cache)
    assert len(list(cache.iterdir())) == 1


_READER = """
import sys
from pathlib import Path
from cannoise_jax.recordings.folders.store import Options, capture_of
capture, _ = capture_of(Path(sys.argv[1]), Options({}), Path(sys.argv[2]))
print("open", flush=True)
for line in sys.stdin:
    print(int(sum(int(r.frames[:].sum()) for r in capture.recordings)), flush=True)
"""


def test_a_conversion_that_another_process_reads_stays_until_that_ends(tmp_path):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    with subprocess.Popen(
        [sys.executable, "-c", _READER, str(folder), str(cache)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    ) as reader:  # fmt: skip
        assert reader.stdout.readline() == "open\n"
        read = next(cache.iterdir())

        def others(first):
            for n in range(first, first + 8):
                capture_of(folder, Options({"black_level": (900.0 + n,)}), cache)

        others(0)
        reader.stdin.write("again\n")
        reader.stdin.flush()
        total = sum(int(r.frames[:].sum()) for r in capture_of(folder, Options({}), cache)[0].recordings)
        assert reader.stdout.readline() == f"{total}\n"
        reader.kill()  # as without a word
    gc.collect()
    others(8)
    assert not read.exists() and len(list(cache.iterdir())) == store._KEPT


def test_frames_of_a_conversion_can_be_read_while_anything_refers_to_them(tmp_path):
    folder, cache = night(tmp_path / "in"), tmp_path / "cache"
    captures = [capture_of(folder, Options({"camera": f"{n}"}), cache)[0] for n in range(9)]
    frames = [capture.recordings[0].frames for capture in captures]
    copy = pickle.loads(pickle.dumps(frames[0]))
    assert len({f[:].tobytes() for f in (*frames, copy)}) == 1
    assert len(list(cache.iterdir())) == 9
    del frames, captures
    gc.collect()
    capture_of(folder, Options({"camera": "last"}), cache)
    assert len(list(cache.iterdir())) == store._KEPT + 1 and copy[:].any()  # one is held by the copy


def test_flats_below_the_darks_are_refused(tmp_path):
    for _ in write_plan(plan_folder(night(tmp_path / "in")), tmp_path / "out"):
        pass
    flat, dark = (tmp_path / "out" / name for name in ("flat_2s.h5", "dark_60s.h5"))
    usable(capture_of(tmp_path / "out", Options({}), tmp_path / "unused")[0])
    for path, kind in ((flat, "dark"), (dark, "flat")):
        write_recording(path, dataclasses.replace(read_recording(path), kind=kind))
    (tmp_path / "out" / "bias.h5").unlink()
    swapped, _ = capture_of(tmp_path / "out", Options({}), tmp_path / "unused")
    with pytest.raises(BadInput, match="wrong way round") as refused:
        usable(swapped)
    assert str(refused.value).startswith(f"{dark}: the brightest flat")


@pytest.mark.parametrize("native", [False, True])
def test_one_of_two_cameras_in_a_flat_folder_is_left_out_by_the_names_of_its_files(tmp_path, native):
    folder, cache = tmp_path / "in", tmp_path / "cache"
    folder.mkdir()
    for prefix, camera in (("a", "Acme 100"), ("b", "Other 5")):
        files = night(tmp_path / prefix if native else folder, prefix + "_{kind}_{n}.fits", INSTRUME=camera)
        for r in capture_of(files, Options({}), cache)[0].recordings if native else ():
            write_recording(folder / f"{prefix}_{r.kind}.h5", dataclasses.replace(r, path=None))
    with pytest.raises(BadInput, match=r"--leave-out NAME\*, or name them --camera NAME") as error:
        capture_of(folder, Options({}), cache)
    assert "holds 2 cameras (Acme 100: a_" in str(error.value) and "Other 5: b_" in str(error.value)
    capture, _ = capture_of(folder, Options({}, leave_out=("b_*",)), cache)
    assert capture.camera == "Acme 100" and {r.kind for r in capture.recordings} == {"bias", "dark", "flat"}
