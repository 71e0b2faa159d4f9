"""Light that falls off, noise far below a code, and a black level near the rail are no findings."""

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.discovery.frames.contrasts import robust_mean
from cannoise_jax.discovery.frames.smooth import beyond, polynomials
from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.discovery.search.name import name
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.recordings.recording import CaptureSet, Recording
from cannoise_jax.signatures.codes import _above_the_law
from cannoise_jax.signatures.light import _blurred, _diagonal

SIZE, WHITE = (96, 128), 4095.0
ALLOWED = frozenset(entry.id for entry in ENTRIES)


def fall_off(corner: float) -> np.ndarray:
    """cos^4 of the field angle, `corner` in the corners."""
    y, x = ((np.arange(n) - (n - 1) / 2) / ((n - 1) / 2) for n in SIZE)
    square = (y[:, None] ** 2 + x[None, :] ** 2) / 2
    return 1 / (1 + (corner**-0.5 - 1) * square) ** 2


def camera(seed: int, *, read: float, gain: float, black: float, corner: float = 1.0) -> CaptureSet:
    """Darks of two exposures and flats of three levels of a plain monochrome camera."""
    rng = np.random.default_rng(seed)
    out = []
    for n, (kind, level) in enumerate((("dark", 0.0),) * 2 + tuple(("flat", v) for v in (0.1, 0.3, 0.6))):
        light = level * (WHITE - black) * fall_off(corner)
        electrons = rng.poisson(np.broadcast_to(light / gain, (8, *SIZE)))
        codes = np.round(black + gain * electrons + read * rng.standard_normal((8, *SIZE)))
        frames = np.clip(codes, 0, WHITE).astype(np.uint16)
        out.append(
            Recording(
                frames, "MONO", (black,) * 4, WHITE, kind=kind, exposure_s=0.1 * (n + 1), path=f"{n}_{kind}"
            )
        )
    return CaptureSet("plain", tuple(out))


def first_name(capture: CaptureSet) -> str | None:
    """What a search calls first, at the error rate of one per cent."""
    looking = splits_of(capture).looking
    found = name(locate(looking.fields, looking.signatures), looking.signatures, ALLOWED, float(np.log(0.01)))
    return None if found is None else found.mechanism


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_vignetting_is_light_and_not_sensitivity(seed):
    assert first_name(camera(seed, read=6.0, gain=0.6, black=64.0, corner=0.5)) is None


@pytest.mark.parametrize(
    "read", [pytest.param(0.2, marks=pytest.mark.slow), 0.3, pytest.param(0.45, marks=pytest.mark.slow)]
)
def test_noise_far_below_a_code_is_no_pattern(read):
    assert first_name(camera(3, read=read, gain=0.1, black=64.0)) is None


@pytest.mark.parametrize(
    "black", [2.0, pytest.param(3.0, marks=pytest.mark.slow), pytest.param(5.0, marks=pytest.mark.slow)]
)
def test_values_cut_off_at_zero_are_black_clipping_and_nothing_else(black):
    assert first_name(camera(4, read=black, gain=0.8, black=black)) == "black_clipping"


def test_polynomials_are_orthonormal():
    basis = polynomials(48, 16)
    np.testing.assert_allclose(basis.T @ basis, np.eye(17), atol=1e-12)


def test_white_noise_and_patterns_of_columns_are_not_followed():
    rng = np.random.default_rng(5)
    followed = 0
    for _ in range(100):
        followed += bool(np.any(beyond(rng.standard_normal((48, 64)))))
        followed += bool(np.any(beyond(rng.standard_normal((48, 64)) + rng.standard_normal(64))))
    assert followed <= 4  # of 200, where one in a thousand is asked for


def test_a_fall_off_is_followed_to_below_the_noise():
    rng = np.random.default_rng(6)
    light = 1000 * fall_off(0.45)
    y, x = (np.linspace(-1, 1, n) for n in SIZE)
    basis = np.stack([np.outer(y**i, x**j).ravel() for i in range(5) for j in range(5 - i)], 1)
    rest = (light.ravel() - basis @ np.linalg.lstsq(basis, light.ravel(), rcond=None)[0]).reshape(SIZE)
    noise = 0.5 * rng.standard_normal(SIZE)
    assert np.std(rest) > 0.5
    assert np.std(rest - beyond(rest + noise)) < 0.1


def test_only_a_rail_makes_the_lowest_code_too_frequent():
    edges = np.arange(-1, 8)
    for sigma, mean in ((1.0, 2.0), (2.0, 3.0), (3.0, 3.0)):
        share = np.diff(stats.norm.cdf((edges + 0.5 - mean) / sigma))
        counts = np.random.default_rng(7).poisson(1e5 * share[:5])
        assert _above_the_law(counts) > np.log(1e-3)
        piled = counts.copy()
        piled[0] += int(1e5 * stats.norm.cdf((-0.5 - mean) / sigma))
        if sigma > 1:
            assert _above_the_law(piled) < np.log(1e-6)


def test_a_dark_corner_far_from_the_fit_is_followed_not_set_aside():
    """Fall-off to a quarter about a point beside the middle: one corner is darker than all others."""
    rng = np.random.default_rng(3)
    y, x = np.indices((48, 64))
    away = np.hypot(y - 28, x - 27) / np.hypot(24, 32)
    light = 10_000 / (1 + away**2) ** 2
    basis = [(a**i) * (b**j) for a, b in [(y / 24 - 1, x / 32 - 1)] for i in range(5) for j in range(5 - i)]
    stack = np.stack([b.ravel() for b in basis], 1)
    noisy = light + 30 * rng.standard_normal(light.shape)
    rest = (noisy.ravel() - stack @ np.linalg.lstsq(stack, noisy.ravel(), rcond=None)[0]).reshape(light.shape)
    # As a robust fit leaves it, that set the corner aside.
    rest[:8, -8:] -= 200 * np.exp(-(y[:8, -8:] + (63 - x[:8, -8:])) / 4.0)
    rest[20, 20] += 5_000  # a hot pixel
    left = rest - beyond(rest)
    assert abs(np.mean(left[:4, -4:])) < 30 and abs(left[20, 20] - 5_000) < 150
    assert abs(np.median(left)) < 5


@pytest.mark.parametrize("black", [64.0, 63.85])
def test_the_level_of_a_dark_is_its_mean_where_most_values_are_one_code(black):
    codes = np.round(black + 0.3 * np.random.default_rng(4).standard_normal((4, 96, 128)))
    assert robust_mean(codes.mean(0)) == pytest.approx(codes.mean(), abs=2e-3)
    codes[:, 5, 7] = 900  # a hot pixel is none of it
    assert robust_mean(codes.mean(0)) == pytest.approx(
        np.delete(codes.mean(0).ravel(), 5 * 128 + 7).mean(), abs=2e-3
    )


def test_curved_light_is_no_difference_of_the_greens():
    """Both greens are compared at the same sites through blurs of equal second moments."""
    y, x = np.mgrid[0:24, 0:24].astype(float)
    light = 100 + 3 * x - 2 * y + 0.02 * (x - 9) ** 2 + 0.05 * (y - 7) ** 2 - 0.03 * x * y
    assert np.abs(_diagonal(light) - _blurred(light))[2:-2, 2:-2].max() < 1e-9
