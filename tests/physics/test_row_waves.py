"""One wave along the rows is told from white row noise, and drawn as one."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.estimators.lines import wave_of_rows
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms, format_findings, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import transfer_at
from cannoise_jax.physics.transfer.table import format_transfer
from cannoise_jax.recordings.recording import Recording

SIZE, FREQUENCY = (96, 128), 0.12


def taken(seed, kind, light, wave=0.0, white=0.0, frames=8):
    """A camera of 0.5 DN/e- and 3 e-; wave: peak, white: rms of what rows share, DN."""
    rng = np.random.default_rng(seed)
    charge = rng.poisson(light, (frames, *SIZE)) + 3 * rng.standard_normal((frames, *SIZE))
    phase = 2 * np.pi * (FREQUENCY * np.arange(SIZE[0]) + rng.random((frames, 1)))
    rows = wave * np.sin(phase) + white * rng.standard_normal((frames, SIZE[0]))
    codes = np.clip(np.rint(200 + 0.5 * charge + rows[..., None]), 0, 4095).astype(np.uint16)
    return frame_statistics(Recording(codes, "MONO", (200.0,) * 4, 4095.0, "c", kind, exposure_s=1.0))


def test_a_wave_that_holds_what_rows_share_is_drawn_as_one():
    statistics = [
        taken(1, "flat", 2000.0, 0.8),
        taken(2, "flat", 4000.0, 0.8),
        taken(3, "dark", 0, 0.8, frames=16),
    ]
    transfer = transfer_at(statistics)
    findings = find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    found = next(f for f in findings if f.mechanism == "row_noise")
    assert found.measured["amplitude_dn"].value == pytest.approx(0.8, rel=0.03)
    assert found.measured["frequency"].value == pytest.approx(FREQUENCY, abs=2e-4)
    assert "cycles/row" in format_findings(findings)
    assert "one wave of 0.12 cycles per row" in format_transfer(transfer)
    model = sensor_model([transfer], findings)
    drawn = model.sample(jax.random.key(1), np.zeros(SIZE), Settings(100.0, 1.0, frames=16))
    rows = np.asarray(drawn, float).mean(-1)
    rows = rows - rows.mean(1, keepdims=True)
    power = np.sum(np.abs(np.fft.rfft(rows, axis=1)) ** 2, 0)[1:]
    at = round(FREQUENCY * SIZE[0]) - 1
    assert power[at - 2 : at + 3].sum() > 0.8 * power.sum()
    assert rows.std() == pytest.approx(0.8 / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize(("wave", "white"), [(0.0, 0.6), (0.5, 0.5), (0.0, 0.0)])
def test_white_row_noise_is_no_wave(wave, white):
    for seed in range(6):
        assert wave_of_rows(taken(seed, "dark", 0, wave, white)) is None


def test_rows_that_lean_anew_in_every_frame_are_no_wave():
    rng = np.random.default_rng(1)
    lean = rng.standard_normal((8, 1)) * np.linspace(-1, 1, SIZE[0])
    values = 200 + 1.5 * rng.standard_normal((8, *SIZE)) + lean[..., None]
    codes = np.rint(values).astype(np.uint16)
    dark = frame_statistics(Recording(codes, "MONO", (200.0,) * 4, 4095.0, "c", "dark", exposure_s=1.0))
    assert wave_of_rows(dark) is None
