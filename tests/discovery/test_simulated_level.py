"""What a simulator's own darks rise by is not found missing of it; what they lack is."""

import numpy as np
import pytest

from cannoise_jax.discovery.frames.splits import splits_of
from cannoise_jax.discovery.search.locate import locate
from cannoise_jax.recordings.recording import CaptureSet, Recording


def taken(seed, rate, rows=0.0, black=300.0):
    """Darks of three exposures and a flat; rate: dark current, e-/s; rows: of the readout, DN; black: level
    of the codes, DN, which the files state as 300."""
    rng = np.random.default_rng(seed)
    own = []
    for kind, light, seconds in (("dark", 0, 0.01), ("dark", 0, 2.0), ("dark", 0, 8.0), ("flat", 900, 0.01)):
        charge = rng.poisson(light + rate * seconds, (8, 64, 96)) + 4 * rng.standard_normal((8, 64, 96))
        codes = black + 2 * charge + rows * rng.standard_normal((8, 64, 1))
        own.append(
            Recording(
                np.maximum(np.rint(codes), 0).astype(np.uint16), "MONO", (300.0,) * 4, 16383.0, kind=kind,
                exposure_s=seconds, path=f"{kind}_{seconds:g}",
            )
        )  # fmt: skip
    return CaptureSet("made", tuple(own))


@pytest.mark.parametrize(
    ("drawn", "missing"), [pytest.param(0.5, 0.0, marks=pytest.mark.slow), (0.2, 0.3), (0.0, 0.5)]
)
def test_a_dark_current_counts_beyond_that_of_the_simulator(drawn, missing):
    looking = splits_of(taken(1, 0.5), True, taken(2, drawn)).looking
    score = locate(looking.fields, looking.signatures).scores["dark_level"]
    value, _, error = score.parameters["dark_current"]
    assert abs(value - missing) < 4 * error and error < 0.05
    assert (score.log_p < -20) == bool(missing)


@pytest.mark.parametrize("drawn", [0.3, 0.0])
def test_a_dark_current_is_told_beside_what_code_zero_cuts_off(drawn):
    """The darks lie a standard deviation above code 0, which lifts the shortest by more than the others."""
    looking = splits_of(taken(1, 0.3, black=8.0), True, taken(2, drawn, black=8.0)).looking
    score = locate(looking.fields, looking.signatures).scores["dark_level"]
    value, _, error = score.parameters["dark_current"]
    assert abs(value - (0.3 - drawn)) < 3 * error and error < 0.02


def test_rows_of_the_simulator_make_its_level_less_sure():
    errors = []
    for rows in (0.0, 8.0):
        looking = splits_of(taken(1, 0.5), True, taken(2, 0.5, rows)).looking
        score = locate(looking.fields, looking.signatures).scores["dark_level"]
        value, _, error = score.parameters["dark_current"]
        assert abs(value) < 4 * error
        errors.append(error)
    assert errors[1] > 2 * errors[0]


@pytest.mark.parametrize("level", [pytest.param(299.0, marks=pytest.mark.slow), 300.0, 301.5])
def test_a_black_level_counts_against_that_of_the_simulator(level):
    """Whatever the files state, and whatever dark current both have."""
    looking = splits_of(taken(1, 0.5), True, taken(2, 0.5, black=level)).looking
    score = locate(looking.fields, looking.signatures).scores["black_level"]
    value, _, error = score.parameters["black_level_error"]
    assert abs(value - (300.0 - level)) < 4 * error and error < 0.1
    assert (score.log_p < -20) == (level != 300.0)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_the_chance_mean_of_rows_that_a_simulator_draws_is_no_black_level(seed):
    """Its rows move the mean of a few frames as a whole."""
    drawn = taken(20 + seed, 0.5)
    rng = np.random.default_rng(seed)
    for r in drawn.recordings:
        drift = np.rint(4 * rng.standard_normal((len(r.frames), 1, 1)))
        r.frames[:] = (r.frames + drift).astype(np.uint16)
    looking = splits_of(taken(1, 0.5), True, drawn).looking
    score = locate(looking.fields, looking.signatures).scores["black_level"]
    assert score.log_p > -7
