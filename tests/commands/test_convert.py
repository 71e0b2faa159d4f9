import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest

from cannoise_jax.commands.convert import main
from cannoise_jax.recordings.native import read_recording
from tests.recordings.dng import write_dng
from tests.recordings.folders.night import night, shot
from tests.recordings.test_fits import write as write_fits
from tests.recordings.test_native import write as write_native
from tests.recordings.test_sidd import write_instance
from tests.recordings.test_stacks import write as write_stack

FRAMES = np.random.default_rng(0).integers(100, 1000, (3, 32, 48)).astype(np.uint16)


def run(*arguments):
    return main([str(a) for a in arguments])


def test_every_format_becomes_native(tmp_path):
    sidd, codes = write_instance(tmp_path)
    cases = {
        "dng": ([write_dng(tmp_path / "a.dng", FRAMES[0])], FRAMES[:1], []),
        "fits": ([write_fits(tmp_path / "a.fits", FRAMES, BAYERPAT="GRBG")], FRAMES, ["--black-level", 9]),
        "tiff": ([write_stack(tmp_path / "b.tif", FRAMES)], FRAMES, []),
        "npy": ([write_stack(tmp_path / "c.npy", FRAMES)], FRAMES, []),
        "native": ([write_native(tmp_path / "d.h5", FRAMES)], FRAMES, []),
        "sidd": ([sidd], codes, []),
    }
    for name, (inputs, frames, flags) in cases.items():
        out = tmp_path / f"out_{name}.h5"
        assert run(*inputs, out, *flags, "--white-level", 1023) == 0
        recording = read_recording(out)
        np.testing.assert_array_equal(recording.frames[:], frames)
        with h5py.File(out) as file:
            assert {"cfa", "black_level", "white_level"} <= set(file.attrs)
    sidd_out = read_recording(tmp_path / "out_sidd.h5")
    assert (
        sidd_out.clean.shape == (2, 12, 20) and sidd_out.reference == "burst_mean" and sidd_out.camera == "S6"
    )


def test_flags_state_what_a_file_lacks(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES)
    flags = [
        "--cfa",
        "GBRG",
        "--white-level",
        "1000",
        "--kind",
        "flat",
        "--camera",
        "X1",
        "--iso",
        "200",
        "--exposure",
        "0.5",
    ]
    levels = ("--black-level", 60, 61, 62, 63)
    for arguments in (
        (tmp_path / "a.npy", tmp_path / "b.h5", *flags, *levels),
        (*levels, tmp_path / "a.npy", tmp_path / "b.h5", *flags, "--force"),
        (*flags, "--black-level", "60,61,62,63", tmp_path / "a.npy", tmp_path / "b.h5", "--force"),
    ):
        assert run(*arguments) == 0
        assert read_recording(tmp_path / "b.h5").black_level == (60, 61, 62, 63)
    recording = read_recording(tmp_path / "b.h5")
    assert recording.cfa == "GBRG" and recording.white_level == 1000
    assert (recording.kind, recording.camera, recording.iso, recording.exposure_s) == ("flat", "X1", 200, 0.5)


def test_several_inputs_are_stacked_in_the_order_given(tmp_path, capsys):
    paths = [write_dng(tmp_path / f"{n}.dng", FRAMES[n]) for n in range(3)]
    assert run(paths[2], paths[0], paths[1], tmp_path / "out.h5") == 0
    np.testing.assert_array_equal(read_recording(tmp_path / "out.h5").frames[:], FRAMES[[2, 0, 1]])
    assert "3 frames of 32 x 48, RGGB, Acme Phone 3" in capsys.readouterr().out
    cleans = np.zeros((32, 48), np.float32), np.ones((2, 32, 48), np.float32)
    more = write_native(tmp_path / "more.h5", FRAMES[:2], clean=cleans[0], temperature_c=20.0)
    again = write_native(tmp_path / "again.h5", FRAMES[1:], clean=cleans[1], temperature_c=22.0)
    assert run(more, again, tmp_path / "two.h5") == 0
    both = read_recording(tmp_path / "two.h5")
    np.testing.assert_array_equal(both.frames[:], FRAMES[[0, 1, 1, 2]])
    np.testing.assert_array_equal(both.clean[:, 3, 4], [0, 0, 1, 1])
    assert both.temperature_c == 21


