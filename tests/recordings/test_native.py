import logging
import os
import resource
import signal
import subprocess
import sys

import h5py
import numpy as np
import pytest

from cannoise_jax.recordings.lazy import LazyArray
from cannoise_jax.recordings.load import load_capture_set, load_recording
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput, Recording, normalise

RNG = np.random.default_rng(0)
FRAMES = RNG.integers(60, 1000, (3, 8, 12)).astype(np.uint16)


def write(path, frames=FRAMES, clean=None, **attributes):
    path.parent.mkdir(exist_ok=True)
    with h5py.File(path, "w") as file:
        if frames is not None:
            file["frames"] = frames
        if clean is not None:
            file["clean"] = clean
        defaults = {"cfa": "RGGB", "black_level": 64.0, "white_level": 1023.0}
        for name, value in (defaults | attributes).items():
            if value is not None:
                file.attrs[name] = value
    return path


@pytest.fixture
def path(tmp_path):
    return tmp_path / "Nikon Z6" / "a.h5"


def test_required_fields_are_enough(path):
    recording = read_recording(write(path))
    assert recording.cfa == "RGGB" and recording.black_level == (64.0,) * 4 and recording.white_level == 1023
    assert recording.camera == "Nikon Z6" and recording.kind == "scene"
    assert recording.iso is None and recording.clean is None and recording.code_step is None
    np.testing.assert_array_equal(recording.frames[:], FRAMES)


@pytest.mark.parametrize("kind", [np.zeros(0), np.arange(3.0), np.ones((2, 2))], ids=lambda k: str(k.shape))
def test_a_kind_that_is_an_array_is_refused(path, kind):
    with pytest.raises(BadInput, match="kind") as refused:
        read_recording(write(path, kind=kind))
    assert "\n" not in str(refused.value)


