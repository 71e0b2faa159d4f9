"""Files that the HDF5 library never comes to an end with are refused, and no others."""

import resource
import struct
import subprocess
import sys
import time

import h5py
import numpy as np
import pytest
import scipy.io

from cannoise_jax.recordings import hdf5
from cannoise_jax.recordings.native import read_recording, write_recording
from cannoise_jax.recordings.recording import BadInput, Recording
from tests.conftest import ROOT

FRAMES = np.random.default_rng(0).integers(60, 1000, (3, 8, 12)).astype(np.uint16)


def foreign(path, libver):
    """A recording as other programs write it: its texts, of variable length, lie in a heap."""
    with h5py.File(path, "w", libver=libver) as file:
        file.create_dataset("frames", data=FRAMES, chunks=(1, 8, 12))
        file.attrs.update({"cfa": "RGGB", "black_level": 64.0, "white_level": 1023.0, "camera": "made"})
    return path


def endless(path, libver="earliest"):
    """Such a file whose heap has lost the sizes of what lies in it: the library counts on the spot."""
    data = bytearray(foreign(path, libver).read_bytes())
    first = data.index(b"GCOL") + 16
    data[first : first + 64] = bytes(64)
    path.write_bytes(data)
    return path


def spends(path, seconds):
    """Whether h5py alone takes more than so many seconds of a core over the attributes of a file."""
    read = f"import h5py; print(dict(h5py.File({str(path)!r}).attrs))"
    limit = (seconds, seconds)
    ended = subprocess.run(
        [sys.executable, "-c", read],
        capture_output=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, limit),
    )
    return ended.returncode < 0


@pytest.mark.parametrize("libver", ["earliest", pytest.param("latest", marks=pytest.mark.slow)])
def test_what_has_no_end_is_refused_and_others_are_read_after_it(tmp_path, libver, monkeypatch):
    monkeypatch.setattr(hdf5, "_WAIT_S", 2.0)
    sound, lost = foreign(tmp_path / "sound.h5", libver), endless(tmp_path / "lost.h5", libver)
    assert spends(lost, 2) and not spends(sound, 2)
    for _ in range(2):
        np.testing.assert_array_equal(read_recording(sound).frames[:], FRAMES)
        with pytest.raises(BadInput, match=r"lost\.h5: damaged: .*does not come to an end"):
            read_recording(lost)


def test_files_of_this_package_need_no_trial(tmp_path, monkeypatch):
    def met(_):
        raise AssertionError("a trial")

    monkeypatch.setattr(hdf5, "_trial", met)
    path = tmp_path / "a.h5"
    write_recording(path, Recording(FRAMES, "RGGB", (64.0,) * 4, 1023.0, camera="made", iso=100.0))
    assert read_recording(path).camera == "made"
    with pytest.raises(BadInput, match="a trial"):
        read_recording(foreign(tmp_path / "b.h5", "earliest"))


def test_a_trial_process_that_is_gone_is_started_again(tmp_path):
    path = foreign(tmp_path / "a.h5", "earliest")
    read_recording(path)
    trial = hdf5._trial(hdf5.os.getpid())
    trial.kill()
    trial.wait()
    assert read_recording(path).camera == "made"


def test_one_that_cannot_start_keeps_nobody_from_reading(tmp_path, monkeypatch):
    hdf5._trial.cache_clear()
    monkeypatch.setattr(sys, "executable", "/bin/false")
    assert read_recording(foreign(tmp_path / "a.h5", "earliest")).camera == "made"
    monkeypatch.setattr(sys, "executable", str(tmp_path / "none"))
    assert read_recording(tmp_path / "a.h5").camera == "made"


def test_a_plain_script_reads_and_leaves_no_process(tmp_path):
    foreign(tmp_path / "a.h5", "earliest")
    endless(tmp_path / "b.h5")
    script = tmp_path / "script.py"
    script.write_text(
        "from cannoise_jax.recordings import hdf5\n"
        "from cannoise_jax.recordings.native import read_recording\n"
        "print(read_recording('a.h5').camera)\n"
        "try:\n    read_recording('b.h5')\nexcept ValueError as error:\n    print(error)\n"
        "read_recording('a.h5')\n"
        "print(hdf5._trial(hdf5.os.getpid()).pid)\n"
    )
    command = [sys.executable, "-X", "dev", "-W", "error::ResourceWarning", script]
    environment = {**hdf5.os.environ, "PYTHONPATH": str(ROOT)}
    said = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    camera, refusal, number = said.stdout.splitlines()
    assert said.returncode == 0 and not said.stderr and camera == "made"
    assert refusal.startswith("b.h5: damaged: ")
    until = time.monotonic() + 10
    while hdf5.Path(f"/proc/{number}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not hdf5.Path(f"/proc/{number}").exists()


def test_matlab_files_that_their_reader_does_not_survive_are_refused_and_others_are_not(tmp_path):
    sound, lost = tmp_path / "sound.mat", tmp_path / "lost.mat"
    scipy.io.savemat(sound, {"metadata": {"levels": np.arange(4) + 0.5}})
    tag = b"\x09\0\0\0\x20\0\0\0"  # doubles, 32 bytes of them
    data = sound.read_bytes()
    assert data.count(tag) == 1
    lost.write_bytes(data.replace(tag, bytes(8)))
    read = f"import scipy.io; scipy.io.loadmat({str(lost)!r}, simplify_cells=True)"
    assert subprocess.run([sys.executable, "-c", read]).returncode == -11
    hdf5.check_matlab(sound)
    with pytest.raises(BadInput, match=r"lost\.mat: damaged: the reader of MATLAB v5 files"):
        hdf5.check_matlab(lost)
    hdf5.check_matlab(sound)


def test_text_that_claims_gigabytes_is_refused_unread(tmp_path):
    """The attribute says how long its text in the heap is; the library makes room for it first."""
    path = foreign(tmp_path / "long.h5", "earliest")
    data = bytearray(path.read_bytes())
    heap = struct.pack("<Q", data.index(b"GCOL"))
    claims = struct.pack("<I", 4) + heap  # of four letters, as cfa and camera have, at this address
    assert claims in data
    path.write_bytes(data.replace(claims, struct.pack("<I", 2_000_000_000) + heap))
    read = f"import resource, h5py\nf = h5py.File({str(path)!r})\n"
    read += "try: f.attrs['cfa']\nexcept OSError: pass\n"
    peak = "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)"
    alone = subprocess.run([sys.executable, "-c", read + peak], capture_output=True, text=True)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadInput, match=r"long\.h5: damaged: .* or takes all memory"):
        read_recording(path)
    assert int(alone.stdout) > 1_500_000  # KB: what is refused is that
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000
