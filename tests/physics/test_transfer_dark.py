"""Dark charge is counted once: in the mechanism, not in the black level and the read noise beside it too."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED, MECHANISMS
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.model import find_mechanisms, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import photon_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, RATE = (96, 128), 20.0


@pytest.fixture(scope="module", params=[1.0, 0.01], ids=["long", "short"])
def calibrated(request):
    """Flats and darks of one exposure, and darks of two more, of a camera with dark current."""
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 100.0, 16383.0, "RGGB").with_mechanism(
        "dark_current", e_per_s=RATE, scaling=None
    )
    plan = [("flat", level, request.param, 4) for level in (0.02, 0.1, 0.3, 0.5)]
    plan += [("dark", 0.0, seconds, 8) for seconds in (request.param, 4.0, 16.0)]
    recordings = []
    for n, (kind, level, seconds, frames) in enumerate(plan):
        drawn = camera.sample(
            jax.random.key(n), jnp.full(SIZE, level), Settings(100.0, seconds, frames=frames)
        )
        recordings.append(
            Recording(
                frames=np.asarray(drawn),
                cfa="RGGB",
                black_level=(100.0,) * 4,
                white_level=16383.0,
                kind=kind,
                iso=100.0,
                exposure_s=seconds,
            )
        )
    transfers = photon_transfer(CaptureSet("c", tuple(recordings)))
    findings = find_mechanisms(transfers[0].statistics, transfers[0].baseline, LISTED)
    return transfers, findings, sensor_model(transfers, findings), recordings


def test_darks_come_back_as_dark_as_they_were(calibrated):
    _, _, model, recordings = calibrated
    for r in (r for r in recordings if r.kind == "dark"):
        mean = float(np.mean(model.expected(jnp.zeros(SIZE), Settings(100.0, r.exposure_s))))
        assert mean == pytest.approx(np.mean(r.frames), abs=0.01 * 2 * RATE * r.exposure_s + 0.3)
    assert np.mean(model.black_level) == pytest.approx(100.0, abs=0.8)
    assert np.mean(model.read_noise_e) == pytest.approx(3.0, rel=0.06)


def test_interval_of_the_dark_current_holds_the_doubt_about_the_gain(calibrated):
    transfers, findings, _, _ = calibrated
    (found,) = (f for f in findings if f.mechanism == "dark_current")
    low, high = found.estimates["e_per_s"].ci90
    slope = transfers[0].baseline
    doubt = np.linalg.norm(np.divide(slope.gain_stderr, slope.gain)) / 4
    assert (high - low) / 2 >= 1.6 * doubt * RATE
    assert low - 0.02 * RATE < RATE < high + 0.02 * RATE
    channels = [q.outcome for q in transfers[0].quantities if q.name == "dark current, by mean"]
    held = [q.ci90[0] <= RATE <= q.ci90[1] for q in channels]
    assert sum(held) >= 3  # four intervals of 90 %
    certain = dataclasses.replace(slope, gain_stderr=(0.0,) * 4)
    findings = find_mechanisms(transfers[0].statistics, certain, [MECHANISMS["dark_current"]])
    again = findings[0]
    assert again.estimates["e_per_s"].stderr < found.estimates["e_per_s"].stderr


def test_correlations_of_white_noise_are_zero_within_their_intervals():
    rng, held, values = np.random.default_rng(5), [], []
    for _ in range(60):
        frames = np.round(rng.normal(100, 6, (16, 32, 96))).astype(np.uint16)
        r = Recording(frames=frames, cfa="RGGB", black_level=(90.0,) * 4, white_level=4095.0, kind="dark")
        (result,) = photon_transfer(CaptureSet("c", (r,)))
        found = [q.outcome for q in result.quantities if q.name.startswith("correlation of pixels")]
        held.append([e.ci90[0] <= 0 <= e.ci90[1] for e in found])
        values.append([e.value for e in found])
    error = np.std(values, 0) / np.sqrt(len(values))
    assert np.all(np.abs(np.mean(values, 0)) < 3.5 * error)
    assert 0.82 < np.mean(held) < 0.97
