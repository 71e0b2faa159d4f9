"""Dust in a flat counts as its light; what a sensor does of itself does not."""

import dataclasses

import jax
import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.compare.families import STATIC
from cannoise_jax.discovery.compare.run import compare_bank
from cannoise_jax.discovery.compare.sources import modelled, shaded
from cannoise_jax.discovery.compare.table import differences
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames.contrasts import Stack, stack
from cannoise_jax.discovery.frames.dust import beside_dust
from cannoise_jax.discovery.frames.shadows import light_at, places, shadows
from cannoise_jax.discovery.frames.smooth import light_of, shades, smooth_mean
from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.report.light import sentence_of
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.recordings.recording import CaptureSet, Recording

SIZE = (192, 256)
Y, X = np.indices(SIZE)


def disc(y: float, x: float, radius: float, depth: float) -> np.ndarray:
    return -depth * np.clip(radius + 1 - np.hypot(Y - y, X - x), 0, 2) / 2


def donut(y: float, x: float, radius: float, depth: float) -> np.ndarray:
    away = np.abs(np.hypot(Y - y, X - x) - radius)
    return -depth * np.clip(1.5 - away / (0.2 * radius + 1), 0, 1)


def dust() -> np.ndarray:
    return (
        disc(40, 50, 6, 0.04) + disc(150, 220, 11, 0.08) + donut(100, 130, 20, 0.06) + donut(30, 200, 9, 0.05)
    )


def seen(relative: np.ndarray) -> np.ndarray:
    return light_at(relative, places(shadows(relative, np.ones(SIZE))))


@pytest.mark.parametrize("seed", range(3))
def test_dust_is_taken_and_the_pixels_are_left(seed):
    white = np.random.default_rng(seed).normal(0, 0.006, SIZE)
    found = seen(dust() + white)
    assert np.std(dust() - found) < 0.25 * np.std(dust())
    assert np.std(dust() + white - found) == pytest.approx(0.006, rel=0.06)


def unit(values: np.ndarray) -> np.ndarray:
    return values / np.std(values)


PATTERNS = {
    "pixels": lambda rng: rng.normal(size=SIZE),
    "pixels of a long tail": lambda rng: unit(np.exp(rng.normal(size=SIZE))),
    "few far pixels": lambda rng: unit((rng.random(SIZE) < 0.005) * 1.0),
    "few far pixels and their neighbours": lambda rng: unit(
        ndimage.convolve((rng.random(SIZE) < 0.002) * 1.0, np.array([[0, 1, 0], [1, 20, 1], [0, 1, 0]]) / 20)
    ),
    "rows": lambda rng: rng.normal(size=(SIZE[0], 1)) * np.ones(SIZE),
    "columns of halves": lambda rng: np.where(Y < 96, *rng.normal(size=(2, 1, SIZE[1]))),
    "a bad column": lambda rng: unit((X == 77) * 1.0),
    "half a bad column": lambda rng: unit(((X == 77) & (Y > 90)) * 1.0),
    "a texture": lambda rng: unit(ndimage.gaussian_filter(rng.normal(size=SIZE), 2)),
    "waves": lambda rng: unit(np.sin(X / 5 + Y / 11 + 1)),
    "amplifiers": lambda rng: unit(np.where(X < 128, -1.0, 1.0)),
}


@pytest.mark.parametrize("what", PATTERNS)
def test_patterns_of_the_whole_sensor_are_no_dust(what):
    rng = np.random.default_rng(5)
    pattern = 0.006 * PATTERNS[what](rng)
    white = rng.normal(0, 0.003, SIZE)
    found = seen(pattern + white)
    assert np.std(found) < 0.06 * np.std(pattern + white)