def refused(capsys, message, *arguments):
    before = {p: p.stat().st_mtime_ns for p in Path(arguments[0]).parent.rglob("*")}
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.err.count("\n") == 1 and printed.err.startswith("bin/convert: ") and message in printed.err
    assert printed.out == ""
    assert {p: p.stat().st_mtime_ns for p in Path(arguments[0]).parent.rglob("*")} == before


def test_what_does_not_belong_together_is_not_mixed(tmp_path, capsys):
    first = write_native(tmp_path / "a.h5", FRAMES, iso=100.0)
    others = {
        "iso is 200.0": {"iso": 200.0},
        "cfa is BGGR": {"cfa": "BGGR", "iso": 100.0},
        "black_level is": {"black_level": 63.0, "iso": 100.0},
        "camera is Y": {"camera": "Y", "iso": 100.0},
        "kind is dark": {"kind": "dark", "iso": 100.0},
        "exposure_s is 1.0": {"exposure_s": 1.0, "iso": 100.0},
        "30 x 48 pixels": {"frames": FRAMES[:, :30], "iso": 100.0},
        "holds no reference": {"clean": np.zeros((32, 48), np.float32), "iso": 100.0},
    }
    for n, (message, content) in enumerate(others.items()):
        other = write_native(tmp_path / f"b{n}.h5", **({"frames": FRAMES} | content))
        refused(capsys, message, first, other, tmp_path / "out.h5")


def test_unusable_input_and_output_get_one_line(tmp_path, capsys):
    good = write_native(tmp_path / "good.h5", FRAMES)
    (tmp_path / "bad.h5").write_bytes(b"nothing")
    np.save(tmp_path / "bare.npy", FRAMES)
    out = tmp_path / "out.h5"
    refused(capsys, "bad.h5: not a readable HDF5 file", good, tmp_path / "bad.h5", out)
    refused(capsys, "set them with --cfa", tmp_path / "bare.npy", out)
    refused(capsys, "none.h5: no such file or folder", good, tmp_path / "none.h5", out)
    refused(capsys, "none: no such file or folder", tmp_path / "none", "--dry-run")
    refused(capsys, "none: no such file or folder", tmp_path / "none", tmp_path / "set", "--dry-run")
    refused(capsys, "good.h5: exists", good, good)
    refused(capsys, "good.h5: is a file: name a folder for out.h5", good, good / "none" / "out.h5")
    refused(capsys, "ends in .h5", good, tmp_path / "out.tif")
    refused(capsys, "is not below white level", good, out, "--black-level", "2000")
    (tmp_path / "empty").mkdir()
    refused(capsys, "name a folder for the output", tmp_path / "empty", out)
    refused(capsys, "stored codes start at 0", good, out, "--black-level=-5")
    refused(capsys, "holds no recordings", tmp_path / "empty", tmp_path / "new")


def test_folders_that_do_not_exist_are_made(tmp_path, capsys):
    good, out = write_native(tmp_path / "good.h5", FRAMES), tmp_path / "a" / "b" / "c" / "out.h5"
    refused(capsys, "is not below white level", good, out, "--black-level", "2000")
    assert not (tmp_path / "a").exists()
    assert run(good, out) == 0 and out.is_file()


def test_overwriting_is_asked_for_and_may_replace_an_input(tmp_path, capsys):
    path = write_native(tmp_path / "a.h5", FRAMES)
    assert run(path, path, "--force", "--kind", "dark") == 0
    recording = read_recording(path)
    assert recording.kind == "dark" and (recording.frames[:] == FRAMES).all()


