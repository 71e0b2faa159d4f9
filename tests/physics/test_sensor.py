"""The sensor model: its baseline is the textbook's, it interpolates and warns, and it works inside other
JAX code."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.core.settings import context_of
from cannoise_jax.physics.initial_noise import initial_noise, sensors_of
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


def test_a_mechanism_that_the_model_has_is_added_again_only_where_asked():
    once = MODEL.with_mechanism("row_noise", sigma_dn=3.0)
    with pytest.raises(ValueError, match=r"row_noise: the model has it: .*without\('row_noise'\)") as caught:
        once.with_mechanism("row_noise", sigma_dn=4.0)
    assert "\n" not in str(caught.value)
    other = once.without("row_noise").with_mechanism("row_noise", sigma_dn=4.0)
    assert [f.parameters["sigma_dn"] for f in other.mechanisms] == [4.0]
    both = once.with_mechanism("row_noise", sigma_dn=4.0, again=True)
    means = np.asarray(both.sample(KEY, FLAT, Settings(frames=64)), np.float64).mean(2)
    spread = (means - means.mean(0)).std()
    assert abs(spread / 5.0 - 1) < 0.1, "independent: variances add"


def test_with_and_without():
    model = MODEL.with_mechanism("in_camera_denoising").with_mechanism("row_noise", sigma_dn=1.0)
    assert [f.mechanism for f in model.mechanisms] == ["row_noise", "in_camera_denoising"], "chain order"
    assert [f.mechanism for f in model.without("row_noise").mechanisms] == ["in_camera_denoising"]
    with pytest.raises(ValueError, match="no parameter volume"):
        MODEL.with_mechanism("row_noise", volume=11)
    with pytest.raises(ValueError, match="gremlins"):
        MODEL.with_mechanism("gremlins")


def test_under_a_steady_light_the_camera_is_left_alone():
    camera = SensorModel.poisson_gaussian(0.5, 3.0, 64.0, 4095.0, "MONO").with_mechanism("prnu", sigma=0.02)
    seen = camera.with_mechanism("flicker", amplitude=0.2, frequency=0.05)
    seen = seen.with_mechanism("illumination_drift", sigma=0.05)
    flat = np.full((64, 64), 0.5, np.float32)
    settings = Settings(frames=4)
    frames = np.asarray(seen.under_steady_light().sample(jax.random.key(1), flat, settings))
    np.testing.assert_array_equal(frames, camera.sample(jax.random.key(1), flat, settings))
    assert not np.array_equal(frames, seen.sample(jax.random.key(1), flat, settings))


@pytest.mark.parametrize("step", [1.0, 4.0, 16.0])
def test_codes_lie_on_the_lattice_within_the_rails(step):
    model = dataclasses.replace(MODEL, code_step=np.float32(step))
    y = np.asarray(
        model.sample(KEY, np.linspace(0, 1.4, 1024, dtype=np.float32).reshape(SIZE), Settings(frames=20))
    )
    assert np.all(y % step == 0) and y.max() == 1084 // step * step
    low = dataclasses.replace(model, black_level=np.zeros(4, np.float32))
    assert np.asarray(low.sample(KEY, FLAT * 0, Settings(frames=20))).min() == 0


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
    one, two = (jax.jit(sensors_of(name)[0].n_init())(KEY, clean, shot, read) for name in names)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
    with pytest.raises(BadInput, match="no such preset"):
        sensors_of("preset:gremlin")


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
    noise, _ = jax.jit(model.n_init())(jax.random.key(0), clean, shot, read)
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


def test_more_frames_than_memory_holds_are_refused():
    """XLA ends the interpreter where there is no room, which nothing can catch."""
    with pytest.raises(
        ValueError, match=r"1000000000 frames of 32 x 32 take .* GB .* free: draw them in parts"
    ):
        MODEL.sample(KEY, FLAT, Settings(frames=10**9))
