"""What a report says of a response that bends where the variance of flats does and their means do not."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cannoise_jax.discovery.report.not_found import absorbed_by, asked_of_a_curve

CURVE, BENDS = "variance_curve", "bends"


def run(mechanism="unknown", law="variance curve", over="signal", scores=(CURVE, BENDS)):
    """A run that found one thing, and asked for a mechanism that it counts for."""

    def signature(name, own, law, over, lifted_by=()):
        axes = SimpleNamespace(law=law, varies_over=over)
        return SimpleNamespace(
            name=name, mechanism=own, axes=axes, lifted_by=lifted_by, covers=(), hides=lambda score: ()
        )

    curve = signature(CURVE, None, law, "signal")
    bends = signature(BENDS, "bent", "curve", over, (CURVE,))
    step = SimpleNamespace(named=SimpleNamespace(signature=curve, mechanism=mechanism, score=None))
    first = SimpleNamespace(scores=dict.fromkeys(scores), log_p={})
    fitted = SimpleNamespace(first=first, steps=(step,))
    return SimpleNamespace(fitted=fitted, first=SimpleNamespace(signatures=(curve, bends)), alpha=0.01)


def test_no_limit_stands_for_a_bend_that_the_means_did_not_bear_out():
    assert [s.name for s in asked_of_a_curve(run())] == [BENDS]
    assert absorbed_by(run(), "bent") == ["unknown"]


@pytest.mark.parametrize(
    "found",
    [
        {"mechanism": "another"},  # has a name, which is why the variance bends
        {"law": "white"},  # is no curve
        {"over": "pixel"},  # sees more than the curve, and was not found in that
        {"scores": (CURVE,)},  # was not asked: too few exposures
    ],
)
def test_limits_stand_where_no_curve_without_a_name_was_held_against_means(found):
    assert asked_of_a_curve(run(**found)) == () and absorbed_by(run(**found), "bent") == []