def test_a_folder_that_cannot_be_written_is_said_before_anything_is_read(tmp_path, capsys, monkeypatch):
    def refuse(**_):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.TemporaryFile", refuse)
    monkeypatch.setattr("cannoise_jax.recordings.load.load_recording", lambda *_, **__: pytest.fail("read"))
    monkeypatch.setattr(
        "cannoise_jax.recordings.folders.plan.plan_folder", lambda *_, **__: pytest.fail("read")
    )
    recording = write_native(tmp_path / "a.h5", FRAMES)
    for arguments in ((recording, tmp_path / "b.h5"), (tmp_path, tmp_path.parent / "none" / "out")):
        assert run(*arguments) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "cannot be written (Read-only file system)" in line
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


def test_a_full_disk(tmp_path):
    """A limit on file size stands in for a full disk; the command runs as users run it."""
    noise = np.random.default_rng(0).integers(0, 65535, (4, 128, 128)).astype(np.uint16)
    path = write_native(tmp_path / "a.h5", noise, white_level=65535.0)
    script = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000));"
        "from cannoise_jax.commands.convert import main; sys.exit(main(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", script, str(path), str(tmp_path / "out.h5")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1 and "out.h5: cannot be written: File too large" in done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"]


@pytest.mark.parametrize("arguments", [["--help"], ["only.h5"]])
def test_usage(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "only.h5").touch()
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == (0 if arguments == ["--help"] else 2)


@pytest.mark.parametrize("level", ["abc", "1,2", "1,2,3,x"])
def test_a_black_level_that_is_none_is_refused_in_one_line(level, capsys):
    with pytest.raises(SystemExit) as caught:
        main(["a.h5", "b.h5", "--black-level", level])
    error = capsys.readouterr().err
    assert caught.value.code == 2 and error.count("\n") == 1
    assert error.startswith("bin/convert: argument --black-level: ") and repr(level) in error
    assert "four as a,b,c,d" in error and error.endswith("(see --help)\n")


@pytest.mark.parametrize(
    "stated, says",
    [
        ({"XBINNING": 2, "YBINNING": 2}, "binning is (2.0, 2.0), of"),
        ({"XORGSUBF": 8}, "origin of the part read out is (8.0, 0.0)"),
        ({"OFFSET": 50}, "offset is 50"),
        ({"FILTER": "Ha"}, "filter is Ha"),
    ],
)
def test_files_of_another_readout_are_not_joined(tmp_path, capsys, stated, says):
    one = write_fits(tmp_path / "a.fits", FRAMES[0], BAYERPAT="RGGB")
    other = write_fits(tmp_path / "b.fits", FRAMES[1], BAYERPAT="RGGB", **stated)
    levels = ("--black-level", 9, "--white-level", 1023)
    assert run(one, other, tmp_path / "out.h5", *levels) == 2
    assert says in capsys.readouterr().err and not (tmp_path / "out.h5").exists()


@pytest.mark.parametrize("flags", [("--assign", "a*=dark"), ("--leave-out", "b*")])
def test_flags_that_sort_folders_are_refused_with_single_files(flags, tmp_path, capsys):
    paths = [write_stack(tmp_path / f"{name}.npy", FRAMES) for name in "ab"]
    assert run(*paths, tmp_path / "out.h5", *flags) == 2
    said = capsys.readouterr().err
    assert f"a.npy: {flags[0]} sorts the files of a folder" in said and said.count("\n") == 1
    assert not (tmp_path / "out.h5").exists()


