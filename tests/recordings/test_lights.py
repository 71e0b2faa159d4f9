"""Frames of one recording are repeats under one light: other ones are told from them."""

import numpy as np
import pytest

from cannoise_jax.recordings.load import load_recording

RNG = np.random.default_rng(0)
STATED = {"cfa": "MONO", "black_level": (64,), "white_level": 4095}


@pytest.mark.parametrize(
    "kind, levels, told",
    [
        ("flat", [1000] * 6, False),
        ("flat", [1000, 1030, 1060, 1090, 1120], False),  # a lamp that warms up
        ("flat", [500] * 3 + [1000] * 3, True),
        ("scene", [500] * 3 + [1000] * 3, True),
        ("flat", [64, 66], False),  # two codes are no light
        ("dark", [100] * 3 + [200] * 3, False),
        ("flat", [700], False),
    ],
)
def test_several_lights_in_one_recording_are_told(tmp_path, caplog, kind, levels, told):
    frames = np.rint(RNG.normal(np.reshape(levels, (-1, 1, 1)), 3.0, (len(levels), 16, 20)))
    np.save(tmp_path / "a.npy", frames.astype(np.uint16))
    load_recording(tmp_path / "a.npy", kind=kind, **STATED)
    assert ("one light" in caplog.text) == told


def test_frames_with_scenes_of_their_own_may_differ(tmp_path, caplog):
    levels = np.array([500.0, 1000.0, 2000.0])
    clean = np.broadcast_to(((levels - 64) / (4095 - 64))[:, None, None], (3, 16, 20)).astype(np.float32)
    frames = np.rint(RNG.normal(levels[:, None, None], 3.0, (3, 16, 20))).astype(np.uint16)
    np.savez(tmp_path / "a.npz", frames=frames, clean=clean)
    load_recording(tmp_path / "a.npz", kind="scene", **STATED)
    assert "one light" not in caplog.text
