"""The second engine against the equations: moments without an effect, and each effect at its amplitude."""

from dataclasses import replace

import numpy as np
import pytest

from cannoise_jax.blind.chain import Camera, Shot
from cannoise_jax.blind.effects import effect
from cannoise_jax.blind.peer import ADDED, OPTIONS, expose

pytest.importorskip("getframes", reason="getframes is not installed: pip install 'cannoise-jax[blind]'")
SIZE = (96, 128)
CAMERA = Camera(
    gain=2.0,
    read_e=3.0,
    black=(400.0,) * 4,
    white=16380.0,
    step=4.0,
    cfa="RGGB",
    iso=100.0,
    unit=5,
    longest_exposure_s=8.0,
)
FLAT = Shot("flat", "flat", np.full(SIZE, 0.25), 24, 0.01)
DARK = Shot("dark", "dark", np.zeros(SIZE), 24, 8.0)


def record(shot, *effects, seed=0):
    frames = expose(CAMERA, shot, tuple(effects), np.random.default_rng(seed))
    assert frames.dtype == np.uint16 and frames.shape == (shot.frames, *SIZE)
    assert np.all(frames % 4 == 0)
    return frames.astype(np.float64)


def test_mean_and_variance_follow_the_camera():
    electrons = CAMERA.electrons(np.full(1, 0.25))[0]
    for shot, mean, photons in ((FLAT, 400 + 2 * electrons, electrons), (DARK, 400, 0)):
        frames = record(shot)
        variance = 4 * (photons + 9) + 16 / 12
        pixels = frames.size
        assert abs(frames.mean() - mean) < 5 * np.sqrt(variance / pixels)
        assert frames.var(0, ddof=1).mean() == pytest.approx(variance, rel=5 * np.sqrt(2 / pixels))


def test_effects_have_the_amplitude_that_is_asked_for():
    signal = FLAT.clean * (CAMERA.white - 400)
    still = record(FLAT).mean(0) - 400
    noise = (2 * (signal.mean() / 2 + 9) * 2 / FLAT.frames) ** 0.5
    spread = record(FLAT, effect("prnu", 0.02)).mean(0).std()
    assert spread == pytest.approx(np.hypot(0.02 * signal.mean(), noise), rel=0.03)
    assert record(DARK, effect("dsnu", 10.0)).mean(0).std() == pytest.approx(10, rel=0.03)
    rows = record(DARK, effect("row_noise", 5.0)).mean(2)
    assert rows.std() == pytest.approx(5, rel=0.05)
    halves = record(DARK, effect("amplifier_mismatch", 6.0)).mean((0, 1))
    assert halves[64:].mean() - halves[:64].mean() == pytest.approx(6, abs=0.3)
    assert record(DARK, effect("dark_current", 2.0)).mean() - 400 == pytest.approx(2 * 2 * 8, abs=0.3)
    bent = record(FLAT, effect("nonlinearity", 0.1)).mean() - 400
    assert bent / still.mean() == pytest.approx(1 - 0.1 * 0.25, abs=1e-3)
    greens = record(FLAT, effect("green_imbalance", 0.05)).mean(0)
    assert greens[0::2, 1::2].mean() / greens[1::2, 0::2].mean() == pytest.approx(
        (400 + 1.05 * signal.mean()) / (400 + 0.95 * signal.mean()), rel=2e-3
    )
    residual = record(FLAT, effect("crosstalk", 0.04))
    residual = residual - residual.mean(0)
    touching = np.mean(residual[:, :, 1:] * residual[:, :, :-1]) / residual.var()
    assert touching == pytest.approx(0.02 * 0.99, abs=0.004)
    widths = record(replace(DARK, frames=40), effect("pixel_read_noise_map", 0.5)).std(0)
    assert widths.std() / widths.mean() == pytest.approx(np.hypot(0.47, np.sqrt(0.5 / 39)), abs=0.06)


def test_patterns_belong_to_the_unit_and_every_effect_is_covered():
    first, second = (record(DARK, effect("dsnu", 10.0), seed=s).mean(0).ravel() for s in (1, 2))
    assert np.corrcoef(first, second)[0, 1] > 0.95
    for name in (*OPTIONS, *ADDED):
        assert np.any(record(FLAT if name != "dark_current" else DARK, effect(name, 0.3)) != record(FLAT)), (
            name
        )