def test_codes_of_8_bits_are_read_as_such(path):
    narrow = (FRAMES // 4).astype(np.uint8)
    recording = read_recording(write(path, frames=narrow, black_level=3.0, white_level=255.0))
    assert recording.frames.dtype == np.uint16
    np.testing.assert_array_equal(recording.frames[1:], narrow[1:])


def test_everything_survives_writing_and_reading(path):
    before = Recording(
        frames=FRAMES,
        cfa="GBRG",
        black_level=(60.0, 61.5, 62.0, 63.0),
        white_level=4095.0,
        camera="Caméra β",
        kind="flat",
        clean=RNG.random((3, 8, 12), np.float32),
        iso=400.0,
        exposure_s=0.01,
        temperature_c=-12.5,
        shot=(1e-3, 2e-3, 3e-3, 4e-3),
        read=(1e-6, 2e-6, 3e-6, 4e-6),
        code_step=4.0,
        reference="burst_mean",
        reference_frames=150,
    )
    path.parent.mkdir()
    write_recording(path, before)
    after = read_recording(path)
    for name in before.__dataclass_fields__.keys() - {"frames", "clean", "path"}:
        assert getattr(after, name) == getattr(before, name), name
    np.testing.assert_array_equal(after.frames[:], before.frames)
    np.testing.assert_array_equal(np.asarray(after.clean), before.clean)
    assert after.path == str(path)
    write_recording(path.with_name("b.h5"), after)  # from one file straight into another
    np.testing.assert_array_equal(read_recording(path.with_name("b.h5")).frames[:], FRAMES)
    assert sorted(p.name for p in path.parent.iterdir()) == ["a.h5", "b.h5"]


def test_frames_stay_on_disk_until_they_are_indexed(path):
    recording = read_recording(write(path, clean=np.zeros((3, 8, 12), np.float32)))
    assert isinstance(recording.frames, LazyArray) and isinstance(recording.clean, LazyArray)
    assert recording.count == 3 and recording.size == (8, 12) and len(recording.frames) == 3
    np.testing.assert_array_equal(recording.frames[1:], FRAMES[1:])
    np.testing.assert_array_equal(recording.frames[-1], FRAMES[-1])
    np.testing.assert_array_equal(recording.frames[0:2, 2:4, 1:5], FRAMES[0:2, 2:4, 1:5])
    np.testing.assert_array_equal(np.asarray(recording.frames), FRAMES)
    path.unlink()
    with pytest.raises(BadInput, match="cannot read frames"):
        recording.frames[0]


def test_the_callers_word_wins_over_the_file(path):
    write(path, cfa=None, white_level=None, iso=100.0)
    recording = read_recording(
        path, cfa="grbg", white_level=999, black_level=(1, 2, 3, 4), kind="dark", iso=None
    )
    assert (recording.cfa, recording.white_level, recording.kind) == ("GRBG", 999, "dark")
    assert recording.black_level == (1, 2, 3, 4) and recording.iso == 100
    with pytest.raises(TypeError, match="unknown override gain"):
        read_recording(path, gain=3)


def test_a_monochrome_sensor_may_have_odd_sizes(path):
    assert read_recording(write(path, FRAMES[:, :7, :11], cfa="MONO")).size == (7, 11)


BAD = {
    "no dataset 'frames'": {"frames": None},
    r"cfa is missing: set it with --cfa \(cfa= in Python\)": {"cfa": None},
    "black_level is missing: set it with --black-level": {"black_level": None},
    "white_level is missing: set it with --white-level": {"white_level": None},
    "cfa and white_level are missing: set them with --cfa and --white-level": {
        "cfa": None,
        "white_level": None,
    },
    "unknown CFA 'RGBW'": {"cfa": "RGBW"},
    "black level 1023 is not below white level 1023": {"black_level": [0, 0, 0, 1023.0]},
    "black_level array.*expected 1 or 4": {"black_level": [1.0, 2.0, 3.0]},
    "black_level is not finite": {"black_level": np.nan},
    "white_level is not finite": {"white_level": np.inf},
    "white_level .*expected one number": {"white_level": "bright"},
    "7 x 12 pixels is an odd size": {"frames": FRAMES[:, :7]},
    "8 x 11 pixels is an odd size": {"frames": FRAMES[..., :11]},
    "shape \\(8, 12\\): expected": {"frames": FRAMES[0]},
    "frames are float32": {"frames": FRAMES.astype(np.float32)},
    "frames are int16": {"frames": FRAMES.astype(np.int16)},
    "holds no frames": {"frames": FRAMES[:0]},
    "are empty": {"frames": FRAMES[:, :0]},
    "clean has shape \\(8, 11\\)": {"clean": np.zeros((8, 11), np.float32)},
    "clean holds 1 value that is NaN": {"clean": np.where(np.arange(96).reshape(8, 12) == 5, np.nan, 0.5)},
    "clean has median 5.*so it is not normalised: write .DN - black. / .white - black.": {"clean": FRAMES[0]},
    "clean has median 18": {"clean": np.full(FRAMES.shape, 18.0, np.float32)},
    "clean is bool": {"clean": np.zeros((8, 12), bool)},
    "unknown kind 'sky'": {"kind": "sky"},
    "unknown reference 'guess'": {"reference": "guess"},
    "exposure_s is -1": {"exposure_s": -1.0},
    "shot .*expected 1 or 4": {"shot": [1e-3, 1e-3]},
    "code_step is 0.5: stored codes are whole": {"code_step": 0.5},
    "reference_frames is 0": {"reference_frames": 0},
}


@pytest.mark.parametrize("message", BAD)
def test_bad_files_get_one_line_that_names_them(path, message):
    write(path, **BAD[message])
    with pytest.raises(BadInput, match=message) as caught:
        read_recording(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_files_that_are_not_hdf5(path):
    write(path, RNG.integers(0, 1000, (4, 64, 64)).astype(np.uint16))
    whole = path.read_bytes()
    for content in (b"", b"P5 not HDF5", whole[: len(whole) // 2], whole[:-1]):
        path.write_bytes(content)
        with pytest.raises(BadInput, match="not a readable HDF5 file") as caught:
            read_recording(path)
        assert str(path) in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(BadInput, match="no such file"):
        load_recording(path.with_name("missing.h5"))


def test_values_above_white_are_counted_and_warned_of(path, caplog):
    frames = FRAMES.copy()
    frames[1, 2, 3:5] = 1024
    frames[2, 0, 0] = 1023
    with caplog.at_level(logging.WARNING):
        recording = read_recording(write(path, frames))
    assert recording.frames[1, 2, 3] == 1024
    (record,) = caplog.records
    assert "2 values" in record.getMessage() and str(path) in record.getMessage()


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"black_level": 0.0}, "check black_level, white_level"),
        ({"white_level": 16383.0, "code_step": None}, "check black_level, white_level"),
        ({"code_step": 5.0}, "code_step 5 is stated, but 7.* %"),
    ],
)
def test_what_does_not_fit_the_frames_is_warned_of(path, caplog, wrong, message):
    signal = np.linspace(0.02, 0.1, 96).reshape(8, 12)
    codes = RNG.normal(100 + 900 * signal, 3, (3, 8, 12)) // 4 * 4 + 1
    right = {"black_level": 100.0, "white_level": 1000.0, "code_step": 4.0}
    codes[:, :2, :4] = 1000  # clipped pixels lie off the lattice
    with caplog.at_level(logging.WARNING):
        read_recording(write(path, codes.astype(np.uint16), signal.astype(np.float32), **right))
        assert not caplog.records
        read_recording(write(path, codes.astype(np.uint16), signal.astype(np.float32), **(right | wrong)))
    (record,) = caplog.records
    assert message.split(".*")[0] in record.getMessage() and record.getMessage().startswith(f"{path}: ")


