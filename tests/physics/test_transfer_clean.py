"""Sets without any mechanism beyond Poisson-Gaussian give models without any."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.transfer.estimate import normal_estimate, root, variance_difference
from cannoise_jax.physics.transfer.estimators.charge import log_estimate
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.model import find_mechanisms
from cannoise_jax.physics.transfer.photon_transfer import transfer_at
from cannoise_jax.recordings.recording import Recording, per_channel
from tests.conftest import SIMULATION


def shot(rng, kind, light, seconds=0.01, frames=8, gain=2.0, read=3.0):
    size = (frames, 64, 96)
    charge = rng.poisson(light, size) + rng.normal(0, read, size)
    codes = np.clip(np.rint(200 + gain * charge), 0, 16383).astype(np.uint16)
    return Recording(codes, "RGGB", per_channel(200.0), 16383.0, kind=kind, exposure_s=seconds)


KINDS = {
    "dark and flat": lambda r: [shot(r, "dark", 0.0), shot(r, "flat", 2000.0)],
    "ladder": lambda r: [
        shot(r, "dark", 0.0, frames=16),
        *(shot(r, "flat", 2000.0 * k, 0.01 * k, frames=16) for k in (1, 2, 3)),
    ],
    "darks over exposure": lambda r: [
        *(shot(r, "dark", 0.0, t) for t in (0.01, 1.0, 10.0)),
        shot(r, "flat", 2000.0),
    ],
    "four frames of a low gain": lambda r: [
        shot(r, "dark", 0.0, frames=4, gain=0.5, read=2.0),
        shot(r, "flat", 3000.0, frames=4, gain=0.5, read=2.0),
    ],
}


def entries(kind, seed):
    """Mechanisms in the model of one clean set; warnings of NumPy are errors."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        return _entries(kind, seed)


def _entries(kind, seed):
    statistics = [frame_statistics(r) for r in KINDS[kind](np.random.default_rng([seed, len(kind)]))]
    findings = find_mechanisms(statistics, transfer_at(statistics).baseline, LISTED)
    return [f.mechanism for f in findings if f.verdict == "in the model"]


def test_nothing_enters_that_is_not_there():
    # At four in a hundred, which the long run allows, two of four sets have one by chance once in a hundred
    # times.
    found = {kind: entries(kind, 0) for kind in KINDS}
    assert sum(map(bool, found.values())) <= 1, found


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_hardly_ever_does_anything_enter_that_is_not_there(kind, tables):
    found = [entries(kind, seed) for seed in range(100)]
    named = ", ".join(sorted({id for ids in found for id in ids})) or "none"
    row = (kind, f"{sum(map(bool, found))} of {len(found)}", named)
    tables.add("false_mechanisms", ("simulated clean sets", "with a mechanism", "which"), [row], SIMULATION)
    assert sum(map(bool, found)) <= 4, found


def test_the_interval_of_a_value_whose_logarithm_is_not_known_reaches_from_zero_to_its_own_errors():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        e = log_estimate(3.0, 1e4)
    assert e.ci90 == pytest.approx((0.0, 3 + 1.6449 * 3e4)) and not e.significant
    known = log_estimate(3.0, 0.1)
    assert known.ci90 == pytest.approx((3 * np.exp(-0.16449), 3 * np.exp(0.16449)))


def test_chance_of_a_root_is_that_of_its_variance():
    rng = np.random.default_rng(3)
    chances = np.array([
        root(variance_difference(rng.chisquare(60) / 60, 60, rng.chisquare(900) / 900, 900)).by_chance
        for _ in range(4000)
    ])  # fmt: skip
    for level in (0.3, 0.05, 0.01):
        assert np.mean(chances < level) == pytest.approx(level, abs=4 * np.sqrt(level / 4000))
    assert root(normal_estimate(-1.0, 0.1)).by_chance == 1.0
    assert normal_estimate(3.0, 1.0).by_chance == pytest.approx(0.0027, rel=0.01)
