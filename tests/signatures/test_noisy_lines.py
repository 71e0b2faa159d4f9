"""row_spread and column_spread: rows or columns that have a read noise of their own each."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from cannoise_jax.signatures.fields import helmert, refit
from tests.discovery.looks import SIGNATURES, white

SIZE, FRAMES = (64, 96), 6
AXES = ("row", "column")


def darks(seed: int, noise, kinds=("dark", "dark")):
    """Fields whose frames are `noise(rng, unit)` in units of the noise, [t, h, w]. unit: what stays is drawn
    from it, the same in each recording."""
    rng, matrix = np.random.default_rng(seed), helmert(FRAMES)
    fields = white(rng, kinds=kinds, frames=FRAMES, size=SIZE)
    return refit(
        tuple(
            f._replace(
                contrasts=np.einsum(
                    "nt,tij->nij", matrix, noise(rng, np.random.default_rng([seed, 9]))
                ).astype(np.float32)
            )
            for f in fields
        )
    )


def normal(rng):
    return rng.standard_normal((FRAMES, *SIZE))


def factors(axis: str, spread: float):
    """Log-normal, of unit mean square."""
    shape = (SIZE[0], 1) if axis == "row" else (1, SIZE[1])
    width = np.sqrt(np.log1p(spread**2))
    return np.exp(width * np.random.default_rng(5).standard_normal(shape) - width**2)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("spread", [0.08, 0.3])
def test_lines_of_unlike_noise_are_found_with_their_strength_and_taken_out(axis, spread):
    signature, factor = SIGNATURES[f"{axis}_spread"], factors(axis, spread)
    fields = darks(1, lambda rng, unit: factor * normal(rng))
    score = signature.score(fields)
    assert score.log_p < -15
    assert score.amplitude == pytest.approx(factor.std() / factor.mean(), abs=3 * score.error)
    left = signature.score(refit(signature.absorb(fields, score), fields))
    assert left.log_p > np.log(1e-3)
    (other,) = (SIGNATURES[f"{a}_spread"] for a in AXES if a != axis)
    assert other.score(fields).log_p > np.log(1e-3)
    drawn = signature.pattern(fields, score, np.random.default_rng(0))
    assert drawn.shape == factor.shape
    assert np.corrcoef(drawn.ravel(), factor.ravel())[0, 1] > (0.9 if spread > 0.1 else 0.7)


def hot_and_blinking(rng, unit):
    """A few pixels far louder than the others, the same in each recording."""
    loud = unit.random(SIZE) < 0.01
    return normal(rng) * np.where(loud, 8.0, 1.0)


def own_noise_of_pixels(rng, unit):
    return normal(rng) * np.exp(0.5 * unit.standard_normal(SIZE))


def louder_sites(rng, unit):
    """The baseline has a noise of every mosaic site."""
    return normal(rng) * np.tile([[1.0, 1.3], [1.2, 0.9]], (SIZE[0] // 2, SIZE[1] // 2))


def noise_of_whole_lines(rng, unit):
    return (
        normal(rng)
        + 2 * rng.standard_normal((FRAMES, SIZE[0], 1))
        + rng.standard_normal((FRAMES, 1, SIZE[1]))
    )


def smooth_charge(rng, unit):
    """Noise that grows to one corner, as that of a glow."""
    y, x = np.indices(SIZE) / np.reshape(SIZE, (2, 1, 1))
    return normal(rng) * np.sqrt(1 + 0.5 * np.exp(-3 * np.hypot(x, y)))


def rows_of_single_frames(rng, unit):
    """Rows are louder now and then, others in each frame."""
    return normal(rng) * np.where(rng.random((FRAMES, SIZE[0], 1)) < 0.1, 2.0, 1.0)


NONE = (hot_and_blinking, own_noise_of_pixels, louder_sites, noise_of_whole_lines, smooth_charge)


@pytest.mark.parametrize("noise", NONE)
def test_p_is_uniform_where_no_line_has_a_noise_of_its_own(noise):
    p = [
        np.exp(SIGNATURES[f"{axis}_spread"].score(darks(seed, noise)).log_p)
        for axis in AXES
        for seed in range(30)
    ]
    assert stats.binomtest(int(np.sum(np.array(p) < 0.05)), len(p), 0.05, alternative="greater").pvalue > 1e-3
    assert min(p) > 1e-4


def test_rows_that_are_louder_in_some_frames_only_are_no_noise_that_stays():
    scores = [SIGNATURES["row_spread"].score(darks(seed, rows_of_single_frames)) for seed in range(20)]
    assert min(s.log_p for s in scores) > np.log(1e-4)


def test_it_is_of_the_read_noise_alone():
    """Of a noise half of which is shot noise, lines that are louder by so much differ by twice as much."""
    factor = factors("column", 0.1)
    fields = darks(2, lambda rng, unit: factor * normal(rng))
    half = tuple(f._replace(shot=np.full(SIZE, 0.5, np.float32)) for f in fields)
    whole, part = (SIGNATURES["column_spread"].score(f).amplitude for f in (fields, half))
    assert part == pytest.approx(2 * whole, rel=0.1)


def test_too_few_lines_or_frames_tell_nothing():
    fields = darks(3, lambda rng, unit: normal(rng))
    crop = tuple(f._replace(**{n: getattr(f, n)[..., :12, :] for n in CROPPED}) for f in fields)
    assert SIGNATURES["row_spread"].score(crop) is None
    assert SIGNATURES["row_spread"].score(tuple(f._replace(kind="flat") for f in fields)) is None


CROPPED = ("mean", "signal", "sigma", "shot", "usable", "contrasts", "static")
