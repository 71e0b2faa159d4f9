"""Regions read by amplifiers of their own, against smooth patterns and patterns of columns."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.signatures.taps import LAYOUTS, Taps, tap_score
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.looks import white

QUARTERS = Taps(np.array([[0.3, -0.3], [-0.25, 0.25]]))
STRIPS = Taps(np.array([[0.3, -0.35, 0.25, -0.2]]))


def adds(image):
    return lambda rng: lambda dn, signal, kind, exposure: dn + image


@pytest.mark.parametrize("taps, axis", [(QUARTERS, "block"), (STRIPS, "column")])
def test_offsets_of_regions_are_found_with_their_strength(taps, axis):
    image = taps.image(SIZE)
    found = diagnose(capture_set(41, adds(image), kinds="df"), compare=False)
    assert found.findings == ["amplifier_mismatch"]
    score = found.fitted.steps[0].named.score
    assert score.where["axis"] == axis
    assert score.amplitude == pytest.approx(2 * image.std(), rel=0.2)
    assert abs(score.payload.image(SIZE) - image).max() < 0.15


@pytest.mark.parametrize("shape", ["fall", "wave", "noise of columns"])
def test_other_patterns_are_no_regions(shape):
    y, x = np.indices(SIZE) / max(SIZE)
    image = {
        "fall": 3 * np.exp(-4 * np.hypot(y, x)),
        "wave": np.cos(3 * x + 5 * y),
        "noise of columns": np.random.default_rng(1).standard_normal(SIZE[1]) * np.ones(SIZE),
    }[shape]
    found = diagnose(capture_set(42, adds(image), kinds="df"), compare=False)
    assert found.findings and "amplifier_mismatch" not in found.findings


def test_null_p_values_are_not_too_small():
    scores = [tap_score(white(np.random.default_rng(s))) for s in range(80)]
    p = np.exp([s.log_p for s in scores])
    assert p.min() > 1e-3


def test_a_region_is_as_large_as_the_others():
    for layout in LAYOUTS:
        image = Taps(np.arange(layout[0] * layout[1], dtype=float).reshape(layout)).image((48, 64))
        assert np.all(np.bincount(image.astype(int).ravel()) == 48 * 64 // (layout[0] * layout[1]))
