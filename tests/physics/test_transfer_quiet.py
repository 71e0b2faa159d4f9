"""Darks that are quieter than a code: their noise, its interval, and the gain beside them"""

from __future__ import annotations

import dataclasses
import warnings

import jax
import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.core.sensor import Settings
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimator import BY_CHANCE
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, photon_transfer
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (64, 96)


def recording(kind: str, frames: np.ndarray) -> Recording:
    codes = np.clip(np.rint(frames), 0, 255).astype(np.uint8)
    return Recording(codes, "MONO", (4.0,) * 4, 255.0, "quiet", kind, exposure_s=0.01)


def measured(level: float, read: float, gain: float = 0.02):
    rng = np.random.default_rng(round(1000 * level + 100 * read))
    noise = read * rng.standard_normal((2, 8, *SIZE))
    flat = level + gain * rng.poisson(6000.0, (8, *SIZE)) + noise[1]
    own = recording("dark", level + noise[0]), recording("flat", flat)
    (transfer,) = photon_transfer(CaptureSet("quiet", own))
    return of_all_pixels(transfer)


@pytest.mark.parametrize(
    "level",
    [
        10.0,
        pytest.param(10.21, marks=pytest.mark.slow),
        pytest.param(10.37, marks=pytest.mark.slow),
        10.5,
        pytest.param(10.93, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("read", [0.05, 0.12, 0.27])
def test_the_interval_holds_the_noise_before_rounding(level, read):
    found = measured(level, read)
    for name in ("temporal dark noise", "temporal dark noise, rows included"):
        (noise,) = found.outcomes(name, "DN")
        if isinstance(noise, Estimate):
            assert noise.ci90[0] - 0.03 * read <= read <= noise.ci90[1] + 0.03 * read, name
    (gain,) = found.outcomes("system gain")
    if isinstance(gain, Estimate):
        assert gain.value == pytest.approx(0.02, rel=0.03)


def test_noise_that_shows_at_two_codes_alone_is_bounded_from_above_only():
    (noise,) = measured(10.5, 0.12).outcomes("temporal dark noise", "DN")
    assert isinstance(noise, Estimate) and noise.ci90[0] == 0 and 0.12 < noise.ci90[1] < 0.3
    (noise,) = measured(10.5, 0.35).outcomes("temporal dark noise", "DN")
    assert isinstance(noise, Estimate) and noise.value == pytest.approx(0.35, rel=0.05)


@pytest.mark.parametrize("level", [pytest.param(10.0, marks=pytest.mark.slow), 10.5])
@pytest.mark.parametrize(
    "read, pattern",
    [
        pytest.param(0.05, 0.0, marks=pytest.mark.slow),
        (0.12, 0.3),
        pytest.param(0.2, 0.0, marks=pytest.mark.slow),
        pytest.param(0.3, 0.3, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_found_that_rounding_alone_makes(level, read, pattern):
    """Noise of single pixels, patterns, hot pixels, a dark current: all of them look like what rounds."""
    rng = np.random.default_rng(7)
    offsets = level + pattern * rng.standard_normal(SIZE)
    own = []
    for seconds in (0.01, 1.0, 30.0):
        noise = read * rng.standard_normal((2, 8, *SIZE))
        dark = recording("dark", offsets + noise[0])
        flat = recording("flat", offsets + 0.05 * rng.poisson(1000 + 50 * seconds, (8, *SIZE)) + noise[1])
        own += [dataclasses.replace(r, exposure_s=seconds) for r in (dark, flat)]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        (transfer,), findings = calibrate(CaptureSet("quiet", tuple(own)))
    found = set()
    for finding in findings:
        if not isinstance(finding.estimates, NotMeasurable):
            strength = next(iter(finding.estimates.values()))
            if strength.significant and strength.by_chance < BY_CHANCE:
                found.add(finding.mechanism)
    assert found <= ({"dsnu"} if pattern else set())
    for gain in transfer.outcomes("system gain"):
        if isinstance(gain, Estimate):
            assert gain.value == pytest.approx(0.05, rel=0.06)


def test_a_dark_that_is_one_frame_several_times_has_no_shape():
    frame = 10 + 3 * np.random.default_rng(4).standard_normal(SIZE)
    flat = 10 + 0.02 * np.random.default_rng(5).poisson(6000.0, (4, *SIZE))
    own = recording("dark", np.stack([frame] * 3)), recording("flat", flat)
    (transfer,) = photon_transfer(CaptureSet("copied", own))
    assert not any(q.name.startswith(("row noise over", "correlation of")) for q in transfer.quantities)


def test_offsets_that_round_are_no_sensitivities_of_a_dim_flat():
    """3 DN of light, noise of .1 DN and offsets of 1 DN: the dark map is rounded, the flat is not."""
    rng = np.random.default_rng(38)
    offsets = 10 + rng.standard_normal((96, 128))
    noise = 0.1 * rng.standard_normal((2, 6, 96, 128))
    own = (
        recording("dark", offsets + noise[0]),
        recording("flat", offsets + 0.1 * rng.poisson(30, noise[0].shape) + noise[1]),
    )
    transfers, findings = calibrate(CaptureSet("quiet", own))
    (prnu,) = of_all_pixels(transfers[0]).outcomes("PRNU1288")
    assert isinstance(prnu, Estimate) and prnu.ci90[0] == 0
    assert {f.mechanism for f in findings if f.verdict == "in the model"} == {"dsnu"}


@pytest.mark.parametrize(
    "level", [pytest.param(10.2, marks=pytest.mark.slow), 10.37, pytest.param(10.7, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("read", [0.16, pytest.param(0.3, marks=pytest.mark.slow)])
def test_the_model_of_darks_below_a_code_has_their_mean_and_the_light_its_own(level, read):
    """A black level between two codes is stored as a mean that light, which dithers, does not stand on."""
    rng = np.random.default_rng(round(100 * level + 10 * read))
    noise = read * rng.standard_normal((16, *SIZE))
    own = [dataclasses.replace(recording("dark", level + noise), kind="bias", exposure_s=0.0)]
    for seconds, light in ((0.01, 10.0), (0.05, 50.0), (0.2, 200.0), (0.5, 500.0)):
        charge = rng.poisson(light, (8, *SIZE))
        flat = recording("flat", level + 0.2 * charge + read * rng.standard_normal((8, *SIZE)))
        own.append(dataclasses.replace(flat, exposure_s=seconds))
    (transfer,), findings = calibrate(CaptureSet("quiet", tuple(own)))
    seen = of_all_pixels(transfer)
    (black,), (gain,) = seen.outcomes("black level"), seen.outcomes("system gain")
    assert black.ci90[0] - 0.02 <= level <= black.ci90[1] + 0.02
    assert gain.value == pytest.approx(0.2, abs=max(3 * gain.stderr, 0.004))
    (note,) = (q.note for q in seen.quantities if q.name == "system gain")
    assert "per second" not in note and "straight" not in note
    drawn = sensor_model((transfer,), findings).sample(
        jax.random.key(0), np.zeros((256, 256)), Settings(exposure_s=0.0)
    )
    assert float(np.mean(drawn)) == pytest.approx(own[0].frames.mean(), abs=0.015)
    lacking = {o.record for o in seen.outcomes("DSNU1288", "DN") if isinstance(o, NotMeasurable)}
    assert not any("never change" in why for why in lacking)


@pytest.mark.parametrize(
    ("frames", "level"),
    [(2, 12.3), (5, 12.0), *(pytest.param(n, 12.0, marks=pytest.mark.slow) for n in (2, 3))],
)
def test_pairs_of_flats_and_darks_at_each_exposure_of_a_sensor_quieter_than_a_code(frames, level):
    """The set of EMVA 1288, of a sensor without colours: 0.36 DN of dark noise at 0.045 DN/e-."""
    rng, taken = np.random.default_rng(5), []
    for seconds in (0.005, 0.02, 0.04):
        for kind, electrons in (("dark", 0.0), ("flat", 1.5e6 * seconds)):
            charge = rng.poisson(electrons, (frames, 96, 128)) + 8 * rng.standard_normal((frames, 96, 128))
            codes = np.clip(np.rint(level + 0.045 * charge), 0, 4095).astype(np.uint16)
            taken.append(Recording(codes, "MONO", (12.0,) * 4, 4095.0, "made", kind, exposure_s=seconds))
    (transfer,) = photon_transfer(CaptureSet("made", tuple(taken)))
    found = {(q.name, q.unit): q.outcome for q in of_all_pixels(transfer).quantities}
    assert found["system gain", "DN/e-"].value == pytest.approx(0.045, rel=0.03)
    assert found["temporal dark noise", "DN"].value == pytest.approx(0.36, rel=0.04)
    assert found["black level", "DN"].value == pytest.approx(level, abs=0.02)
