"""The remainder: what a simulator leaves out, measured and drawn as it was measured, and kept in a file."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.discovery.compare import better, compare
from cannoise_jax.discovery.compare.remainder import quiet, with_remainder
from cannoise_jax.discovery.frames.battery import prepare
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.discovery.search.model import baseline_model
from cannoise_jax.mechanisms.residual import MAPS, RESIDUAL
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import write_sensor
from tests.discovery.capture import capture_set

KEY = jax.random.key(3)


def odd_camera(rng):
    """Half rows that jump, a line of 5.3 rows, and fixed banks of four columns: none has a name."""
    banks = 2.0 * np.repeat(rng.standard_normal((1, 32)), 4, 1)
    y = np.arange(96)[:, None]

    def change(dn, *_):
        halves = 1.5 * np.repeat(rng.standard_normal((96, 2)), 64, 1)
        return dn + halves + banks + np.sin(2 * np.pi * (y / 5.3 + rng.random()))

    return change


def fitted_baseline(capture):
    prepared = prepare(capture, all_frames(split_recordings(capture)), False)
    return baseline_model(capture, prepared)


@pytest.fixture(scope="module")
def models():
    capture = capture_set(51, odd_camera, kinds="df")
    plain = fitted_baseline(capture)
    return capture, plain, with_remainder(capture, plain, KEY)


def test_the_remainder_is_nearer_to_frames_that_were_held_back(models):
    capture, plain, mended = models
    before, after = (compare(capture, m, KEY) for m in (plain, mended))
    result = better(before.bank, after.bank)
    assert result.verdict == "B" and result.held_back and result.low > 0
    left = [sum(d.nats for d in c.differences) for c in (before, after)]
    assert left[1] < 0.3 * left[0]


def test_nothing_is_added_where_nothing_is_missing():
    capture = capture_set(52, kinds="d")
    plain = fitted_baseline(capture)
    mended = with_remainder(capture, plain, KEY)
    # What it takes over of chance makes neither of the two nearer.
    before, after = (compare(capture, m, KEY) for m in (plain, mended))
    assert better(before.bank, after.bank).verdict == "neither"
    maps = mended.mechanisms[0].maps
    taken_over = (1 - float(maps["keep"].ravel()[0])) * 4.5**2
    assert abs(float(np.mean(maps["spectrum"])) - taken_over) < 0.02 * 4.5**2
    # Of the noise of a mean of twelve frames a tenth comes through, up to a sixth (8 sets of recordings).
    assert np.std(maps["offset"]) < 0.2 * 4.5 / np.sqrt(12)


HEAT_E_S = 3000.0 * (np.random.default_rng(2).random((96, 128)) < 0.01)


def warm_camera(rng):
    """Dark current of 400 e-/s and hot pixels, both with their shot noise."""

    def change(dn, signal, kind, seconds):
        return dn + 1.5 * rng.poisson((400.0 + HEAT_E_S) * seconds, dn.shape)

    return change


@pytest.mark.slow
def test_noise_that_the_simulator_has_is_not_added_once_more():
    """Neither that of the dark current, which grows with the exposure, nor that of single pixels."""
    capture = capture_set(53, warm_camera, kinds="d", frames=16)
    plain = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 16383.0, "RGGB")
    warm = plain.with_mechanism("dark_current", e_per_s=400.0).with_mechanism(
        "hot_pixels", e_per_s=3000.0, maps={"heat": HEAT_E_S[None] / 3000.0}
    )
    truth, hot = 1.5**2 * 400.0, HEAT_E_S > 0
    of_plain, of_warm = (with_remainder(capture, m, KEY).mechanisms[-1].maps for m in (plain, warm))
    assert np.median(of_plain["growth"]) == pytest.approx(truth, rel=0.1)
    assert np.median(of_warm["growth"]) < 0.05 * truth
    added = [np.mean(np.asarray(m["growth"] + 10 * m["spread"])[..., hot]) for m in (of_plain, of_warm)]
    assert added[1] < 0.2 * added[0]


def test_it_is_kept_in_a_file_and_belongs_to_one_unit(models, tmp_path):
    _, plain, mended = models
    write_sensor(tmp_path / "sensor.json", mended)
    back = SensorModel.load(tmp_path / "sensor.json")
    clean, settings = np.zeros((96, 128), np.float32), Settings(frames=2)
    one, two = (np.asarray(m.sample(KEY, clean, settings)) for m in (mended, back))
    assert (one == two).all()
    other = np.asarray(mended.with_unit(jax.random.key(8)).sample(KEY, clean, settings))
    assert (other == np.asarray(plain.sample(KEY, clean, settings))).all()


COLUMNS = np.where(np.arange(128) % 11 == 4, 2.2, 0.9).astype(np.float32)


def test_columns_keep_a_noise_of_their_own_where_the_spectrum_takes_read_noise_over():
    size, read = (96, 128), 4.0
    plain = SensorModel.poisson_gaussian(1.0, read, 200.0, 16383.0, "RGGB").with_mechanism(
        "column_read_noise_map", spread=0.4, maps={"factor": COLUMNS[None, None]}
    )
    taken = 0.7
    maps = {name: np.zeros(size) for name in ("offset", "rate", "spread", "growth")}
    maps["spectrum"] = np.full(size, taken * read**2)
    maps["keep"], maps["pixels"] = np.full((1, 1), 1 - taken), np.full((1, 1), 96.0 * 128.0)
    rest = {name: np.full((1, 1), float(name.startswith("left"))) for name in MAPS if name not in maps}
    mended = plain.with_mechanism(RESIDUAL, maps={n: jnp.asarray(v) for n, v in (maps | rest).items()})
    clean, settings = np.zeros(size, np.float32), Settings(frames=24)
    one, two = (
        np.sqrt(np.var(np.asarray(m.sample(KEY, clean, settings), float), 0, ddof=1).mean(0))
        for m in (plain, mended)
    )
    assert np.allclose(two, one, rtol=0.1)
    assert np.mean(two / one) == pytest.approx(1.0, abs=0.01)
    assert quiet(plain, size) == pytest.approx(0.81, rel=1e-3)


def noisy_columns(rng):
    """Columns with a noise of their own, and slanting waves that no name describes."""
    y, x = np.mgrid[:96, :128]

    def change(dn, *_):
        wave = 2.5 * np.cos(2 * np.pi * (0.0713 * y + 0.311 * x + rng.random()))
        return dn + 9.0 * (COLUMNS > 1) * rng.standard_normal(dn.shape) + wave

    return change


def test_columns_of_a_finding_are_as_noisy_with_the_remainder_as_without():
    capture = capture_set(54, noisy_columns, kinds="d")
    factor = np.where(COLUMNS > 1, np.sqrt(4.5**2 + 9.0**2) / 4.5, 1.0).astype(np.float32)
    plain = SensorModel.poisson_gaussian(1.5, 3.0, 200.0, 16383.0, "RGGB").with_mechanism(
        "column_read_noise_map", spread=0.4, maps={"factor": factor[None, None]}
    )
    mended = with_remainder(capture, plain, KEY)
    r = capture.recordings[0]
    # A wave of random phase is of another strength in every frame.
    settings = Settings(frames=256, exposure_s=float(r.exposure_s or 0.0))
    drawn = np.asarray(mended.sample(KEY, np.zeros(r.size, np.float32), settings), float)
    of_columns = np.sqrt(np.var(drawn, 0, ddof=1).mean(0))
    recorded = np.sqrt(np.var(np.asarray(r.frames, float), 0, ddof=1).mean(0))
    for some in (COLUMNS > 1, COLUMNS < 1):
        assert np.mean(of_columns[some]) == pytest.approx(np.mean(recorded[some]), rel=0.04)
