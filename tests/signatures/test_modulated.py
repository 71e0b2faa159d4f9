"""One pattern of another strength in every frame, against smooth noise that every frame has of its own."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.physics.core.settings import Settings
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.fields import Fields, helmert
from cannoise_jax.signatures.modulated import modulated_again, modulated_score

SIZE = (64, 96)
ROWS, COLUMNS = np.indices(SIZE)
FRAMES = 8


def glow() -> np.ndarray:
    """From two corners, of unit rms and no mean."""
    near = np.exp(-np.hypot(ROWS, COLUMNS) / 30) - 0.6 * np.exp(-np.hypot(ROWS - 63, COLUMNS - 95) / 20)
    near = near - near.mean()
    return near / near.std()


def fields(rng, more, recordings: int = 2) -> tuple[Fields, ...]:
    """White noise of one DN with more in every frame `more(rng)` [t, h, w], as contrasts."""
    out, one = [], np.ones(SIZE, np.float32)
    for n in range(recordings):
        x = rng.standard_normal((FRAMES, *SIZE)) + more(rng)
        contrasts = np.einsum("nt,tij->nij", helmert(FRAMES), x).astype(np.float32)
        static = (x.mean(0) * np.sqrt(FRAMES)).astype(np.float32)
        usable, level = np.ones(SIZE, bool), np.ones(4)
        out.append(
            Fields(
                str(n), "dark", FRAMES, n, 0, 1.0, 1.0, 100 * one, 0 * one, one, 0 * one,
                usable, contrasts, static, None, level, level,
            )
        )  # fmt: skip
    return tuple(out)


def pink(rng, number: int, exponent: float) -> np.ndarray:
    """1/f^exponent noise [t, number] of unit rms."""
    frequency = np.maximum(np.fft.rfftfreq(number), 1 / number)
    drawn = np.fft.rfft(rng.standard_normal((FRAMES, number)), axis=1) * frequency ** (-exponent / 2)
    values = np.fft.irfft(drawn, number, axis=1)
    return values / values.std()


SMOOTH = {
    "rows": lambda rng: 0.7 * rng.standard_normal((FRAMES, SIZE[0], 1)),
    "columns": lambda rng: 0.7 * rng.standard_normal((FRAMES, 1, SIZE[1])),
    "1/f rows": lambda rng: 0.7 * pink(rng, SIZE[0], 1.0)[:, :, None],
    "brown rows": lambda rng: 0.7 * pink(rng, SIZE[0], 1.8)[:, :, None],
    "raster": lambda rng: pink(rng, SIZE[0] * SIZE[1], 1.3).reshape(FRAMES, *SIZE),
    "areas": lambda rng: np.kron(0.5 * rng.standard_normal((FRAMES, 2, 3)), np.ones((32, 32))),
    "frames": lambda rng: 5 * rng.standard_normal((FRAMES, 1, 1)),
}


@pytest.mark.parametrize("kind", SMOOTH)
def test_smooth_noise_that_each_frame_has_of_its_own_is_no_one_pattern(kind):
    rng = np.random.default_rng(3)
    scores = [modulated_score(fields(rng, SMOOTH[kind]), scaling="additive") for _ in range(20)]
    assert min(s.log_p for s in scores) > np.log(1e-4)
    assert np.median([s.log_p for s in scores]) > np.log(0.2)


def test_p_values_of_noise_alone_are_not_too_small():
    rng = np.random.default_rng(4)
    nothing = [modulated_score(fields(rng, lambda r: 0.0), scaling="additive") for _ in range(200)]
    p = np.exp([s.log_p for s in nothing])
    for level in (0.5, 0.1, 0.02):
        assert np.mean(p < level) < level + 3 * np.sqrt(level * (1 - level) / p.size)
    assert all(s.log_p == 0 for s in nothing if s.amplitude == 0)


def test_pattern_and_strength_are_recovered_and_hold_on_other_frames():
    rng, pattern = np.random.default_rng(5), glow()

    def swells(r):
        return 0.3 * r.standard_normal((FRAMES, 1, 1)) * pattern

    seen, other = fields(rng, swells), fields(rng, swells)
    score = modulated_score(seen, scaling="additive")
    assert score.log_p < -100
    assert np.corrcoef(score.payload.field.ravel(), pattern.ravel())[0, 1] ** 2 > 0.97
    assert np.mean(score.payload.field**2) == pytest.approx(1, rel=1e-4)
    assert abs(score.amplitude - 0.3) < 3 * score.error
    again = modulated_again(other, score, scaling="additive")
    assert abs(again.amplitude - 0.3) < 3 * again.error and again.gain > 500
    none = modulated_again(fields(rng, lambda r: 0.0), score, scaling="additive")
    assert none.gain < 5


def test_what_grows_with_the_exposure_is_quoted_at_the_longest():
    rng, pattern = np.random.default_rng(6), glow()
    each = []
    for number, seconds in enumerate((1.0, 1.0, 1.0, 4.0, 4.0, 4.0)):

        def swells(r, s=seconds):
            return 0.1 * s * r.standard_normal((FRAMES, 1, 1)) * pattern

        (field,) = fields(rng, swells, 1)
        each.append(field._replace(exposure_s=seconds, number=number))
    score = modulated_score(tuple(each), scaling="exposure")
    assert abs(score.amplitude - 0.4) < 3 * score.error
    assert modulated_score(tuple(each), scaling="additive").evidence < score.evidence - 10


def test_light_that_leaks_in_is_found_described_and_simulated():
    """A leak whose strength flickers by a third from frame to frame in darks of two exposures."""
    rng, leak = np.random.default_rng(7), np.exp(-(SIZE[1] - 1 - COLUMNS) / 25)
    recordings = []
    for kind, seconds, level in (("dark", 0.1, 0.0), ("dark", 4.0, 0.0), ("flat", 0.1, 900.0)):
        strength = 0.4 * seconds * (1 + rng.standard_normal((12, 1, 1)) / 3) * (kind == "dark")
        electrons = rng.poisson(level + 10 * leak * np.maximum(strength, 0), (12, *SIZE))
        codes = np.round(100 + 1.5 * electrons + rng.normal(0, 3, electrons.shape))
        recordings.append(
            Recording(
                frames=codes.astype(np.uint16),
                kind=kind,
                cfa="MONO",
                black_level=100.0,
                white_level=4095.0,
                exposure_s=seconds,
            )  # fmt: skip
        )
    found = diagnose(CaptureSet("camera", tuple(recordings)), compare=False, key=jax.random.key(0))
    (step,) = [s for s in found.fitted.steps if s.named.signature.kin == "modulated"]
    assert step.named.signature.axes.scales == "exposure"
    assert found.model is not None
    frames = found.model.sample(
        jax.random.key(1), np.zeros(SIZE, np.float32), Settings(frames=40, exposure_s=4.0)
    )
    swelling = np.asarray(frames, np.float64)
    swelling = swelling - swelling.mean(0)
    rms = 10 * 1.5 * 0.4 * 4 / 3 * leak.std()
    shape = (leak - leak.mean()).ravel()
    drawn = swelling.reshape(40, -1) @ shape / np.sqrt(shape @ shape) / np.sqrt(shape.size)
    assert drawn.std() == pytest.approx(rms, rel=0.4)
