"""Random offsets of whole frames: a few that lie far apart confirm them, all of them say how far."""

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from tests.discovery.capture import capture_set


def wandering(rng):
    """A lamp whose light is a walk: the frames held back may lie close."""
    light = 1.0

    def change(dn, signal, kind, exposure):
        nonlocal light
        light = light * (1 + 0.02 * rng.standard_normal()) if kind == "flat" else 1.0
        return dn + (light - 1) * signal

    return change


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_a_lamp_that_wanders_is_confirmed_and_as_wide_as_all_frames_show(seed):
    capture = capture_set(seed, wandering, kinds="df", size=(64, 96), frames=10)
    flats = [r for r in capture.recordings if r.kind == "flat"]
    means = [np.mean(r.frames, (1, 2)) - 200 for r in flats]
    wide = np.sqrt(np.mean([np.var(m, ddof=1) / np.mean(m) ** 2 for m in means]))
    found = diagnose(capture, key=jax.random.key(0), compare=False)
    n = found.findings.index("illumination_drift")
    assert found.proofs[n].confirmed
    assert found.proofs[n].score.amplitude == pytest.approx(wide, rel=0.3)
