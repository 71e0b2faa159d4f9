"""Two amplifiers of unlike black levels: the calibrated model has their step once."""

import jax
import numpy as np
import pytest

from cannoise_jax.commands.calibrate import calibrate
from cannoise_jax.physics.core.settings import Settings
from cannoise_jax.physics.transfer.estimators.pick import without_step
from cannoise_jax.physics.transfer.model import sensor_model
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE, GAIN, READ, STEP = (64, 96), 0.5, 4.0, 6.0


def recording(kind, light, columns):
    rng = np.random.default_rng([7, kind == "dark"])
    electrons = rng.poisson(light, (8, *SIZE)) + READ * rng.standard_normal((8, *SIZE))
    frames = np.rint(500 + columns + GAIN * electrons).astype(np.uint16)
    return Recording(frames, "MONO", (500.0,) * 4, 16383.0, kind=kind, exposure_s=1.0, path=f"{kind}.h5")


@pytest.mark.parametrize("sigma", [0.0, pytest.param(1.5, marks=pytest.mark.slow)])
def test_the_step_between_two_amplifiers_is_drawn_once(sigma):
    halves = np.repeat([-STEP / 2, STEP / 2], SIZE[1] // 2)
    own = sigma * np.random.default_rng(2).standard_normal(SIZE[1])
    columns = halves + without_step(own)
    dark = recording("dark", 0.0, columns)
    transfers, findings = calibrate(CaptureSet("c", (recording("flat", 9000.0, columns), dark)))
    measured = {f.mechanism: f.measured for f in findings}
    step = measured["amplifier_mismatch"]
    assert step is not None and step["step_dn"].value == pytest.approx(STEP, abs=0.2 + sigma)
    columns_found = measured["column_fpn"]
    if sigma:
        assert columns_found is not None
        assert columns_found["sigma_dn"].value == pytest.approx(own.std(), rel=0.25)
    else:
        assert columns_found is None
    model = sensor_model(transfers, findings)
    clean = np.zeros(SIZE, np.float32)
    settings = Settings(exposure_s=1.0)
    drawn = np.mean([model.sample(jax.random.key(k), clean, settings)[0] for k in range(24)], axis=(0, 1))
    assert drawn == pytest.approx(500 + columns, abs=0.6)
