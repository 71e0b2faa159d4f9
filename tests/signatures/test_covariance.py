"""What correlations of any kind gain, against likelihoods written out over the frequencies."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures import generic
from cannoise_jax.signatures.covariance import any_score
from tests.discovery.looks import RECORDED, SIGNATURES, white
from tests.discovery.test_own_mechanism import entry

SIZE = (64, 96)
_RNG = np.random.default_rng


def with_contrasts(make):
    """Fields of white noise of unit variance with contrasts made by a function of them."""
    fields = white(_RNG(3), kinds=("dark",), frames=12, size=SIZE)
    return tuple(f._replace(contrasts=(x := make(f.contrasts)) / x.std(), static=None) for f in fields)


def wave(x, amplitude, rng):
    rows, columns = np.indices(SIZE)
    phase = 2 * np.pi * rng.random((len(x), 1, 1))
    return x + amplitude * np.sqrt(2) * np.sin(2 * np.pi * (9 * columns / 96 + 5 * rows / 64) + phase)


def test_weak_correlations_gain_half_their_squared_z_values():
    fields = with_contrasts(lambda x: x + 0.04 * np.roll(x, 1, 2) + 0.05 * np.roll(x, 1, 1))
    score = any_score(fields, law="white")
    pairs = sum(f.contrasts.size for f in fields)
    squares = 0.5 * pairs * np.sum(np.square(score.where["correlations"]))
    assert score.gain == pytest.approx(squares, rel=0.1)


def test_pixels_without_neighbours_tell_of_none():
    rows, columns = np.indices(SIZE)
    alone = (rows % 9 == 0) & (columns % 9 == 0)
    fields = tuple(f._replace(usable=alone) for f in with_contrasts(lambda x: x))
    assert any_score(fields, law="white") is None


@pytest.mark.parametrize("amplitude", [0.3, 1.0])
def test_a_wave_gains_no_more_than_the_likelihood_of_its_own_spectrum(amplitude):
    """All of it lies in two coefficients of each contrast: nothing that spreads it can explain more."""
    fields = with_contrasts(lambda x: wave(x, amplitude, _RNG(4)))
    (field,) = fields
    power = np.mean(np.abs(np.fft.fft2(field.contrasts, norm="ortho")) ** 2, 0)
    own = np.zeros(SIZE, bool)
    own[5, 9] = own[-5, -9] = True
    expected = np.where(own, power[own].mean(), power[~own].mean())
    exact = 0.5 * len(field.contrasts) * np.sum(power * (1 - 1 / expected) - np.log(expected))
    assert 0 < any_score(fields, law="white").gain < exact


def herringbone(key, x, values, maps, context):
    """Diagonal interference with a phase of its own in every frame."""
    import jax
    import jax.numpy as jnp

    rows, columns = jnp.mgrid[: context.size[0], : context.size[1]]
    phase = 2 * jnp.pi * jax.random.uniform(key, (x.shape[0], 1, 1))
    at = 2 * jnp.pi * (9 * columns / 96 + 5 * rows / 64)
    return x + values["sigma_dn"] * jnp.sqrt(2.0) * jnp.sin(at + phase)


@pytest.mark.parametrize(
    "amplitude", [pytest.param(0.1, marks=pytest.mark.slow), 0.3, pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_a_mechanism_of_ones_own_explains_its_effect_better_than_no_name_does(amplitude):
    own = entry("herringbone", "Diagonal interference.", herringbone, over="pixel")
    (signature,) = generic.by_sampling(own.record, name="own", known={}, simulated=True)(RECORDED)
    fields = with_contrasts(lambda x: wave(x, amplitude, _RNG(5)))
    mine, anything = signature.score(fields), any_score(fields, law="white")
    assert mine.gain - mine.penalty > anything.gain - anything.penalty
    assert mine.parameters["sigma_dn"][0] == pytest.approx(
        3.0 * amplitude / np.sqrt(1 + amplitude**2), rel=0.15
    )


def ramp(key, x, values, maps, context):
    """The level falls along the rows, by another amount in every frame."""
    import jax
    import jax.numpy as jnp

    along = jnp.linspace(-(3**0.5), 3**0.5, context.size[0])[:, None]
    return x + values["sigma_dn"] * jax.random.normal(key, (x.shape[0], 1, 1)) * along


@pytest.mark.parametrize(
    "amplitude", [pytest.param(0.1, marks=pytest.mark.slow), 0.5, pytest.param(1.0, marks=pytest.mark.slow)]
)
def test_a_ramp_of_ones_own_is_no_noise_of_rows(amplitude):
    own = entry("ramp", "The level falls along the rows.", ramp)
    (signature,) = generic.by_sampling(own.record, name="own", known={}, simulated=True)(RECORDED)
    rng, along = _RNG(6), np.linspace(-(3**0.5), 3**0.5, SIZE[0])[:, None]
    fields = with_contrasts(lambda x: x + amplitude * rng.standard_normal((len(x), 1, 1)) * along)
    mine = signature.score(fields)
    for other in ("row_slope", "row_additive_temporal", "tile_32_redrawn"):
        score = SIGNATURES[other].score(fields)
        assert mine.gain - mine.penalty > score.gain - score.penalty, other


def test_correlated_read_noise_is_told_from_correlation_of_all_noise():
    """Half of the variance of a lit recording is read noise: the correlation shows there by half."""
    rng = _RNG(6)
    fields = []
    for f in white(rng, kinds=("dark", "dark", "flat"), frames=8, size=SIZE):
        share = 1.0 - f.shot
        read = rng.standard_normal(f.contrasts.shape)
        read = (read - 0.15 * np.roll(read, 1, 2)) / np.sqrt(1 + 0.15**2)
        x = np.sqrt(share) * read + np.sqrt(1 - share) * rng.standard_normal(f.contrasts.shape)
        fields.append(f._replace(contrasts=x.astype(np.float32)))
    own, every = (SIGNATURES[f"lags_{law}"].score(tuple(fields)) for law in ("read", "any"))
    assert own.evidence > every.evidence + 3
    assert own.parameters["correlation"][0] == pytest.approx(-0.15 / (1 + 0.15**2), abs=3 * own.error)
    left = SIGNATURES["lags_read"].absorb(tuple(fields), own)
    assert SIGNATURES["lags_any"].score(left).log_p > -7
