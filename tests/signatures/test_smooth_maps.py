"""A smooth pattern of darks, against all that has a form of its own."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.smooth_maps import smooth_again, smooth_score
from tests.signatures.test_modulated import COLUMNS, FRAMES, ROWS, SIZE, fields

RIGHT = SIZE[1] - 1 - COLUMNS
LEAK = np.exp(-(((ROWS - 20 - 0.2 * COLUMNS) / 14) ** 2)) * np.exp(-RIGHT / 50)
FORMS = {
    "nothing": lambda rng: 0.0,
    "rows": lambda rng: 2 * rng.standard_normal((SIZE[0], 1)),
    "columns": lambda rng: 2 * rng.standard_normal((1, SIZE[1])),
    "pixels": lambda rng: rng.exponential(3.0, SIZE),
    "hot": lambda rng: np.where(rng.random(SIZE) < 0.01, rng.exponential(60.0, SIZE), 0.0),
    "step": lambda rng: 3.0 * (SIZE[1] // 2 < COLUMNS),
    "wave": lambda rng: np.sin(0.7 * ROWS + 0.4 * COLUMNS),
    "areas": lambda rng: np.kron(rng.standard_normal((8, 12)), np.ones((8, 8))),
    "corner": lambda rng: 20 * np.exp(-np.hypot(ROWS, COLUMNS) / 25),
    "edge": lambda rng: 20 * np.exp(-ROWS / 15),
}


def darks(rng, pattern):
    return fields(rng, lambda r: np.broadcast_to(pattern, (FRAMES, *SIZE)))


@pytest.mark.parametrize("form", FORMS)
def test_what_has_a_form_of_its_own_is_left_to_it(form):
    rng = np.random.default_rng(2)
    p = [np.exp(smooth_score(darks(rng, FORMS[form](rng)), scaling="additive").log_p) for _ in range(100)]
    for level in (0.1, 0.02):
        assert np.mean(np.array(p) < level) < level + 3 * np.sqrt(level * (1 - level) / 100)


def test_a_leak_of_light_is_measured_and_the_same_on_other_frames():
    rng = np.random.default_rng(3)
    score = smooth_score(darks(rng, 20 * LEAK), scaling="additive")
    assert score.log_p < -600
    assert score.amplitude == pytest.approx(20 * LEAK.std(), rel=0.03)
    shape = score.payload.field - score.payload.field.mean()
    assert np.corrcoef(shape.ravel(), LEAK.ravel())[0, 1] > 0.995
    again = smooth_again(darks(rng, 20 * LEAK), score, scaling="additive")
    assert abs(again.amplitude - score.amplitude) < 4 * np.hypot(again.error, score.error)
    other = smooth_again(darks(rng, 0.0), score, scaling="additive")
    assert other.amplitude < 4 * other.error and other.gain < 8


@pytest.mark.slow
def test_in_darks_of_two_exposures_light_that_leaks_in_is_a_glow():
    rng = np.random.default_rng(4)
    recordings = []
    for kind, seconds, level in (("dark", 0.1, 0.0), ("dark", 4.0, 0.0), ("flat", 0.1, 900.0)):
        light = level + 5 * seconds * LEAK * (kind == "dark")
        codes = np.round(100 + 1.5 * rng.poisson(light, (8, *SIZE)) + rng.normal(0, 3, (8, *SIZE)))
        recordings.append(
            Recording(
                frames=codes.astype(np.uint16), kind=kind, cfa="MONO", black_level=(100.0,) * 4,
                white_level=4095.0, exposure_s=seconds,
            )
        )  # fmt: skip
    found = diagnose(CaptureSet("camera", tuple(recordings)), compare=False, key=jax.random.key(0))
    told = {s.named.mechanism: s.named.score.amplitude for s in found.fitted.steps}
    # Strong enough to show its form, it counts as a glow, which may have any.
    strength = 1.5 * 20 * float(np.sqrt(np.mean((LEAK - np.quantile(LEAK, 0.005)) ** 2)))
    assert told["amp_glow"] == pytest.approx(strength, rel=0.25)
    assert all(size < 0.05 * strength for name, size in told.items() if name == "unknown")
