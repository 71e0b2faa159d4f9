"""The sensor model: its baseline is the textbook's, it interpolates and warns, and it works inside other
JAX code."""

import dataclasses
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.grammar import Point
from cannoise_jax.physics.initial_noise import initial_noise
from cannoise_jax.physics.mechanism import Scaling
from cannoise_jax.physics.sensor import ExtrapolationWarning, IsoTable, SensorModel, Settings
from cannoise_jax.physics.sensor_json import write_sensor
from cannoise_jax.physics.settings import baseline_at, context_of, resolve
from cannoise_jax.recordings import BadInput
from cannoise_jax.recordings.packing import pack

SIZE = (32, 32)
FLAT = np.full(SIZE, 0.2, np.float32)
MODEL = SensorModel.poisson_gaussian(0.5, 3.0, (60, 64, 68, 72), 1084, "RGGB")
KEY = jax.random.key(1)


def sites(y):
    return [y[:, i::2, j::2].astype(np.float64) for i in (0, 1) for j in (0, 1)]


def test_frames_have_the_expected_mean_and_variance_per_channel():
    model = SensorModel.poisson_gaussian((0.4, 0.5, 0.6, 0.7), (2, 3, 4, 5), (60, 64, 68, 72), 1084, "RGGB")
    y = np.asarray(model.sample(KEY, FLAT, Settings(frames=60)))
    assert y.dtype == np.uint16 and y.shape == (60, *SIZE)
    for site, black, gain, read in zip(
        sites(y), (60, 64, 68, 72), (0.4, 0.5, 0.6, 0.7), (2, 3, 4, 5), strict=True
    ):
        signal = 0.2 * (1084 - black)
        variance = gain * signal + (gain * read) ** 2 + 1 / 12
        assert site.mean() == pytest.approx(black + signal, abs=5 * np.sqrt(variance / site.size))
        assert site.var() == pytest.approx(variance, rel=0.05)


def test_expected_is_the_mean_with_frozen_patterns():
    model = MODEL.with_mechanism("prnu", sigma=0.05).with_mechanism("column_fpn", sigma_dn=4.0)
    y = np.asarray(model.sample(KEY, FLAT, Settings(frames=400)), np.float64)
    gap = y.mean(axis=0) - np.asarray(model.expected(FLAT))
    assert np.abs(gap).max() < 5.5 * y.std(axis=0).max() / 20
    assert np.asarray(model.expected(FLAT)).std() > 5


def test_keys_share_the_pattern_of_a_unit_and_units_differ():
    model = MODEL.with_mechanism("dsnu", sigma_dn=20.0)
    first, second, other = (
        np.asarray(m.sample(k, FLAT, Settings(frames=40)), np.float64).mean(axis=0)
        for m, k in (
            (model, KEY),
            (model, jax.random.key(2)),
            (model.with_unit(jax.random.key(3)), KEY),
        )
    )
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.95
    assert abs(np.corrcoef(first.ravel(), other.ravel())[0, 1]) < 0.2


def test_adding_a_mechanism_leaves_the_other_draws_alone():
    plain = np.asarray(MODEL.sample(KEY, FLAT, Settings(frames=3)), np.float64)
    shifted = np.asarray(
        MODEL.with_mechanism("offset_drift", sigma_dn=50.0).sample(KEY, FLAT, Settings(frames=3)), np.float64
    )
    change = (shifted - plain).reshape(3, -1)
    assert np.all(change.max(axis=1) - change.min(axis=1) <= 1.0)
    assert np.abs(change.mean(axis=1)).max() > 5


def test_with_and_without():
    model = MODEL.with_mechanism("in_camera_denoising").with_mechanism("row_noise", sigma_dn=1.0)
    assert [f.mechanism for f in model.mechanisms] == ["row_noise", "in_camera_denoising"], "chain order"
    assert [f.mechanism for f in model.without("row_noise").mechanisms] == ["in_camera_denoising"]
    with pytest.raises(ValueError, match="no parameter volume"):
        MODEL.with_mechanism("row_noise", volume=11)
    with pytest.raises(ValueError, match="gremlins"):
        MODEL.with_mechanism("gremlins")