@pytest.mark.parametrize(
    "wrong",
    [
        {"camera": "a\nb"},
        {"camera": "x" * 500},
        {"code_step": 0.5},
        {"iso": 1e-40},
        {"black_level": (-1e30,) * 4},
    ],
    ids=str,
)
def test_what_no_reader_takes_is_not_written(path, wrong):
    fields = {"cfa": "RGGB", "black_level": (64.0,) * 4, "white_level": 1023.0} | wrong
    path.parent.mkdir(exist_ok=True)
    with pytest.raises(BadInput, match=path.name):
        write_recording(path, Recording(frames=FRAMES, **fields))
    assert not list(path.parent.iterdir())


def test_a_full_disk_leaves_nothing_behind(path):
    """A limit on file size stands in for a full disk: both make a write fail half way."""
    path.parent.mkdir()
    path.write_bytes(b"an older result")
    script = (
        "import resource, sys, numpy as np\n"
        "from cannoise_jax.recordings import BadInput, Recording\n"
        "from cannoise_jax.recordings.native import write_recording\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "frames = np.random.default_rng(0).integers(0, 65535, (8, 128, 128)).astype(np.uint16)\n"
        "try:\n"
        "    write_recording(sys.argv[1], Recording(frames, 'RGGB', (0,) * 4, 65535))\n"
        "except BadInput as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("\n") == 1 and f"{path}: cannot be written" in done.stdout
    assert [p.name for p in path.parent.iterdir()] == ["a.h5"]
    assert path.read_bytes() == b"an older result"


def test_an_interrupt_while_hdf5_writes_leaves_nothing_behind(path):
    """Also one that comes while HDF5 calls back: what is raised there it drops, and may crash."""
    path.parent.mkdir()
    script = (
        "import os, signal, sys, numpy as np\n"
        "from cannoise_jax.recordings import Recording, native\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in what runs behind
        "class Interrupted(native._Sink):\n"
        "    def write(self, data):\n"
        "        os.kill(os.getpid(), signal.SIGINT)\n"
        "        return super().write(data)\n"
        "native._Sink = Interrupted\n"
        "frames = np.random.default_rng(0).integers(0, 65535, (8, 128, 128)).astype(np.uint16)\n"
        "try:\n"
        "    native.write_recording(sys.argv[1], Recording(frames, 'RGGB', (0,) * 4, 65535))\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted', signal.getsignal(signal.SIGINT) is signal.default_int_handler)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "interrupted True\n", "")
    assert not list(path.parent.iterdir())


def test_an_interrupt_ends_writing_before_the_next_frames_are_read(path):
    seen = []

    def read(index):
        seen.append(index)
        os.kill(os.getpid(), signal.SIGINT)
        return np.zeros((1, 4096, 4096), np.uint16)

    path.parent.mkdir()
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        frames = LazyArray(read, (9, 4096, 4096), np.dtype(np.uint16))
        with pytest.raises(KeyboardInterrupt):
            write_recording(path, Recording(frames, "RGGB", (0,) * 4, 65535))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert len(seen) == 1 and not list(path.parent.iterdir())


def test_memory_does_not_grow_with_the_number_of_frames(path):
    path.parent.mkdir()
    with h5py.File(path, "w") as file:
        file.create_dataset("frames", (4000, 256, 256), np.uint16, chunks=(1, 256, 256))  # 524 MB, all zero
        file.attrs.update({"cfa": "RGGB", "black_level": 0.0, "white_level": 1000.0})
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_recording(path).count == 4000  # reads every frame once, to count saturation
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 250_000  # kB


def test_a_capture_set_is_the_recordings_of_one_folder_by_name(path):
    for name, kind in (("b.h5", "flat"), ("a.h5", "bias"), ("c.H5", "dark")):
        write(path.with_name(name), kind=kind)
    path.with_name("notes.txt").write_text("cold night")
    path.with_name(".a.h5.1.partial").write_text("")
    captures = load_capture_set(path.parent, iso=200)
    assert captures.camera == "Nikon Z6" and [r.kind for r in captures.recordings] == ["bias", "flat", "dark"]
    assert [r.kind for r in captures.of_kind("dark", "bias")] == ["bias", "dark"]
    assert all(r.iso == 200 for r in captures.recordings)


def test_folders_that_hold_no_capture_set(tmp_path, path):
    with pytest.raises(BadInput, match="holds no recordings"):
        load_capture_set(tmp_path)
    with pytest.raises(BadInput, match="no such folder"):
        load_capture_set(tmp_path / "none")
    (tmp_path / "night" / "darks").mkdir(parents=True)
    with pytest.raises(BadInput, match="only folders: make one set of them with bin/convert"):
        load_capture_set(tmp_path / "night")
    write(path)
    with pytest.raises(BadInput, match="is a file: name its folder"):
        load_capture_set(path)
    write(path.with_name("b.h5"), camera="another")
    with pytest.raises(BadInput, match="2 cameras .Nikon Z6: a.h5; another: b.h5.: one folder a camera"):
        load_capture_set(path.parent)
    assert load_capture_set(path.parent, camera="both").camera == "both"


def test_normalised_values_put_black_at_0_and_white_at_1(path):
    recording = read_recording(write(path, black_level=[10.0, 20.0, 30.0, 40.0], white_level=1010.0))
    values = np.empty((1, 4, 4), np.uint16)
    values[0, ::2, ::2], values[0, ::2, 1::2], values[0, 1::2, ::2], values[0, 1::2, 1::2] = 10, 1010, 520, 40
    recording = Recording(values, "RGGB", recording.black_level, 1010.0)
    np.testing.assert_allclose(normalise(values, recording)[0, :2, :2], [[0, 1], [0.5, 0]])


@pytest.mark.parametrize("camera, count, cfa", [("asi178", 11, "RGGB"), ("asi120", 11, "GRBG")])
def test_real_capture_sets(real_data, camera, count, cfa):
    captures = load_capture_set(real_data / camera)
    assert len(captures.recordings) == count and {r.cfa for r in captures.recordings} == {cfa}
    for recording in captures.of_kind("bias", "dark"):
        part = recording.frames[0]
        assert part.shape == recording.size == (256, 1280) and part.dtype == np.uint16
        assert abs(float(np.median(normalise(part, recording)))) < 0.05
    (flat,) = captures.of_kind("flat")
    assert 0.2 < float(np.median(normalise(flat.frames[0], flat))) < 0.6


def test_real_scene(real_data):
    (scene,) = load_capture_set(real_data / "scmos_live").recordings
    assert scene.kind == "scene" and scene.cfa == "MONO" and scene.frames[3:5].shape == (2, 512, 512)
