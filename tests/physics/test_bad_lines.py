"""Hot columns and rows, and such that lose charge, in plain NumPy: they are named, and move nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.transfer.bad_lines import line_means_without
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.faults import faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, transfer_at
from cannoise_jax.recordings.recording import Recording

SIZE, GAIN, READ_E, BLACK, PRNU = (96, 128), 0.8, 3.5, 500.0, 0.006
HOT, WEAK, HALF = 100, 40, 77


def statistics(
    bad: bool, fixed: float = 0.0, gains: float = 0.0, seed: int = 1, dead: tuple = (), turned: bool = False
):
    """Flats of two levels in vignetted light and biases. bad: with one column 300 DN higher, one of 30 % and
    half a column of 50 % of the light; fixed, gains: of Gaussian populations of columns, DN and relative.
    turned: frames whose rows are the columns."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in SIZE), indexing="ij")
    response = (1 + PRNU * rng.standard_normal(SIZE)) * (1 + gains * rng.standard_normal(SIZE[1]))
    response *= 1 - 0.2 * (x**2 + y**2)
    offsets = BLACK + rng.standard_normal(SIZE) + fixed * rng.standard_normal(SIZE[1])
    if bad:
        offsets[:, HOT] += 300
        response[:, WEAK] *= 0.3
        response[50:, HALF] *= 0.5
    if dead:
        response[dead] = 0
    out = []
    for kind, light, frames in (("flat", 15000.0, 6), ("flat", 7000.0, 6), ("bias", 0.0, 8)):
        charge = rng.poisson(light * response, (frames, *SIZE)) + READ_E * rng.standard_normal(
            (frames, *SIZE)
        )
        codes = np.rint(offsets + GAIN * charge).astype(np.uint16)
        codes = codes.transpose(0, 2, 1) if turned else codes
        seconds = 1.0 if kind == "flat" else 0.0
        taken = Recording(codes, "MONO", (BLACK,) * 4, 65535.0, "made", kind, exposure_s=seconds)
        out.append(frame_statistics(taken))
    return out


def strength(stats, transfer, name):
    found = MECHANISMS[name].estimator(stats, transfer.baseline)
    return next(iter(found.values()))


@pytest.mark.parametrize("turned", (False, True), ids=("columns", "rows"))
def test_bad_lines_move_neither_levels_nor_populations_of_lines(turned):
    stats = statistics(bad=True, turned=turned)
    transfer = of_all_pixels(transfer_at(stats))
    found = {(q.name, q.unit): q.outcome for q in transfer.quantities}
    assert found["black level", "DN"].value == pytest.approx(BLACK, abs=0.1)
    np.testing.assert_allclose(transfer.baseline.black_level, BLACK, atol=0.1)
    assert found["system gain", "DN/e-"].value == pytest.approx(GAIN, rel=0.02)
    assert found["temporal dark noise", "e-"].value == pytest.approx(READ_E, rel=0.03)
    assert found["DSNU1288", "DN"].value == pytest.approx(1.0, rel=0.05)
    assert found["PRNU1288", "%"].value == pytest.approx(100 * PRNU, rel=0.05)
    for name in ("row_fpn",) if turned else ("column_fpn", "column_gain"):
        assert strength(stats, transfer, name).by_chance > 3e-4, name
    assert strength(stats, transfer, "prnu").value == pytest.approx(PRNU, rel=0.05)
    assert isinstance(MECHANISMS["dead_pixels"].estimator(stats, transfer.baseline), NotMeasurable)


@pytest.mark.parametrize("turned", (False, True), ids=("columns", "rows"))
def test_bad_lines_are_named_with_what_they_are(turned):
    said = faults(statistics(bad=True, turned=turned)).lines
    line, part = ("rows", "columns") if turned else ("columns", "rows")
    assert said.startswith(f"bad {line} 41 (30 % of the light)") and "101 (+300 DN in the darks)" in said
    assert f"78 (50 % of the light, {part}" in said and "to 96)" in said
    assert faults(statistics(bad=False)).lines == ""


def test_a_dead_pixel_of_a_bad_column_is_dead():
    stats = statistics(bad=True, dead=(20, HOT))
    found = MECHANISMS["dead_pixels"].estimator(stats, None)
    assert found["fraction"].value == pytest.approx(1 / (SIZE[0] * SIZE[1]))
    assert "1 (0.0081 %) do not answer light" in faults(stats).defects


def test_columns_of_a_population_are_none_of_them():
    stats = statistics(bad=False, fixed=8.0, gains=0.02)
    assert all(s.bad is None for s in stats)
    transfer = of_all_pixels(transfer_at(stats))
    assert strength(stats, transfer, "column_fpn").value == pytest.approx(8.0, rel=0.2)
    assert strength(stats, transfer, "column_gain").value == pytest.approx(0.02, rel=0.2)


def test_means_of_lines_without_pixels_are_those_of_the_others():
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 1000, (3, 8, 12)).astype(np.uint16)
    out = rng.random((8, 12)) < 0.3
    out[:, 4] = True
    rows, columns = line_means_without(frames, out, 1 << 20)
    for t, y, p in ((0, 0, 0), (1, 3, 1), (2, 7, 0)):
        keep = ~out[y, p::2]
        assert rows[t, y, p] == pytest.approx(frames[t, y, p::2][keep].mean())
    for t, p, x in ((0, 0, 1), (1, 1, 7), (2, 0, 10)):
        keep = ~out[p::2, x]
        assert columns[t, p, x] == pytest.approx(frames[t, p::2, x][keep].mean())
    others = ~out[0::2, 0::2]
    assert columns[1, 0, 4] == pytest.approx(frames[1, 0::2, 0::2][others].mean())