def test_of_a_mosaic_the_colour_with_less_noise_counts_more():
    rng = np.random.default_rng(1)
    sigma = np.tile([[0.03, 0.005], [0.005, 0.03]], (SIZE[0] // 2, SIZE[1] // 2))
    relative = dust() + sigma * rng.normal(size=SIZE)
    weighed, plain = shadows(relative, sigma**-2.0), shadows(relative, np.ones(SIZE))
    assert np.std(dust() - weighed) < 0.7 * np.std(dust() - plain)


@pytest.mark.parametrize("seed", range(2))
def test_what_is_left_at_a_shadow_is_of_both_signs(seed):
    white = np.random.default_rng(seed).normal(0, 0.006, SIZE)
    left = dust() + white - seen(dust() + white)
    for size in (4, 8, 16):
        blocks = left.reshape(SIZE[0] // size, size, SIZE[1] // size, size).mean((1, 3))
        assert np.std(blocks) < 1.25 * 0.006 / size


def recordings(
    transmission: np.ndarray, levels: tuple[float, ...] = (0.0, 4000.0, 12000.0), seed: int = 3
) -> CaptureSet:
    """A dark and flats of a plain camera with 0.5 % PRNU behind a dusty window."""
    rng = np.random.default_rng(seed)
    prnu = 1 + rng.normal(0, 0.005, SIZE)
    out = []
    for n, level in enumerate(levels):
        electrons = rng.poisson(np.broadcast_to(level * transmission * prnu, (8, *SIZE)))
        codes = np.rint(200 + 2.0 * (electrons + rng.normal(0, 3, electrons.shape)))
        kind = "flat" if level else "dark"
        frames = np.clip(codes, 0, 65535).astype(np.uint16)
        out.append(
            Recording(frames, "MONO", (200.0,) * 4, 65535.0, kind=kind, exposure_s=0.01, path=f"{n}_{kind}")
        )
    return CaptureSet("dusty", tuple(out))


def stacks(capture: CaptureSet) -> tuple[Stack, ...]:
    return beside_dust([stack(r, n, list(range(8)), 1.0) for n, r in enumerate(capture.recordings)])


def test_the_mean_of_a_flat_has_the_dust_at_its_light():
    flat = stacks(recordings(1 + dust()))[2]
    mean = (smooth_mean(flat) - 200) / 24000
    assert np.std(mean - 1 - dust()) < 0.3 * np.std(dust())


def test_dust_that_a_bright_flat_shows_is_in_the_light_of_a_dim_one():
    weak = 1 + 0.1 * dust()
    dark, dim, _ = stacks(recordings(weak, (0.0, 200.0, 12000.0)))
    assert dark.dust is None and dim.dust is not None
    assert beside_dust([dim._replace(dust=None, light=None)])[0].dust is None
    surface, shadow = light_of(dim)
    assert np.mean(surface[dim.dust]) == pytest.approx(600, rel=0.01)
    # Of 200 electrons in 8 frames the smoothed light has a scatter that of the shadows is a part.
    assert np.sum(shadow * (weak - 1)) / np.sum((weak - 1) ** 2) == pytest.approx(1, abs=0.25)


def test_a_wide_deep_shadow_does_not_bend_the_surface_beside_it():
    deep = 1 + disc(90, 130, 28, 0.15) + disc(60, 60, 14, 0.1)
    flat = stacks(recordings(deep))[2]
    surface, _ = light_of(flat)
    assert np.std((surface - 200) / 24000 - 1) < 0.002
    assert np.mean(flat.dust) < 2 * np.mean(deep < 0.99)


def of_lens(seed: int) -> np.ndarray:
    """Light that falls off from a place beside the middle, to a quarter in a corner."""
    rng = np.random.default_rng(seed)
    y, x = Y - SIZE[0] * rng.uniform(0.3, 0.7), X - SIZE[1] * rng.uniform(0.3, 0.7)
    return 1 / (1 + (y / 180) ** 2 + (x / 200) ** 2) ** 2


def test_smooth_light_that_a_lens_makes_is_no_dust():
    """Dim corners scatter more, and so do means at the edges: taken for as good as the middle of the frame,
    most such flats had spots, and some as many as are said."""
    where = [s.dust for seed in range(6) for s in stacks(recordings(of_lens(seed), seed=seed))[1:]]
    pixels = [0 if w is None else int(w.sum()) for w in where]
    assert np.mean(np.array(pixels) > 0) < 0.4 and max(pixels) < 200


def test_dust_in_the_dim_corner_of_a_lens_is_told():
    lens, spot = of_lens(1), disc(24, 226, 8, 0.06)
    flat = stacks(recordings(lens * (1 + spot)))[2]
    assert flat.dust is not None and np.mean(flat.dust[spot < -0.05]) > 0.95 and np.mean(flat.dust) < 0.03
    _, shadow = light_of(flat)
    assert np.sum(shadow * spot) / np.sum(spot**2) == pytest.approx(1, abs=0.1)


@pytest.mark.slow
def test_shadows_in_the_light_are_no_mismatch_of_the_simulator():
    """The layer draws flats under the light that they had, shadows in it."""
    capture = recordings(1 + dust())
    camera = SensorModel.poisson_gaussian(2.0, 3.0, 200, 65535, "MONO").with_mechanism("prnu", sigma=0.005)
    right = modelled(camera, jax.random.key(1))
    found = differences(compare_bank(capture, right, alpha=0.01))
    assert any(d.time == STATIC for d in found)
    light = shades(stacks(capture))
    assert sorted(light) == [1, 2] and max(light[1].min(), light[2].min()) < -0.03
    left = differences(compare_bank(capture, shaded(right, light), alpha=0.01))
    assert sum(d.nats for d in left if d.time == STATIC) < 0.02 * sum(d.nats for d in found)


@pytest.mark.slow
def test_a_report_says_that_there_is_dust_and_measures_the_pixels():
    found = diagnose(recordings(1 + dust()))
    report = document(found, key=0, version="1")
    assert [f["file"] for f in report["shadows"]] == ["1_flat", "2_flat"]
    words = sentence_of(report["shadows"])
    assert words.startswith("2 of the flats hold spots or rings") and "darker" in words
    assert [f["mechanism"] for f in report["findings"]] == ["prnu"]
    assert report["findings"][0]["amplitude"]["value"] == pytest.approx(0.005, rel=0.1)
    clean = dataclasses.replace(found, capture=recordings(np.ones(SIZE)))
    assert clean.verdict
