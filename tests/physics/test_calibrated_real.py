"""What a camera model calibrated on real recordings gives back, measured as the recordings were."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import CaptureSet, Recording
from tests.conftest import SIMULATION

WITHIN = {
    "system gain": 0.02,
    "typical pixel noise": 0.02,
    "row noise": 0.1,
    "fixed pattern": 0.15,
    "PRNU1288, pixels": 0.05,
}
"""Relative difference allowed."""
SHOWN = (
    *WITHIN,
    *("pixels above 2 x typical", "pixels above 3 x typical", "excess kurtosis", "excess kurtosis, clipped"),
    *("correlation of next rows", "correlation of pixels (0, 1)", "correlation of pixels (0, 2)"),
    *("correlation of pixels (1, 0)", "correlation of pixels (1, 1)"),
)


def drawn(model: SensorModel, recording: Recording, key) -> Recording:
    """As many frames at the same settings, of an even light of each colour."""
    mean = np.asarray(recording.frames, np.float32).mean(0)
    clean = np.zeros(recording.size, np.float32)
    if recording.kind == "flat":
        signal = (mean - recording.black_map()) / (recording.white_level - recording.black_map())
        for channel in range(4):
            site(clean, channel)[...] = site(signal, channel).mean()
    settings = Settings(exposure_s=recording.exposure_s, frames=recording.count)
    return replace(recording, frames=np.asarray(model.sample(key, clean, settings)), clean=None)


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["asi178", "asi120"])
def test_a_calibrated_model_gives_back_what_was_measured(camera, real_data, tables):
    capture = load_capture_set(real_data / camera)
    transfers, findings = calibrate(capture)
    model = sensor_model(transfers, findings)
    keys = jax.random.split(jax.random.key(0), len(capture.recordings))
    again = tuple(drawn(model, r, k) for r, k in zip(capture.recordings, keys, strict=True))
    (simulated,) = photon_transfer(CaptureSet(capture.camera, again))
    rows, found = [], {}
    for name in SHOWN:
        real, ours = (np.mean([o.value for o in t.outcomes(name)]) for t in (transfers[0], simulated))
        rows.append((capture.camera, name, f"{real:.4g}", f"{ours:.4g}"))
        found[name] = (real, ours)
    tables.add("calibrated_model", ("camera", "quantity", "real", "simulated"), rows, SIMULATION)
    for name, most in WITHIN.items():
        real, ours = found[name]
        assert ours == pytest.approx(real, rel=most), name
    for name in SHOWN[-5:]:
        real, ours = found[name]
        assert abs(ours - real) < 0.02, name
