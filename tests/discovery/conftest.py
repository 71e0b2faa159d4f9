"""Shared by the tests of discovery: fewer draws."""

from __future__ import annotations

import pytest

from cannoise_jax.discovery.proof import quality


@pytest.fixture(scope="package", autouse=True)
def a_quarter_of_the_draws():
    """The composite score learns from fewer draws: compiled without optimisation, these take most of the
    time, and no test here asks it for the last thousandth of a nat."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quality, "_LEARNED", 100_000)
        yield
