"""The bank: orthonormal energies, products as a plain loop takes them, moments of known laws."""

from __future__ import annotations

import numpy as np
import pytest

from cannoise_jax.signatures import bank


@pytest.mark.parametrize("size", [(64, 96), (48, 80), (34, 46)])
def test_energies_split_the_whole_power_and_count_every_pixel(size):
    field = np.random.default_rng(1).standard_normal(size).astype(np.float32)
    h, w = (bank.cropped_side(n) for n in size)
    count = bank.counts(size)
    assert count.sum() == h * w
    assert np.sum(bank.energies(field) * count) == pytest.approx(np.sum(field[:h, :w] ** 2), rel=1e-5)


def test_white_noise_has_unit_energy_at_every_scale():
    rng = np.random.default_rng(2)
    fields = [bank.energies(rng.standard_normal((64, 96)).astype(np.float32)) for _ in range(60)]
    z = (np.mean(fields, 0) - 1) / np.sqrt(2 / (60 * bank.counts((64, 96))))
    assert abs(z.mean()) < 0.2 and 0.85 < z.std() < 1.15


@pytest.mark.parametrize(
    "pattern, band, row_whole, column_whole",
    [
        (lambda y, x, g: g[y], 0, False, True),
        (lambda y, x, g: g[x], 0, True, False),
        (lambda y, x, g: g[y] * (-1.0) ** x, 1, False, True),
        (lambda y, x, g: g[x] * (-1.0) ** y, 2, True, False),
        (lambda y, x, g: 0 * x + 1.0, 0, True, True),
    ],
)
def test_structure_lies_where_it_belongs(pattern, band, row_whole, column_whole):
    """Rows, columns, rows of odd against even columns and so on hold all their own power."""
    rng = np.random.default_rng(3)
    y, x = np.indices((64, 96))
    offsets = np.repeat(rng.standard_normal(48), 2)
    offsets -= offsets[:64].mean()
    field = pattern(y, x, offsets).astype(np.float32)
    power = bank.energies(field) * bank.counts((64, 96))
    rows, columns = bank.scales(32), bank.scales(48)
    here = np.zeros(power.shape, bool)
    for i, r in enumerate(rows):
        for j, c in enumerate(columns):
            here[band, i, j] = r.whole >= row_whole and c.whole >= column_whole
    assert power[here].sum() / power.sum() > 0.999


def test_products_are_those_of_a_plain_loop():
    rng = np.random.default_rng(4)
    field = rng.standard_normal((40, 150)).astype(np.float32)
    table = bank.products(field)
    at = bank.lags()
    for dy, dx in ((0, 1), (0, 64), (1, -3), (2, 5), (16, -64), (15, 0)):
        n = int(np.flatnonzero((at == (dy, dx)).all(1))[0])
        for p in range(4):
            total = 0.0
            for y in range(p // 2, 40 - dy, 2):
                for x in range(p % 2, 150, 2):
                    if 0 <= x + dx < 150:
                        total += field[y, x] * field[y + dy, x + dx]
            pairs = (40 - dy) * (150 - abs(dx)) / 4
            assert table[p, n] == pytest.approx(total / pairs, abs=2e-4)


def test_rows_and_columns_are_no_correlation_of_neighbours():
    rng = np.random.default_rng(5)
    field = 3 * rng.standard_normal((64, 1)) + 2 * rng.standard_normal((1, 96))
    field = (field + rng.standard_normal((64, 96))).astype(np.float32)
    left = bank.without_lines(field)
    assert np.abs(left.mean(0)).max() < 1e-5 and np.abs(left[:, ::2].mean(1)).max() < 1e-5
    together, _ = bank.product_statistics(bank.products(left))
    assert np.abs(together).max() < 0.15


def test_moments_of_a_skewed_law():
    rng = np.random.default_rng(6)
    field = ((rng.chisquare(8, (400, 400)) - 8) / 4).astype(np.float32)
    second, third, fourth = bank.hermite(field, np.ones_like(field))[:, 0]
    assert abs(second) < 0.02
    assert third == pytest.approx(np.sqrt(8 / 8), abs=0.06) and fourth == pytest.approx(12 / 8, abs=0.3)


def test_a_wave_is_one_peak_of_the_periodogram():
    y, x = np.indices((64, 96))
    field = np.cos(2 * np.pi * (5 * y / 64 + 7 * x / 96)).astype(np.float32)
    power = bank.power(field)
    assert np.unravel_index(power.argmax(), power.shape) == (5, 7)
    assert power.max() == pytest.approx(64 * 96 / 4, rel=1e-4)


def test_sparsity_is_that_of_noise_whatever_its_spectrum_and_falls_where_few_places_are_strong():
    rng = np.random.default_rng(4)
    size = (96, 128)
    slow = [np.cumsum(rng.standard_normal(size), 0).astype(np.float32) for _ in range(12)]
    white = [rng.standard_normal(size).astype(np.float32) for _ in range(12)]
    stepped = [w + 3 * (np.arange(96)[:, None] >= rng.integers(96)) for w in white]

    def of(fields):
        mean = np.mean([bank.energies(f.astype(np.float32)) for f in fields], 0)
        return np.mean([bank.sparsity(f.astype(np.float32), mean) for f in fields], 0)

    count = bank.counts(size) * 12
    error = np.sqrt(bank.sparsity_variance() / count)
    plain, steps = of(white), of(stepped)
    chosen = count > 200
    assert np.all(np.abs(of(slow) - plain)[chosen] < 6 * error[chosen])
    whole_rows = (slice(0, 1), slice(1, 3), slice(-1, None))
    assert np.all(steps[whole_rows] < plain[whole_rows] - 0.5)