def test_files_that_contradict_are_not_joined_and_copies_are_used_once(tmp_path, capsys):
    levels = ("--black-level", 9, "--white-level", 1023, "--cfa", "RGGB")
    cold, warm, near = (
        write_fits(tmp_path / f"{n}.fits", FRAMES[n], **{"CCD-TEMP": t}) for n, t in enumerate((-10, -5, -4))
    )
    assert run(cold, warm, tmp_path / "out.h5", *levels) == 2
    assert "-5.0 C" in capsys.readouterr().err and not (tmp_path / "out.h5").exists()
    assert run(warm, near, near, warm, tmp_path / "out.h5", *levels) == 0
    assert capsys.readouterr().err.count("the same pixels as") == 2
    np.testing.assert_array_equal(read_recording(tmp_path / "out.h5").frames[:], FRAMES[[1, 2]])
    assert run(cold, warm, tmp_path / "stated.h5", *levels, "--temperature", -7) == 0
    between = write_fits(tmp_path / "c.fits", FRAMES[0], **{"CCD-TEMP": -6.5})
    for n, t in ((3, -8.0), (4, -9.0)):  # each near to the next, the ends apart
        write_fits(tmp_path / f"{n}.fits", FRAMES[n % len(FRAMES)], **{"CCD-TEMP": t})
    chain = (warm, between, tmp_path / "3.fits", tmp_path / "4.fits")
    assert run(*chain, tmp_path / "chain.h5", *levels) == 2 and "-9.0 C" in capsys.readouterr().err


def test_frames_without_noise_are_written_and_said_in_one_line(tmp_path, capsys):
    frames = FRAMES.copy()
    frames[1] = 7
    first = write_stack(tmp_path / "a.npy", frames)
    assert run(first, tmp_path / "one.h5") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        f"bin/convert: {first}: frame 2: every pixel is 7 (no frame of a sensor): no noise in them, "
        "written as they are"
    )
    second = write_stack(tmp_path / "b.npy", FRAMES[[2, 0]])
    assert run(first, second, tmp_path / "two.h5") == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "frame 2: every pixel is 7" in line and "; and 1 more such: " in line
    assert read_recording(tmp_path / "two.h5").count == 5
    assert run(write_stack(tmp_path / "c.npy", FRAMES), tmp_path / "three.h5") == 0
    assert not capsys.readouterr().err


def test_recordings_of_an_earlier_conversion_are_said(tmp_path, capsys):
    folder, out = night(tmp_path / "in"), tmp_path / "out"
    flags = ["--cfa", "MONO", "--white-level", "65535"]
    assert run(folder, out, *flags) == 0
    assert "stays" not in capsys.readouterr().out
    assert run(folder, out, *flags, "--leave-out", "dark*", "--force") == 0
    assert f"note: {out}/dark_60s.h5: not of this conversion, and stays" in capsys.readouterr().out


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_what_a_folder_lacks_is_listed_once_and_counted(tmp_path, capsys, more):
    folder = night(tmp_path / "in")
    (folder / "broken.fits").write_bytes(b"SIMPLE")
    shot(folder / "flat_x.fits", "flat", IMAGETYP="Dark Frame", EXPTIME=1.0, INSTRUME="Acme 100")
    assert run(folder, tmp_path / "out", *more) == 2
    printed = capsys.readouterr()
    listed = [line for line in printed.out.splitlines() if line.startswith("missing or contradictory: ")]
    assert len(listed) == 2 and "broken.fits" in listed[0] and "flat_x.fits" in listed[1]
    counted = f"bin/convert: {folder}: 2 things are missing or contradictory, see the end of the plan\n"
    assert printed.err == counted and not (tmp_path / "out").exists()
    (folder / "broken.fits").unlink()
    assert run(folder, tmp_path / "out", *more) == 2
    assert "1 thing is missing or contradictory, see" in capsys.readouterr().err


def test_a_folder_is_not_converted_into_itself(tmp_path, capsys):
    folder = str(night(tmp_path / "in"))
    assert main([folder, folder]) == 2
    assert capsys.readouterr().err.endswith(
        "is the folder that is read: name another one for what is converted\n"
    )