@pytest.mark.parametrize("step", [1.0, 4.0, 16.0])
def test_codes_lie_on_the_lattice_within_the_rails(step):
    model = dataclasses.replace(MODEL, code_step=np.float32(step))
    y = np.asarray(
        model.sample(KEY, np.linspace(0, 1.4, 1024, dtype=np.float32).reshape(SIZE), Settings(frames=20))
    )
    assert np.all(y % step == 0) and y.max() == 1084 // step * step
    low = dataclasses.replace(model, black_level=np.zeros(4, np.float32))
    assert np.asarray(low.sample(KEY, FLAT * 0, Settings(frames=20))).min() == 0


def test_baseline_between_and_beyond_the_calibrated_isos():
    model = SensorModel.poisson_gaussian([[0.1], [0.4]], [[4.0], [2.0]], 64, 1023, iso=(100, 400))
    for iso, gain, read in ((100, 0.1, 4), (250, 0.25, 3), (400, 0.4, 2), (800, 0.8, 2), (50, 0.05, 4)):
        got = baseline_at(model, iso)
        np.testing.assert_allclose(got[0], gain, rtol=1e-5)
        np.testing.assert_allclose(got[1], read, rtol=1e-5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.sample(KEY, FLAT, Settings(iso=250))
    with pytest.warns(ExtrapolationWarning, match="proportional to ISO") as caught:
        model.sample(KEY, FLAT, Settings(iso=800))
    assert len(caught) == 1


def values_at(model, **settings):
    return resolve(model, context_of(model, jnp.zeros((1, *SIZE)), Settings(**settings)))[0]


def test_scaling_laws_and_tables():
    base = SensorModel.poisson_gaussian([[0.1], [0.4]], [[4.0], [2.0]], 64, 1023, iso=(100, 400))
    row = base.with_mechanism("row_noise", sigma_dn=0.5)
    np.testing.assert_allclose(values_at(row, iso=400.0)["sigma_dn"], 2.0, rtol=1e-5)
    table = base.with_mechanism(
        "row_noise", sigma_dn=IsoTable(np.array([100.0, 400.0]), np.array([0.5, 0.7]))
    )
    np.testing.assert_allclose(values_at(table, iso=250.0)["sigma_dn"], 0.6, rtol=1e-5)
    law = Scaling(exposure=1.0, doubling_c=6.0, reference_temperature_c=20.0)
    dark = base.with_mechanism("dark_current", e_per_s=3.0, scaling=law)
    warm = values_at(dark, iso=100.0, exposure_s=2.0, temperature_c=32.0)
    np.testing.assert_allclose(warm["e_per_s"], 3 * 2 * 4, rtol=1e-5)
    np.testing.assert_allclose(values_at(dark, iso=100.0, exposure_s=2.0)["e_per_s"], 6, rtol=1e-5)


def test_a_temperature_that_no_law_covers_is_said_once():
    known = Scaling(exposure=1.0, doubling_c=7.0, reference_temperature_c=20.0)
    blind = MODEL.with_mechanism("dark_current", e_per_s=3.0)
    told = MODEL.with_mechanism("dark_current", e_per_s=3.0, scaling=known)
    for model, celsius, words in (
        (blind, 40.0, "reference temperature is unknown"),
        (told, 40.0, "double every 7 K"),
    ):
        with pytest.warns(ExtrapolationWarning, match=words) as caught:
            model.sample(KEY, FLAT, Settings(temperature_c=celsius))
        assert len(caught) == 1 and "dark_current" in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        told.sample(KEY, FLAT, Settings(temperature_c=22.0))
        measured = Scaling(exposure=1.0, exposure_low_s=0.001, exposure_high_s=30.0)
        ranged = MODEL.with_mechanism("dark_current", e_per_s=3.0, scaling=measured)
        ranged.sample(KEY, FLAT)
        blind.sample(KEY, FLAT)
    with pytest.warns(ExtrapolationWarning, match=r"0.001 to 30 s of dark_current.*exposure\^1"):
        ranged.sample(KEY, FLAT, Settings(exposure_s=100.0))


def test_a_place_in_the_grammar_without_a_name_can_be_sampled():
    point = Point("readout", "signal", "column", "redrawn", signal=0.5, distribution="tukey_lambda")
    model = MODEL.with_mechanism("zebra", point=point, sigma_dn=20.0, tukey_lambda=0.1)
    y = np.asarray(model.sample(KEY, FLAT, Settings(frames=50)), np.float64)
    columns = (y - y.mean(axis=0)).mean(axis=1)
    assert columns.std() == pytest.approx(20 * np.sqrt(0.2), rel=0.15)


def test_measured_maps_of_another_size_are_refused():
    model = MODEL.with_mechanism("dsnu").with_maps((16, 16))
    with pytest.raises(BadInput, match="use that size, or another unit"):
        model.sample(KEY, FLAT)


def test_from_nlf_has_that_noise_level_function():
    model = SensorModel.from_nlf(2e-3, 4e-5, 64, 1064, "BGGR")
    y = np.asarray(model.sample(KEY, FLAT, Settings(frames=60)), np.float64)
    assert ((y - 64) / 1000).var() == pytest.approx(2e-3 * 0.2 + 4e-5, rel=0.04)


def test_n_init_is_packed_noise_of_the_given_level_function():
    draw = jax.jit(MODEL.with_mechanism("row_noise", sigma_dn=0.0).n_init())
    clean = pack(np.stack([FLAT, FLAT * 0.1, FLAT * 2]), "RGGB")
    shot = jnp.asarray([[1e-3] * 4, [2e-3] * 4, [5e-4, 1e-3, 2e-3, 4e-3]])
    read = jnp.full((3, 4), 3e-5)
    noise = jnp.concatenate([draw(jax.random.key(k), clean, shot, read)[0] for k in range(12)], axis=1)
    assert noise.shape == (3, 12 * 16, 16, 4)
    sigma = np.sqrt(np.asarray(shot) * np.asarray([0.2, 0.02, 0.4])[:, None] + 3e-5)
    np.testing.assert_allclose(np.asarray(noise).std(axis=(1, 2)), sigma, rtol=0.07)
    assert np.abs(np.asarray(noise).mean(axis=(1, 2)) / sigma).max() < 5 / np.sqrt(12 * 256)


def test_n_init_serves_training_with_maps_larger_than_the_patch():
    model = MODEL.with_mechanism("row_noise", sigma_dn=6.0).with_mechanism("gain_error", error=0.5)
    model = model.with_mechanism("dsnu", sigma_dn=3.0).with_maps((64, 48))
    draw = jax.jit(initial_noise(model.n_init()))
    clean = pack(np.stack([FLAT, FLAT * 0.5]), "RGGB")
    shot, read = jnp.full((2, 4), 1e-3), jnp.full((2, 4), 3e-5)
    drawn = [draw(jax.random.key(k), clean, shot, read) for k in range(40)]
    sigma = np.asarray(drawn[0][1])
    assert sigma.shape == clean.shape
    seen = np.stack([noise for noise, _ in drawn]).std(axis=(0, 2, 3))
    dsnu = 3.0 / (1084 - np.asarray((60, 64, 68, 72)).mean())
    np.testing.assert_allclose(seen, np.sqrt((sigma**2).mean(axis=(1, 2)) + dsnu**2), rtol=0.06)
    with pytest.raises(BadInput, match="use that size, or another unit"):
        model.with_maps((16, 16)).n_init()(KEY, pack(np.zeros((1, 96, 96)), "RGGB"), shot[:1], read[:1])


def test_initial_noise_by_name_of_a_preset_or_a_file(tmp_path):
    write_sensor(tmp_path / "sensor.json", SensorModel.preset("imx686").with_unit(jax.random.key(0)))
    clean = pack(np.stack([FLAT]), "RGGB")
    shot, read = jnp.full((1, 4), 1e-3), jnp.full((1, 4), 3e-5)
    names = ("preset:imx686", f"sensor:{tmp_path / 'sensor.json'}")
    one, two = (initial_noise(name)(KEY, clean, shot, read) for name in names)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    with pytest.raises(BadInput, match="no such preset"):
        initial_noise("preset:gremlin")


def test_mechanisms_in_dn_keep_their_strength_beside_an_altered_gain():
    model = SensorModel.poisson_gaussian(0.5, 1e-3, 500, 65535, "RGGB").with_mechanism("dsnu", sigma_dn=8.0)
    for altered in (
        model.with_mechanism("gain_error", error=1.0),
        model.with_mechanism("dual_gain", iso_switch=50.0, gain_ratio=2.0),
    ):
        y = np.asarray(altered.sample(KEY, FLAT * 0, Settings(frames=4)), np.float64).mean(axis=0)
        assert y.std() == pytest.approx(8, rel=0.08)
        np.testing.assert_allclose(y, np.asarray(altered.expected(FLAT * 0)), atol=1)
    current = SensorModel.poisson_gaussian(0.5, 1.0, 500, 65535).with_mechanism("dark_current", e_per_s=1e4)
    current = current.with_mechanism("gain_error", error=1.0)
    y = np.asarray(current.sample(KEY, FLAT * 0, Settings(frames=4)), np.float64)
    assert y.mean() == pytest.approx(float(current.expected(FLAT * 0).mean()), rel=0.01)


def test_the_frame_before_the_first_has_the_mean_of_the_others():
    model = SensorModel.poisson_gaussian(0.5, 1.0, 500, 65535).with_mechanism("image_lag", fraction=0.4)
    model = model.with_mechanism("gain_error", error=1.0).with_mechanism("dark_current", e_per_s=1e5)
    y = np.asarray(model.sample(KEY, FLAT * 0.05, Settings(frames=4)), np.float64).mean(axis=(1, 2))
    np.testing.assert_allclose(y - y.mean(), 0, atol=0.01 * (y.mean() - 500))


def test_bad_tables_are_refused():
    with pytest.raises(ValueError, match="ascend"):
        SensorModel.poisson_gaussian([[1], [2]], [[1], [1]], iso=(400, 100))
    with pytest.raises(ValueError, match="1 or 4 values"):
        SensorModel.poisson_gaussian((1, 2), 3)


def test_rows_that_are_read_in_pairs_share_their_offset():
    point = Point("readout", "signal", "row", "redrawn", group=2, phase=1)
    base = SensorModel.poisson_gaussian(1.0, 1.0, 200, 4095, "RGGB")
    model = base.with_mechanism("row_pairs", point=point, sigma_dn=5.0)
    frames = np.asarray(model.sample(jax.random.key(0), np.zeros((33, 64), np.float32), Settings(frames=400)))
    rows = frames.astype(float).mean(2) - 200
    pixel = (1 + 1 / 12) / 64
    assert np.mean(rows**2) == pytest.approx(25 + pixel, rel=0.05)
    inside, across = rows[:, 1:-1:2] * rows[:, 2::2], rows[:, 0:-1:2] * rows[:, 1::2]
    assert inside.mean() == pytest.approx(25, rel=0.05) and abs(across.mean()) < 1.2
    fitted = model.mechanisms[0]
    context = context_of(model, jnp.zeros((1, 33, 64)), Settings())
    lags = fitted.record.effect({"sigma_dn": jnp.float32(5.0)}, {}, context).lags
    np.testing.assert_array_equal(np.broadcast_to(lags[1, 0], (33, 64))[:4, 0], [0, 25, 0, 25])
    assert np.all(np.asarray(lags[2, 0]) == 0)
    apart = dataclasses.replace(point, interleave=2)
    frames = base.with_mechanism("row_pairs", point=apart, sigma_dn=5.0).sample(
        jax.random.key(0), np.zeros((33, 64), np.float32), Settings(frames=400)
    )
    even, odd = (np.asarray(frames, float)[:, :, p::2].mean(2) - 200 for p in (0, 1))
    assert np.mean(even**2) == pytest.approx(25 + 2 * pixel, rel=0.05) and abs(np.mean(even * odd)) < 1.2
    assert np.mean(odd[:, 1:-1:2] * odd[:, 2::2]) == pytest.approx(25, rel=0.05)
    fitted = base.with_mechanism("row_pairs", point=apart).mechanisms[0].record
    lags = fitted.effect({"sigma_dn": jnp.float32(5.0)}, {}, context).lags
    assert (float(np.mean(lags[0, 1])), float(np.mean(lags[0, 2]))) == (0.0, 25.0)
    with pytest.raises(ValueError, match="groups"):
        base.with_mechanism("pixel_pairs", point=Point("readout", "signal", "pixel", "redrawn", group=2))


def test_the_ghost_in_the_first_frame_is_of_a_whole_frame():
    """What lands in the pixels beside the light leaves a ghost too, in the first frame as in the others."""
    model = SensorModel.poisson_gaussian(1.0, 0.1, 500, 65535).with_mechanism("image_lag", fraction=0.4)
    model = model.with_mechanism("cosmic_rays", rate=2e4, charge_e=4000.0)
    frames = np.asarray(
        model.sample(jax.random.key(3), np.zeros((128, 128)), Settings(exposure_s=1.0, frames=3))
    )
    share = (frames.astype(float) - 500 > 100).mean(axis=(1, 2))
    assert share[1] > 0.05 and share[0] == pytest.approx(share[1], rel=0.1)


def test_initial_noise_sees_no_ghost_of_another_patch():
    model = SensorModel.poisson_gaussian(1.0, 0.1, 500, 65535).with_mechanism("image_lag", fraction=0.4)
    clean = np.zeros((3, 16, 16, 4), np.float32)
    clean[1] = 0.5
    shot, read = np.full((3, 4), 1e-4, np.float32), np.full((3, 4), 1e-10, np.float32)
    noise, _ = model.n_init()(jax.random.key(0), jnp.asarray(clean), jnp.asarray(shot), jnp.asarray(read))
    np.testing.assert_allclose(np.asarray(noise).mean(axis=(1, 2, 3)), 0, atol=2e-3)


def test_a_sensor_without_colours():
    model = SensorModel.poisson_gaussian(2.0, 3.0, 100, 4095, "MONO")
    model = model.with_mechanism("green_imbalance", sigma=0.2).with_mechanism("row_noise", sigma_dn=4.0)
    clean = np.full((64, 96), 0.25, np.float32)
    frames = np.asarray(model.sample(KEY, clean, Settings(frames=8)), np.float64)
    sites = frames.mean(0).reshape(32, 2, 48, 2).mean((0, 2))
    np.testing.assert_allclose(sites, 100 + 0.25 * 3995, atol=2)  # no green to be out of balance
    packed = jnp.full((2, 16, 24, 4), 0.25)
    level = jnp.full((2, 4), 2.0 / 3995), jnp.full((2, 4), (6.0 / 3995) ** 2)
    noise, sigma = jax.jit(model.n_init())(KEY, packed, *level)
    assert noise.shape == sigma.shape == packed.shape
    assert float(jnp.std(noise)) == pytest.approx(float(jnp.mean(sigma)), rel=0.1)


def poisson_gaussian(**changes):
    known = {"gain_dn_per_e": 0.5, "read_noise_e": 3.0, "black_level": 64.0, "white_level": 1023.0}
    return SensorModel.poisson_gaussian(**{**known, **changes})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gain_dn_per_e": 0.0}, "gain_dn_per_e must be positive"),
        ({"gain_dn_per_e": float("nan")}, "gain_dn_per_e is nan, not a finite number"),
        ({"gain_dn_per_e": "high"}, "not a finite number"),
        ({"read_noise_e": -1.0}, "read_noise_e must be positive"),
        ({"read_noise_e": float("inf")}, "not a finite number"),
        ({"black_level": 2000.0}, "not above black_level"),
        ({"black_level": float("nan")}, "black_level is nan"),
        ({"white_level": 65536.0}, "above 65535"),
        ({"code_step": -1.0}, "code_step -1"),
        ({"iso": 0.0}, "iso must be above 0"),
        ({"cfa": "RGBW"}, "cfa is 'RGBW'"),
    ],
    ids=lambda v: str(v) if isinstance(v, dict) else "",
)
def test_a_baseline_that_no_camera_has_is_refused_in_one_line(change, message):
    with pytest.raises(ValueError, match=message) as caught:
        poisson_gaussian(**change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("id", "change", "message"),
    [
        ("row_noise", {"sigma_dn": -1.0}, "sigma_dn = -1 is outside 0 to"),
        ("row_noise", {"sigma_dn": float("nan")}, "sigma_dn is nan"),
        ("row_noise", {"sigma_dn": None}, "sigma_dn is None"),
        ("heavy_tails", {"tukey_lambda": -0.5}, "outside -0.45 to 0.3"),
        ("rts", {"fraction": 1.5}, "outside 1e-06 to 1"),
        ("row_noise", {"sigma_dn": IsoTable(np.array([400.0, 100.0]), np.ones(2))}, "ascend"),
        ("row_noise", {"sigma_dn": IsoTable(np.array([100.0]), np.array([-1.0]))}, "outside"),
        ("dark_current", {"scaling": Scaling(doubling_c=0.0)}, "doubling_c is 0, not above 0"),
        ("dsnu", {"maps": {"fild": np.zeros(SIZE, np.float32)}}, "maps are fild, it has field"),
        ("dsnu", {"maps": {"field": np.full(SIZE, np.nan, np.float32)}}, "not finite"),
        ("stripes", {"point": Point("readout", "signal", "moon", "redrawn")}, "grammar over is 'moon'"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_a_mechanism_outside_its_ranges_is_refused_in_one_line(id, change, message):
    with pytest.raises(ValueError, match=message) as caught:
        MODEL.with_mechanism(id, **change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("clean", "settings", "message"),
    [
        (FLAT, Settings(frames=0), "frames must be a whole number from 1"),
        (FLAT, Settings(frames=1.5), "frames must be a whole number from 1"),
        (FLAT, Settings(iso=0.0), "iso must be above 0"),
        (FLAT, Settings(exposure_s=-1.0), "exposure_s must be 0 or more"),
        (FLAT, Settings(temperature_c=float("nan")), "temperature_c is nan"),
        (FLAT, Settings(temperature_c=-300.0), "temperature_c must be"),
        (np.where(np.arange(32) == 3, np.nan, FLAT), Settings(), "clean holds values that are not finite"),
        (FLAT[None], Settings(), r"clean must be a mosaic \[H, W\]"),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_what_cannot_be_recorded_is_refused_in_one_line(clean, settings, message):
    with pytest.raises(ValueError, match=message) as caught:
        MODEL.sample(KEY, clean, settings)
    assert "\n" not in str(caught.value)


def test_settings_are_an_argument_of_jit_and_vmap():
    model, settings = MODEL.with_mechanism("dark_current", e_per_s=100.0), Settings(exposure_s=0.5, frames=2)
    eager = np.asarray(model.sample(KEY, FLAT, settings))
    traced = np.asarray(jax.jit(model.sample)(KEY, FLAT, settings))
    assert traced.shape == (2, *SIZE) and np.mean(traced != eager) < 1e-3  # fused arithmetic rounds otherwise
    times = np.array([0.0, 2.0, 4.0], np.float32)
    series = jax.vmap(lambda t: model.sample(KEY, FLAT, Settings(exposure_s=t, frames=2)))(times)
    along = Settings(iso=None, exposure_s=0, frames=2)
    given = Settings(iso=100.0, exposure_s=times, frames=2)
    again = jax.vmap(model.sample, in_axes=(None, None, along))(KEY, FLAT, given)
    np.testing.assert_array_equal(series, again)
    rise = np.diff(np.asarray(series, np.float64).mean((1, 2, 3)))
    np.testing.assert_allclose(rise, 0.5 * 100.0 * 2.0, rtol=0.05)  # K mu_I t


def test_a_model_may_be_composed_of_traced_numbers():
    @jax.jit
    def draw(gain, read, black, sigma):
        model = SensorModel.poisson_gaussian(gain, read, black, 1023.0, iso=(100, 200))
        return model.with_mechanism("row_noise", sigma_dn=sigma).sample(KEY, FLAT)

    gains = np.array([[0.5], [1.0]], np.float32)
    traced = np.asarray(draw(gains, 2 * gains, 64.0, 3.0), np.float64)
    model = SensorModel.poisson_gaussian(gains, 2 * gains, 64.0, 1023.0, iso=(100, 200))
    eager = np.asarray(model.with_mechanism("row_noise", sigma_dn=3.0).sample(KEY, FLAT), np.float64)
    assert np.mean(traced != eager) < 1e-2 and np.max(np.abs(traced - eager)) <= 1
