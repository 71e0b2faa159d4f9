"""Codes that a table, a digital gain or two converters put apart are told from missing ones and from ends."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from cannoise_jax.mechanisms import MECHANISMS
from cannoise_jax.physics.core import tukey_lambda
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.doubts import doubts
from cannoise_jax.physics.transfer.ends import rails
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.noise import heavy_tails
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels, transfer_at
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.codes import kept_of


def taken(stored, seed=2, levels=(0.0, 600.0, 1400.0, 2400.0)):
    """Recordings of a camera whose values pass through `stored` at last."""
    rng = np.random.default_rng(seed)
    out = []
    for light in levels:
        values = 200 + rng.poisson(light, (6, 64, 96)) + 5 * rng.standard_normal((6, 64, 96))
        codes = np.clip(np.rint(stored(values)), 0, 65535).astype(np.uint16)
        kind = "flat" if light else "dark"
        out.append(
            frame_statistics(Recording(codes, "MONO", (200.0,) * 4, 65535.0, "c", kind, exposure_s=1.0))
        )
    return out


def companded(values):
    return np.rint(np.rint(np.sqrt(np.clip(values, 0, None) / 4095) * 127) ** 2 / 127**2 * 4095)


@pytest.mark.parametrize(
    ("stored", "apart"),
    [
        (lambda v: np.rint(v) * 21.35, True),
        (companded, True),
        (lambda v: np.where(v > 1200, 8 * np.rint(v / 8), v), True),
        (lambda v: v, False),
        (lambda v: 8 * np.rint(v), False),
    ],
    ids=["scaled", "table", "two gains", "plain", "shifted"],
)
def test_codes_that_lie_apart_are_said(stored, apart):
    found = MECHANISMS["missing_codes"].estimator(taken(stored), None)
    assert isinstance(found, NotMeasurable) and ("apart" in found.record) == apart


def test_one_code_in_nine_that_never_occurs_is_missing():
    found = MECHANISMS["missing_codes"].estimator(taken(lambda v: np.rint(v) + (np.rint(v) % 9 == 4)), None)
    assert found["period"].value == 9


def test_codes_of_a_table_pile_up_nowhere():
    """The tail of a level ends at one of few codes; a brighter flat lies far above."""
    statistics = taken(companded)
    assert all(np.isnan(s.high).all() for s in statistics)
    end = [q for q in transfer_at(statistics).quantities if q.name == "saturation level"]
    assert all(isinstance(q.outcome, NotMeasurable) for q in end)
    histogram = np.zeros(1 << 16, np.int64)
    histogram[[100, 130, 160, 190]] = 4, 60, 90, 3000
    assert rails(histogram, 1.0, 1023.0)[1] == 190
    histogram[160] = 800
    assert np.isnan(rails(histogram, 1.0, 1023.0)[1])


def test_flats_of_a_second_gain_of_the_converter_are_no_part_of_the_line():
    """From 1200 DN on the low gain, four times the other: codes 4 apart, and 30 DN of read noise."""
    rng = np.random.default_rng(4)

    def stored(values):
        low = 4 * np.rint((values + 30 * rng.standard_normal(values.shape)) / 4)
        return np.where(values < 1200, np.rint(values), low)

    statistics = taken(stored, levels=(0.0, 300.0, 600.0, 1400.0, 2400.0))
    transfer = of_all_pixels(transfer_at(statistics))
    assert transfer.baseline.gain[0] == pytest.approx(1.0, abs=0.02)
    assert transfer.baseline.read_noise[0] == pytest.approx(5.0, rel=0.02)
    said = next(q.note for q in transfer.quantities if q.name == "system gain")
    assert "up to 800 DN: from 1600 DN on codes lie 4 apart, not 1" in said
    plain = of_all_pixels(transfer_at(taken(lambda v: v)))
    assert "apart" not in "".join(q.note for q in plain.quantities)


def test_rounding_to_codes_that_a_gain_put_apart_is_no_read_noise():
    """Codes 64 or 65 apart, read noise of one and a quarter: a variance of 64^2 / 12 is that of rounding."""
    gain = 64.06
    transfer = of_all_pixels(
        transfer_at(taken(lambda v: np.rint(np.rint(v / 4) * gain), levels=(0.0, 600.0, 1400.0)))
    )
    assert transfer.baseline.read_noise[0] == pytest.approx(1.25 * gain, rel=0.01)
    assert transfer.baseline.gain[0] == pytest.approx(gain / 4, rel=0.02)


@pytest.mark.parametrize("period", [5, 8, 13])
@pytest.mark.parametrize(("above", "up"), [(1.0, 1.0), (0.0, 0.0), (0.5, 0.5)])
def test_which_codes_are_missing_and_where_their_values_are(period, above, up):
    rng = np.random.default_rng(period)
    phase = period // 2

    def stored(values):
        codes = np.rint(values)
        side = np.where(rng.random(codes.shape) < up, 1, -1)
        return codes + (codes % period == phase) * side

    found = MECHANISMS["missing_codes"].estimator(taken(stored), None)
    assert (found["period"].value, found["phase"].value) == (period, phase)
    assert found["above"].value == pytest.approx(above, abs=0.1)


def test_codes_that_are_missing_are_drawn_where_they_are_missing():
    values = {"period": 8.0, "phase": 3.0, "above": 0.0}
    model = SensorModel.poisson_gaussian(2.0, 4.0, 100, 4095, "MONO").with_mechanism(
        "missing_codes", **values
    )
    drawn = model.sample(jax.random.key(0), np.zeros((64, 64), np.float32), Settings(frames=8))
    counts = np.bincount(np.asarray(drawn).ravel())
    codes = np.flatnonzero(counts)
    assert not (codes % 8 == 3).any() and {1, 2, 4} <= set(codes % 8)
    middle = counts[96:104]
    assert middle[2] > 1.6 * middle[4]


@pytest.mark.parametrize("period", [2, 5])
@pytest.mark.parametrize("held", [0.0, 0.3, 0.8])
def test_codes_that_are_rarer_hold_as_much_of_those_beside_them(held, period):
    model = SensorModel.poisson_gaussian(2.0, 12.0, 200, 4095, "MONO").with_mechanism(
        "missing_codes", period=float(period), phase=1.0, above=0.4, kept=kept_of(held, period)
    )
    drawn = model.sample(jax.random.key(0), np.zeros((96, 96), np.float32), Settings(frames=24))
    counts = np.bincount(np.asarray(drawn).ravel(), minlength=400)
    codes = np.arange(180, 221)
    rare = codes[codes % period == 1]
    share = counts[rare].sum() / ((counts[rare - 1] + counts[rare + 1]).sum() / 2)
    assert share == pytest.approx(held, abs=0.02)


@pytest.mark.parametrize("factor", (1.1, 1.37, 1.7))
@pytest.mark.parametrize("tailed", (False, True), ids=["gaussian", "tailed"])
def test_codes_that_a_digital_gain_put_apart_have_the_tails_of_those_before(factor, tailed):
    rng = np.random.default_rng(4)
    shape = (8, 96, 128)
    noise = rng.standard_t(6, shape) / np.sqrt(1.5) if tailed else rng.standard_normal(shape)
    codes = np.floor(np.rint(2.8 * noise) * factor + 0.5) + 500
    taken = Recording(codes.astype(np.uint16), "MONO", (500.0,) * 4, 65535.0, "c", "bias")
    found = heavy_tails([frame_statistics(taken)])["tukey_lambda"]
    if tailed:
        assert found.value < tukey_lambda.GAUSSIAN - 0.1
    else:
        assert found.value == pytest.approx(tukey_lambda.GAUSSIAN, abs=3.5 * found.stderr)


@pytest.mark.parametrize("read", (3.5, 9.0))
def test_rounding_to_codes_that_a_square_root_put_apart_is_no_gain(read):
    """Codes rint(2 sqrt(DN - 300)) squared back: 14 DN apart in the dark, and 69 and 99 in the flats."""
    rng = np.random.default_rng(3)
    gain, size, statistics = 0.8, (96, 128), []
    y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in size), indexing="ij")
    shape = (1 - 0.3 * (x**2 + y**2)) * (1 + 0.006 * rng.standard_normal(size))
    for kind, light in (("bias", 0.0), ("flat", 15000.0), ("flat", 7000.0)):
        charge = rng.poisson(light * shape, (8, *size)) + read * rng.standard_normal((8, *size))
        codes = 300 + np.rint((np.rint(2 * np.sqrt(np.maximum(200 + gain * charge, 0))) / 2) ** 2)
        own = Recording(codes.astype(np.uint16), "MONO", (500.0,) * 4, 16383.0, "c", kind, exposure_s=1.0)
        statistics.append(frame_statistics(own))
    transfer = of_all_pixels(transfer_at(statistics))
    found = {(q.name, q.unit): q for q in transfer.quantities}
    assert found["system gain", "DN/e-"].outcome.value == pytest.approx(gain, rel=0.02)
    assert "apart, as of a table: the variance of rounding" in found["system gain", "DN/e-"].note
    noise = found["temporal dark noise", "e-"].outcome  # of a fifth of a code in the dark only a bound
    assert noise.ci90[0] - 0.15 <= read <= noise.ci90[1] + 0.15
    level = found["black level", "DN"].outcome
    assert level.ci90[0] - 0.2 <= 500.0 <= level.ci90[1] + 0.2


def test_codes_further_apart_than_the_noise_doubt_the_gain():
    """400 DN apart in the flats, whose noise is 63 DN."""
    coarse = taken(lambda v: np.where(v < 1000, v, 400 * np.rint(v / 400)), levels=(0.0, 4000.0, 8000.0))
    assert any("mostly that of rounding" in line for line in doubts(of_all_pixels(transfer_at(coarse))))
    plain = taken(lambda v: v, levels=(0.0, 4000.0, 8000.0))
    assert not doubts(of_all_pixels(transfer_at(plain)))
