"""What a report says of a response that bends where the variance of flats does and their means do not."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from cannoise_jax.discovery.report.not_found import absorbed_by, asked_of_a_curve, still_differs

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


def differing(*lines):
    """A run that asked for one kind of effect, and what its draws still differ in."""
    after = SimpleNamespace(
        differences=[SimpleNamespace(what=w, time=t, sign=s, note=n) for w, t, s, n in lines]
    )
    return SimpleNamespace(remains=SimpleNamespace(after=after))


@pytest.mark.parametrize(
    ("axes", "line", "excluded"),
    [
        (("column", "frozen", "log-normal variance"), ("noise unlike from line to line", "columns"), False),
        (("row", "frozen", "log-normal variance"), ("noise unlike from line to line", "columns"), False),
        (("pixel", "frozen", "log-normal variance"), ("pixels noisier than the others", ""), False),
        (("pixel", "frozen", "white"), ("fixed pattern of single pixels", ""), False),
        (("pixel", "redrawn", "white"), ("fixed pattern of single pixels", ""), True),
        (("pixel", "frozen", "sparse"), ("hot pixels", ""), False),
        (("pixel", "frozen", "sparse", "signal"), ("hot pixels", ""), False),
        (("pixel", "redrawn", "sparse"), ("hot pixels", ""), True),
        (("row", "redrawn", "white"), ("rows", ""), False),
        (("row", "frozen", "white"), ("rows", ""), True),
    ],
)
def test_no_limit_stands_for_what_still_differs(axes, line, excluded):
    over, time, law, *scales = axes
    what, note = line
    run = differing((what, "frame to frame" if what == "rows" else "fixed", 1, note))
    own = SimpleNamespace(law=law, varies_over=over, time=time, scales=scales[0] if scales else "additive")
    signature = SimpleNamespace(name="looked", mechanism="asked", axes=own)
    run.first = SimpleNamespace(signatures=(signature,))
    run.fitted = SimpleNamespace(first=SimpleNamespace(scores={"looked": None}))
    assert still_differs(run, "asked") == ([] if excluded else [what])
    run.remains.after.differences[0].sign = -1
    assert still_differs(run, "asked") == []
    run.remains = None
    assert still_differs(run, "asked") == []
