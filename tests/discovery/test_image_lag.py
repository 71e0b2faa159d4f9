"""Charge that stays behind hides neither a lamp that drifts nor what is frozen, nor changes what is in DN."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.report.document import document
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import of_larger_gain
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, GAIN, READ, BLACK = (80, 112), 0.8, 3.0, 200.0
LAG, LAMP, PRNU, RATE = 0.05, 0.004, 0.009, 8.0


@pytest.fixture(scope="module")
def found():
    rng, taken = np.random.default_rng(11), []
    sensitive = 1 + PRNU * rng.standard_normal(SIZE)
    shots = (("dark", 0.0, 0.01), ("dark", 0.0, 4.0), ("dark", 0.0, 16.0))
    shots = (*shots, *(("flat", level, 0.01) for level in (700.0, 1800.0, 3500.0)))
    for kind, level, seconds in shots:
        left, frames = None, []
        for _ in range(10):
            light = level * (1 + LAMP * rng.standard_normal())
            e = rng.poisson(light * sensitive + RATE * seconds).astype(float)
            left = e if left is None else left
            read = (1 - LAG) * e + LAG * left
            left = e
            frames.append(BLACK + GAIN * (read + READ * rng.standard_normal(SIZE)))
        codes = np.clip(np.rint(np.stack(frames)), 0, 4095).astype(np.uint16)
        taken.append(Recording(codes, "MONO", (BLACK,) * 4, 4095.0, "made", kind, exposure_s=seconds))
    diagnosis = diagnose(CaptureSet("made", tuple(taken)), compare=False)
    return diagnosis, {f["mechanism"]: f for f in document(diagnosis, key=0, version="0")["findings"]}


def test_what_is_beside_lag_is_found(found):
    _, findings = found
    assert {"image_lag", "illumination_drift", "prnu", "dark_current"} <= set(findings)
    assert findings["image_lag"]["amplitude"]["value"] == pytest.approx(LAG, abs=0.012)
    low, high = findings["illumination_drift"]["amplitude"]["ci90"]
    assert low < 1.3 * LAMP and high > 0.7 * LAMP
    assert findings["prnu"]["amplitude"]["value"] == pytest.approx(PRNU, rel=0.06)


def test_strengths_in_electrons_are_at_the_gain_beside_the_findings(found):
    """Of the variance lag leaves nine tenths, and the fitted gain with it."""
    diagnosis, findings = found
    fitted = np.mean([b.gain for b in diagnosis.first.baselines])
    assert fitted == pytest.approx(GAIN * ((1 - LAG) ** 2 + LAG**2), rel=0.03)
    assert np.mean(diagnosis.model.gain_dn_per_e) == pytest.approx(GAIN, rel=0.04)
    assert findings["dark_current"]["amplitude"]["value"] == pytest.approx(RATE, rel=0.04)
    (own,) = (f for f in diagnosis.model.mechanisms if f.mechanism == "dark_current")
    assert float(own.parameters["e_per_s"]) == pytest.approx(RATE, rel=0.05)


def test_beside_a_larger_gain_electrons_are_fewer_and_dn_the_same():
    model = SensorModel.poisson_gaussian(2.0, 3.0, 256, 16383, "RGGB").with_mechanism("prnu", sigma=0.01)
    model = model.with_mechanism("hot_pixels", e_per_s=120.0, fraction=0.01)
    prnu, hot = (of_larger_gain(f, 1.2) for f in sorted(model.mechanisms, key=lambda f: f.mechanism)[::-1])
    assert prnu.parameters["sigma"] == 0.01 and hot.parameters["fraction"] == 0.01
    assert hot.parameters["e_per_s"] == pytest.approx(100.0)
