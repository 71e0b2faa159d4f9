"""Tails that lie on both sides keep their name; those on one side have none."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.proof.one_sided import one_sided
from tests.discovery.test_shared_noise import alone, step_of, student, tukey


def exponential(share):
    """Normal noise and, of the rest of its variance, an exponential that is above or, below 0, below."""

    def law(rng, size):
        lean = np.sign(share) * (rng.standard_exponential(size) - 1)
        return abs(share) * lean + np.sqrt(1 - share**2) * rng.standard_normal(size)

    return law


def events(both):
    """Normal noise and rare events, above or on both sides."""

    def law(rng, size):
        height = rng.uniform(3, 6, size) * (rng.random(size) < 0.01)
        return rng.standard_normal(size) + height * np.where(rng.random(size) < 0.5 * both, -1, 1)

    return law


def telegraph(rng):
    """Tails of every pixel, and a few pixels that are high now and then."""
    high = 60 * (rng.random((96, 128)) < 0.01)
    return lambda dn, *_: (
        dn + 12 * rng.standard_t(6, dn.shape) / np.sqrt(1.5) + high * (rng.random(dn.shape) < 0.2)
    )


@pytest.mark.parametrize(
    "alter", [alone(tukey(-0.1)), alone(tukey(0.05)), alone(student(5)), alone(events(True)), telegraph]
)
def test_tails_on_both_sides_stay(alter):
    assert one_sided((step_of(alter),), 0) is None


@pytest.mark.parametrize(
    ("law", "side"),
    [(exponential(0.75), "above"), (exponential(0.5), "above"), (exponential(-0.6), "below"),
     (events(False), "above")],
)  # fmt: skip
def test_tails_on_one_side_are_told(law, side):
    said = one_sided((step_of(alone(law)),), 0)
    assert said is not None and side in said.against[0] and said.left > 0.5
