"""Shadows of dust are named, and are no spread of sensitivities."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.transfer.defects import shadows_line
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, transfer_at
from cannoise_jax.recordings.recording import Recording

SIZE, GAIN, BLACK, PRNU = (128, 128), 0.5, 200.0, 0.008
Y, X = np.indices(SIZE)
LENS = 1 - 0.4 * ((Y - 64) ** 2 + (X - 64) ** 2) / 64**2 / 2


def dust(row, column, width, deep):
    return 1 - deep * np.exp(-((Y - row) ** 2 + (X - column) ** 2) / 2 / width**2)


def taken(light, cfa="MONO", seed=1, own=1.0):
    rng = np.random.default_rng(seed)
    response = own + PRNU * rng.standard_normal(SIZE)
    out = []
    for kind, level in (("flat", 3000.0), ("flat", 5000.0), ("dark", 0.0)):
        charge = rng.poisson(np.maximum(level * light * response, 0), (8, *SIZE)) + 3 * rng.standard_normal(
            (8, *SIZE)
        )
        codes = np.clip(np.rint(BLACK + GAIN * charge), 0, 4095).astype(np.uint16)
        out.append(frame_statistics(Recording(codes, cfa, (BLACK,) * 4, 4095.0, "c", kind, exposure_s=1.0)))
    return out


@pytest.mark.parametrize("cfa", [pytest.param("MONO", marks=pytest.mark.slow), "RGGB"])
def test_shadows_of_dust_are_named_and_no_sensitivities(cfa):
    statistics = taken(LENS * dust(40, 45, 5, 0.15) * dust(90, 30, 8, 0.08), cfa)
    said = shadows_line(statistics)
    places = [part.split() for part in said.split(": ")[2].split(", ")]
    assert "shadows as of dust" in said and "2 more" not in said
    assert float(places[0][0]) == pytest.approx(15, abs=2) and float(places[2][0]) == pytest.approx(8, abs=2)
    near = [int(p[-1]) for p in places]
    assert near == [pytest.approx(v, abs=4) for v in (41, 46, 91, 31)]
    transfer = of_all_pixels(transfer_at(statistics))
    for found in transfer.outcomes("PRNU1288"):
        assert found.value == pytest.approx(100 * PRNU, rel=0.06)
    note = next(q.note for q in transfer.quantities if q.name == "PRNU1288")
    assert "with them, as EMVA 1288 has it" in note
    own = MECHANISMS["prnu"].estimator(transfer.statistics, transfer.baseline)
    assert not isinstance(own, NotMeasurable) and own["sigma"].value == pytest.approx(PRNU, rel=0.04)


@pytest.mark.parametrize("what", ["plain", "lens", "blocks", "columns", "dead pixels"])
def test_patterns_of_the_whole_frame_are_no_shadows(what):
    rng, light, own = np.random.default_rng(3), 1.0, 1.0
    if what == "lens":
        light = 1 - 0.85 * ((Y - 64) ** 2 + (X - 64) ** 2) / 64**2 / 2
    if what == "blocks":
        own = np.kron(1 + 0.02 * rng.standard_normal((16, 16)), np.ones((8, 8)))
    if what == "columns":
        own = 1 + 0.02 * rng.standard_normal((1, 128))
    if what == "dead pixels":
        own = np.where(rng.random(SIZE) < 0.002, 0.0, 1.0)
        own[60, 60:62] = 0.0
    assert shadows_line(taken(light * np.ones(SIZE), own=own)) == ""


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_shadows_over_a_tenth_of_a_small_frame_are_told_as_well(seed):
    """Four sharp discs of five to eleven pixels, with their skirts up to a quarter of the frame."""
    rng, light = np.random.default_rng(40 + seed), LENS.copy()
    for _ in range(4):
        row, column, radius = rng.uniform(12, 116), rng.uniform(12, 116), rng.uniform(5, 11)
        light *= 1 - 0.06 * (np.hypot(Y - row, X - column) < radius)
    statistics = taken(light, seed=seed)
    assert "shadows as of dust" in shadows_line(statistics)
    table = of_all_pixels(transfer_at(statistics))
    found = next(q.outcome for q in table.quantities if q.name == "PRNU1288")
    assert found.value == pytest.approx(100 * PRNU, rel=0.05)
    sigma = MECHANISMS["prnu"].estimator.measure(statistics, None)["sigma"]
    assert sigma.value == pytest.approx(PRNU, rel=0.06)


def rings(seed):
    """Of twelve grains out of focus, 3 to 15 % deep."""
    rng, light = np.random.default_rng(seed), LENS.copy()
    for _ in range(12):
        row, column, radius = rng.integers(10, 118), rng.integers(10, 118), rng.uniform(4, 9)
        away = np.hypot(Y - row, X - column)
        light *= 1 - rng.uniform(0.03, 0.15) * ((away < radius) & (away > 0.35 * radius))
    return ndimage.gaussian_filter(light, 0.8)


@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_many_rings_of_dust_are_no_sensitivities_of_pixels_or_columns(seed):
    statistics = taken(rings(seed))
    assert "shadows as of dust" in shadows_line(statistics)
    transfer = of_all_pixels(transfer_at(statistics))
    (prnu,) = transfer.outcomes("PRNU1288")
    assert prnu.value == pytest.approx(100 * PRNU, rel=0.06)
    found = MECHANISMS["prnu"].estimator(statistics, transfer.baseline)
    assert found["sigma"].value == pytest.approx(PRNU, rel=0.06)
    columns = MECHANISMS["column_gain"].estimator(statistics, transfer.baseline)
    assert columns["sigma"].value < 1e-3
