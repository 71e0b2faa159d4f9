"""Regions read by amplifiers of their own, against smooth patterns and patterns of columns: what stays, and
what is new in every frame."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.frames import smooth
from cannoise_jax.signatures import moving_taps, tap_gain
from cannoise_jax.signatures.moving_taps import moving_absorb, moving_score
from cannoise_jax.signatures.taps import LAYOUTS, Taps, tap_score
from tests.discovery.capture import SIZE, capture_set
from tests.discovery.looks import white

QUARTERS = Taps(np.array([[0.3, -0.3], [-0.25, 0.25]]))
STRIPS = Taps(np.array([[0.3, -0.35, 0.25, -0.2]]))


def adds(image):
    return lambda rng: lambda dn, signal, kind, exposure: dn + image


@pytest.mark.parametrize(
    "taps, axis", [(QUARTERS, "block"), pytest.param(STRIPS, "column", marks=pytest.mark.slow)]
)
def test_offsets_of_regions_are_found_with_their_strength(taps, axis):
    image = taps.image(SIZE)
    found = diagnose(capture_set(41, adds(image), kinds="df"), compare=False)
    assert found.findings == ["amplifier_mismatch"]
    score = found.fitted.steps[0].named.score
    assert score.where["axis"] == axis
    assert score.amplitude == pytest.approx(2 * image.std(), rel=0.2)
    assert abs(score.payload.image(SIZE) - image).max() < 0.15


@pytest.mark.parametrize(
    "shape",
    [
        "fall",
        pytest.param("wave", marks=pytest.mark.slow),
        pytest.param("noise of columns", marks=pytest.mark.slow),
    ],
)
def test_other_patterns_are_no_regions(shape):
    y, x = np.indices(SIZE) / max(SIZE)
    image = {
        "fall": 3 * np.exp(-4 * np.hypot(y, x)),
        "wave": np.cos(3 * x + 5 * y),
        "noise of columns": np.random.default_rng(1).standard_normal(SIZE[1]) * np.ones(SIZE),
    }[shape]
    found = diagnose(capture_set(42, adds(image), kinds="df"), compare=False)
    # What is left of a wave that was taken out in tiles is at the level of chance, under whatever name.
    strong = [s.named.mechanism for s in found.fitted.steps if s.log_p < -10]
    assert strong and "amplifier_mismatch" not in strong


def test_null_p_values_are_not_too_small():
    scores = [tap_score(white(np.random.default_rng(s))) for s in range(80)]
    p = np.exp([s.log_p for s in scores])
    assert p.min() > 1e-3


def test_a_region_is_as_large_as_the_others():
    for layout in LAYOUTS:
        image = Taps(np.arange(layout[0] * layout[1], dtype=float).reshape(layout)).image((48, 64))
        assert np.all(np.bincount(image.astype(int).ravel()) == 48 * 64 // (layout[0] * layout[1]))


def anew(image):
    """Frames that each have a field of their own: image(rng)."""
    return lambda rng: lambda dn, signal, kind, exposure: dn + image(rng)


def taps(layout, sigma):
    def image(rng):
        return Taps(sigma * rng.standard_normal(layout)).image(SIZE)

    return image


@pytest.mark.parametrize(
    "layout",
    [
        pytest.param((1, 4), marks=pytest.mark.slow),
        (2, 2),
        pytest.param((1, 3), marks=pytest.mark.slow),
        pytest.param((2, 1), marks=pytest.mark.slow),
    ],
)
def test_regions_that_move_from_frame_to_frame_are_found_with_their_strength_and_layout(layout):
    found = diagnose(capture_set(45, anew(taps(layout, 0.5)), kinds="df"), compare=False)
    assert found.findings == ["amplifier_drift"]
    score = found.fitted.steps[0].named.score
    assert score.payload.layout == layout
    assert score.amplitude == pytest.approx(0.5, rel=0.35)
    drawn = [m.record.point.blocks for m in found.model.mechanisms if m.record.id == "amplifier_drift"]
    assert drawn == [layout]


def tear(rng):
    out = np.zeros(SIZE)
    out[rng.integers(10, SIZE[0] - 10) :] = 1.5 * rng.choice([-1, 1])
    return out


def clouds(rng):
    out = ndimage.gaussian_filter(rng.standard_normal(SIZE), 12, mode="wrap")
    return 0.8 * out / out.std()


def fall(rng):
    return 0.7 * rng.standard_normal() * np.linspace(-1, 1, SIZE[1]) * np.ones(SIZE)


def tiles(rng):
    return np.kron(0.5 * rng.standard_normal((SIZE[0] // 16, SIZE[1] // 16)), np.ones((16, 16)))


@pytest.mark.parametrize(
    "image",
    [
        pytest.param(tear, marks=pytest.mark.slow),
        pytest.param(clouds, marks=pytest.mark.slow),
        pytest.param(fall, marks=pytest.mark.slow),
        tiles,
    ],
)
def test_other_fields_that_move_are_no_regions(image):
    found = diagnose(capture_set(45, anew(image), kinds="df"), compare=False)
    assert found.findings and "amplifier_drift" not in found.findings


def test_null_p_values_of_moving_regions_are_not_too_small():
    p = np.exp([moving_score(white(np.random.default_rng(s))).log_p for s in range(80)])
    assert p.min() > 1e-3


def test_moving_regions_taken_out_leave_nothing_of_them():
    fields = white(np.random.default_rng(5))
    image = Taps(np.array([[1.0, -1.0, 0.5, -0.5]])).image(fields[0].mean.shape)
    signs = np.random.default_rng(6).standard_normal
    moved = tuple(
        f._replace(contrasts=(f.contrasts + signs((len(f.contrasts), 1, 1)) * image).astype(np.float32))
        for f in fields
    )
    score = moving_score(moved)
    assert score.log_p < -20 and score.payload.layout == (1, 4)
    left = moving_score(moving_absorb(moved, score), layout=(1, 4))
    assert left.gain < 4


@pytest.mark.parametrize("layout", moving_taps.LAYOUTS)
def test_cells_make_up_every_layout(layout):
    cells, regions = (moving_taps.cell_groups((96, 144), k).of.ravel() for k in (moving_taps.CELLS, layout))
    assert all(np.ptp(regions[cells == n]) == 0 for n in range(cells.max() + 1))


def test_gains_are_told_beside_all_that_a_flat_may_lose_to_its_surface():
    assert tap_gain.DEGREE == smooth.STOP


def lit(gain, *, prnu=0.0, columns=0.0):
    """Flats under a lens that falls off, of pixels and columns of gains of their own."""
    y, x = (np.arange(n) for n in SIZE)
    light = 1 - 0.25 * ((x[None] - 60) ** 2 + (y[:, None] - 40) ** 2) / 9000

    def alter(rng):
        response = 1 + prnu * rng.standard_normal(SIZE) + columns * rng.standard_normal((1, SIZE[1]))
        field = (1 + gain) * response * light
        return lambda dn, signal, kind, t: dn if kind == "dark" else 200 + (dn - 200) * field

    return alter


STEPS = [
    [[0.0, 0.006, -0.004, 0.008]],
    [[0.004, -0.004], [0.0, 0.006]],
    [[0.004, -0.004]],
    [[0.004], [-0.004]],
]


@pytest.mark.parametrize("levels", [STEPS[0], *(pytest.param(s, marks=pytest.mark.slow) for s in STEPS[1:])])
def test_gains_of_regions_are_found_beside_prnu_and_a_lens(levels):
    truth = Taps(np.array(levels) - np.mean(levels))
    made = capture_set(81, lit(truth.image(SIZE), prnu=0.004), kinds="df", frames=6)
    found = diagnose(made, compare=False)
    assert sorted(found.findings) == ["amplifier_gain", "prnu"]
    score = next(s.named.score for s in found.fitted.steps if s.named.mechanism == "amplifier_gain")
    assert score.payload.levels.shape == truth.levels.shape
    assert np.abs(score.payload.levels - truth.levels).max() < 0.0015


Y, X = np.indices(SIZE)
SPOTS = -0.02 * np.exp(-((X - 30) ** 2 + (Y - 50) ** 2) / 60) - 0.015 * np.exp(
    -((X - 90) ** 2 + (Y - 20) ** 2) / 40
)


@pytest.mark.parametrize(
    "gain, columns",
    [
        pytest.param(0.0, 0.0, marks=pytest.mark.slow),
        (0.0, 0.004),
        pytest.param(SPOTS, 0.0, marks=pytest.mark.slow),
        pytest.param(0.004 * np.sin(X / 5 + Y / 17), 0.0, marks=pytest.mark.slow),
        pytest.param(0.006 * (X > 77), 0.0, marks=pytest.mark.slow),
    ],
    ids=["even", "columns", "dust", "fringes", "a step elsewhere"],
)
def test_other_responses_are_no_gains_of_regions(gain, columns):
    made = capture_set(82, lit(gain, prnu=0.004, columns=columns), kinds="df", frames=6)
    assert "amplifier_gain" not in diagnose(made, compare=False).findings
