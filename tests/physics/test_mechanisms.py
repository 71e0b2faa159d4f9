"""One harness for every mechanism: it samples what a naive second implementation samples, its closed form
is what Monte Carlo finds, it survives jit and vmap, and its frozen patterns belong to the camera unit."""

import dataclasses
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from cannoise_jax.physics import chain
from cannoise_jax.physics.mechanism import STAGES
from cannoise_jax.physics.registry import MECHANISMS, estimator, mechanism
from cannoise_jax.physics.sensor import SensorModel, Settings
from cannoise_jax.physics.settings import context_of, resolve
from cannoise_jax.vocabulary import VOCABULARY, core_ids
from tests.physics import naive

SIZE = (8, 12)
FRAMES = 1500
SETTINGS = Settings(iso=100.0, exposure_s=0.5, frames=FRAMES)

# Strong enough to be seen in a small simulation, and no special case of anything weaker.
STRONG = {
    "gain_error": {"error": 0.4},
    "read_noise_error": {"error": 0.5},
    "dual_gain": {"iso_switch": 50.0, "gain_ratio": 1.3, "read_ratio": 0.5},
    "prnu": {"sigma": 0.1},
    "column_gain": {"sigma": 0.1},
    "green_imbalance": {"sigma": 0.05},
    "lens_shading": {"sigma": 0.3},
    "dead_pixels": {"fraction": 0.1},
    "defect_correction": {"fraction": 0.2},
    "hot_pixels": {"fraction": 0.1, "e_per_s": 100.0},
    "clock_induced_charge": {"charge_e": 5.0},
    "dsnu": {"sigma_dn": 3.0},
    "nonlinearity": {"loss": 0.2},
    "saturation": {"full_well_e": 420.0},
    "crosstalk": {"fraction": 0.3},
    "brighter_fatter": {"a00": 3e-4},
    "image_lag": {"fraction": 0.2},
    "smear": {"fraction": 0.1},
    "rts": {"jump_dn": 12.0, "fraction": 0.3},
    "cosmic_rays": {"rate": 40000.0, "charge_e": 60.0},
    "row_noise": {"sigma_dn": 3.0},
    "column_noise": {"sigma_dn": 3.0},
    "row_fpn": {"sigma_dn": 3.0},
    "column_fpn": {"sigma_dn": 3.0},
    "pink_noise": {"sigma_dn": 4.0, "exponent": 1.2},
    "row_pink_noise": {"sigma_dn": 4.0, "exponent": 0.8},
    "banding": {"amplitude_dn": 6.0, "frequency": 0.13},
    "offset_drift": {"sigma_dn": 3.0},
    "channel_offset": {"sigma_dn": 3.0},
    "amplifier_mismatch": {"step_dn": 5.0},
    "flicker": {"amplitude": 0.08, "frequency": 0.11},
    "illumination_drift": {"sigma": 0.05},
    "temperature_drift": {"sigma_k": 4.0, "e_per_s": 120.0, "memory_frames": 1.5},
    "reference_error": {"sigma_dn": 5.0, "blur": 0.2, "shift_y": 0.6, "shift_x": -0.8, "scale": 0.03},
    "misregistration": {"shift_px": 1.5, "angle": 0.7},
    "bookkeeping": {"black_dn": 4.0, "white_error": 0.1},
    "missing_codes": {"period": 4.0},
    "lossy_compression": {"step_dn": 30.0},
    "in_camera_denoising": {"weight": 0.4},
    "black_clipping": {"level_dn": 60.0},
    "dark_current": {"e_per_s": 60.0},
    "amp_glow": {"e_per_s": 200.0, "length": 0.4},
    "hot_pixel_suppression": {"weight": 0.7},
}
EACH = pytest.mark.parametrize("id", MECHANISMS)
# These move the scene with time, or are fixed within a recording and new in the next.
PER_RECORDING = ("reference_error",)


def scene(size=SIZE) -> np.ndarray:
    """A clean mosaic with slopes, a dark corner and differing colours."""
    y, x = np.indices(size)
    return (0.08 + 0.15 * x / size[1] + 0.05 * y / size[0] + 0.05 * ((y + x) % 2)).astype(np.float32)


def camera(id: str, **more) -> SensorModel:
    base = SensorModel.poisson_gaussian(
        0.5, 4.0, (60, 61, 62, 63), 1060, "GRBG", unit_key=jax.random.key(5), **more
    )
    return base.with_mechanism(id, **STRONG.get(id, {}))


def prepared(model: SensorModel, size=SIZE, settings=SETTINGS):
    context = context_of(model, jnp.asarray(scene(size))[None], settings)
    values = resolve(model, context)
    maps = [chain.maps_of(model, i, values[i], context) for i in range(len(model.mechanisms))]
    return context, values, maps


def numpy_context(context) -> dict:
    def wide(v):
        return np.asarray(v, np.float64)

    return {
        "gain": wide(context.gain_dn_per_e),
        "read": wide(context.read_noise_e),
        "black": wide(context.black_level),
        "white": wide(context.white_level),
        "mean": wide(context.mean_dn),
        "step": float(context.code_step),
        "exposure": float(context.exposure_s),
        "iso": float(context.iso),
    }


def key_of(id: str) -> jax.Array:
    return jax.random.key(zlib.crc32(id.encode()))


def frames_of(model: SensorModel, key, settings=SETTINGS, size=SIZE) -> np.ndarray:
    """Codes of the fast chain, run eagerly: compiling fifty chains would take minutes."""
    context, values, _ = prepared(model, size, settings)
    with_step = chain.run_chain(model, key, context, values, settings.frames)
    return np.asarray(chain.to_codes(model, key, *with_step, context, values), np.float64)


def summaries(y: np.ndarray) -> dict[str, np.ndarray]:
    """Independent numbers, one per frame or block of frames, that see means, rows, columns, lags and
    tails."""
    z = y - y.mean(axis=0)
    return {
        "pixel": y[:, 1, 3],
        "other pixel": y[:, 6, 8],
        "row": y[:, 2].mean(axis=1),
        "column": y[:, :, 5].mean(axis=1),
        "frame": y.mean(axis=(1, 2)),
        "power": (z**2).mean(axis=(1, 2)),
        "right": (z[:, :, :-1] * z[:, :, 1:]).mean(axis=(1, 2)),
        "down": (z[:, :-1] * z[:, 1:]).mean(axis=(1, 2)),
        "right 2": (z[:, :, :-2] * z[:, :, 2:]).mean(axis=(1, 2)),
        "later": (z[:-1:2] * z[1::2]).mean(axis=(1, 2)),
        "extreme": z.max(axis=(1, 2)),
    }


@EACH
def test_samples_like_a_naive_draw(id):
    model, record = camera(id), mechanism(id)
    frames = 6 if id in ("scene_motion", *PER_RECORDING) else FRAMES
    context, values, maps = prepared(model)
    c = numpy_context(context)
    p = {name: float(np.asarray(v).reshape(-1)[0]) for name, v in values[0].items()}
    m = {name: np.asarray(v, np.float64) for name, v in maps[0].items()}
    rng = np.random.default_rng(zlib.crc32(id.encode()))
    if frames == FRAMES:
        slow = naive.simulate(rng, record.acts_on, id, p, m, c, frames)
        fast = frames_of(model, key_of(id))
    else:  # what is fixed within a recording: many recordings of few frames, as one axis
        few = dataclasses.replace(SETTINGS, frames=frames)
        slow = np.concatenate(
            [naive.simulate(rng, record.acts_on, id, p, m, c, frames)[[1, 2, 5]] for _ in range(150)]
        )
        run = jax.jit(jax.vmap(lambda k: model.sample(k, jnp.asarray(scene()), few)))
        fast = np.asarray(run(jax.random.split(key_of(id), 150)), np.float64)[:, [1, 2, 5]]
        fast = fast.reshape(-1, *SIZE)
    for name, ours in summaries(fast).items():
        theirs = summaries(slow)[name]
        if id == "temperature_drift" or id in PER_RECORDING:  # frames depend on each other: thin them out
            ours, theirs = ours[::12], theirs[::12]
        assert stats.ks_2samp(ours, theirs).pvalue > 1e-5, name
    if frames == FRAMES and id != "temperature_drift":
        error = np.sqrt((fast.var(axis=0) + slow.var(axis=0)) / frames)
        gap = (fast.mean(axis=0) - slow.mean(axis=0)) / np.maximum(error, 1e-3)
        assert np.abs(gap).max() < 5.5


def analogue(model: SensorModel, key, frames: int) -> np.ndarray:
    """The chain without rounding; what acts on codes acts on the unrounded values."""
    context, values, maps = prepared(model)
    y, _ = chain.run_chain(model, key, context, values, frames)
    for i, fitted in enumerate(model.mechanisms):
        if fitted.record.acts_on == "code":
            y = fitted.record.sample(key, y, values[i], maps[i], context)
    return np.asarray(y, np.float64)


# The clamp's holds on an even light, and has a test of its own.
WITH_EFFECT = [id for id, m in MECHANISMS.items() if m.effect is not None and id != "hot_pixel_suppression"]


@pytest.mark.parametrize("id", WITH_EFFECT)
def test_closed_form_is_what_monte_carlo_finds(id):
    model, record = camera(id), mechanism(id)
    context, values, maps = prepared(model)
    effect = record.effect(values[0], maps[0], context)
    if id in PER_RECORDING:
        run = jax.jit(jax.vmap(lambda k: chain.run_chain(model, k, context, values, 2)[0]))
        pairs = np.asarray(run(jax.random.split(key_of(id), FRAMES)), np.float64)
        y, later = pairs[:, 0], pairs
    else:
        y = analogue(model, key_of(id), FRAMES)
        later = None
    if id == "missing_codes":
        y = frames_of(model, key_of(id))
    base = np.asarray(context.black_level + context.mean_dn)[0]
    own = np.broadcast_to(np.asarray(context.own_variance())[0], SIZE)

    def wide(v):
        return np.broadcast_to(np.asarray(0.0 if v is None else v, np.float64), (1, *SIZE))[0]

    variance = own + wide(effect.variance)
    assert (variance > -1e-6).all()
    n = len(y)
    z = y - (base + wide(effect.mean))
    # Frames that remember each other count for fewer.
    memory = 1 + 2 * sum(float(np.max(np.abs(wide(v) / variance))) for v in (effect.temporal or {}).values())
    if id in PER_RECORDING:
        memory = 1.0
    sparse = id in ("cosmic_rays", "brighter_fatter", "lossy_compression", "missing_codes")
    error = np.sqrt(np.maximum(z.var(axis=0), 1e-6) / n * memory)
    slack = 0.05 if sparse else 1e-4 * base
    assert (np.abs(z.mean(axis=0)) < 5.5 * error + slack).all(), "mean"

    # Sums of squares over frames, with their own scatter as the yardstick.
    def close(products, expected, what, tolerance=0.0):
        per_frame = products.reshape(n if len(products) == n else len(products), -1).mean(axis=1)
        blocks = per_frame[: len(per_frame) // 30 * 30].reshape(30, -1).mean(axis=1)
        error = blocks.std(ddof=1) / np.sqrt(30)
        gap = abs(blocks.mean() - float(np.mean(expected)))
        assert gap < 5 * error + tolerance, f"{what}: {blocks.mean():.4f} against {np.mean(expected):.4f}"

    first_order = (
        0.03 if id in ("brighter_fatter", "excess_noise", "lossy_compression", "cosmic_rays") else 0.003
    )
    if id != "missing_codes":
        # At the edge a pixel stands in for its missing neighbour: the closed form holds inside.
        own_neighbour = id in ("in_camera_denoising", "demosaicing", "crosstalk", "brighter_fatter")
        place = (slice(2, -2), slice(2, -2)) if own_neighbour else (slice(None), slice(None))
        inner = z[:, place[0], place[1]]
        close(inner**2, variance[place], "variance", first_order * float(np.mean(variance)))
        for half in (slice(0, inner.shape[1] // 2), slice(inner.shape[1] // 2, None)):
            expected = variance[place][half]
            close(inner[:, half] ** 2, expected, "variance by place", first_order * float(np.mean(variance)))
    shared = {"row": (z[:, :, 3] * z[:, :, 8], wide(effect.row), (3, 8)),
              "column": (z[:, 1] * z[:, 6], wide(effect.column).T, (1, 6)),
              "frame": (z[:, 1, 3] * z[:, 6, 8], None, None)}  # fmt: skip
    lags = effect.lags or {}
    tolerance = first_order * float(np.mean(variance))
    if not lags and effect.frame is None:
        for name in ("row", "column"):
            product, power, (a, b) = shared[name]
            close(product, np.sqrt(np.maximum(power[:, a] * power[:, b], 0)), name, tolerance)
    if effect.frame is not None:
        power = wide(effect.frame)
        close(shared["frame"][0], np.sqrt(power[1, 3] * power[6, 8]), "frame", tolerance)
    for (dy, dx), expected in lags.items():
        ahead = z[:, dy:, dx:] if dy + dx else z
        product = z[:, : SIZE[0] - dy, : SIZE[1] - dx] * ahead
        inside = slice(2, -3)  # away from the edges, where a neighbour stands in for a missing one
        keep = product[:, : SIZE[0] - dy, : SIZE[1] - dx]
        want = wide(expected)[: SIZE[0] - dy, : SIZE[1] - dx]
        if id in ("in_camera_denoising", "demosaicing", "crosstalk", "brighter_fatter"):
            rows = slice(2, max(SIZE[0] - dy - 2, 3)) if dy < 4 else slice(2, 3)
            if dy >= 4:
                continue  # the frame is too small for an interior at this lag
            keep, want = keep[:, rows, inside], want[rows, inside]
        close(keep, want, f"lag {dy}, {dx}", tolerance)
    for step, expected in (effect.temporal or {}).items():
        if later is not None:
            if step == 1:
                w = later - (base + wide(effect.mean))
                close(w[:, 0] * w[:, 1], wide(expected), "temporal", tolerance)
        else:
            close(z[:-step] * z[step:], wide(expected), f"temporal {step}", tolerance)
    centred = y - y.mean(axis=0)
    if effect.third is not None:
        third = np.asarray(context.gain_dn_per_e**2 * context.mean_dn)[0] + wide(effect.third)
        close(centred**3, third, "third cumulant", 0.02 * float(np.mean(np.abs(third))))
    if effect.fourth is not None and np.isfinite(np.asarray(effect.fourth)).all():
        fourth = np.asarray(context.gain_dn_per_e**3 * context.mean_dn)[0] + wide(effect.fourth)
        close(centred**4 - 3 * variance**2, fourth, "fourth cumulant", 0.05 * float(np.mean(variance**2)))


def test_clamped_peaks_have_the_moments_of_the_closed_form():
    record, weight = mechanism("hot_pixel_suppression"), 0.7
    base = SensorModel.poisson_gaussian(1.0, 6.0, 60, 1060, "MONO")
    context = context_of(base, jnp.zeros((1, 64, 64)), SETTINGS)
    noise = 6.0 * np.random.default_rng(2).normal(size=(60, 64, 64)).astype(np.float32)
    y = np.asarray(record.sample(None, jnp.asarray(noise), {"weight": weight}, {}, context))[:, 2:-2, 2:-2]
    effect = record.effect({"weight": weight}, {}, context)
    assert y.mean() == pytest.approx(float(np.mean(effect.mean)), abs=0.04)
    assert y.var() == pytest.approx(36 + float(np.mean(effect.variance)), rel=0.01)


@EACH
def test_record_is_complete(id):
    record, term = mechanism(id), VOCABULARY[id]
    assert record.stage in STAGES and record.acts_on in ("mean", "charge", "signal", "code")
    assert (record.sample is None) != (record.baseline is None), "a mechanism acts in one way"
    assert record.sentence.endswith(".") and record.equation and record.reference and record.needs
    assert record.confused_with and id not in record.confused_with
    assert all(id in mechanism(other).confused_with for other in record.confused_with), "confusion is mutual"
    assert len(set(record.confused_with)) == len(record.confused_with)
    # A moving scene changes the mean by another amount in every frame: there is no one effect to state.
    assert record.effect is not None or id == "scene_motion"
    assert term.core or record.score is not None
    for p in record.parameters:
        assert p.low <= p.default <= p.high and p.unit and p.definition
    if record.scales is not None:
        assert record.scales in record.defaults()
    context, values, _ = prepared(camera(id))
    assert np.isfinite(float(np.mean(record.amplitude(values[0], context))))


def test_every_sensor_and_capture_id_has_a_mechanism():
    assert set(MECHANISMS) == set(VOCABULARY) - {"unknown"}
    assert set(core_ids()) <= set(MECHANISMS)
    with pytest.raises(ValueError, match="gremlins"):
        mechanism("gremlins")


def test_estimators_are_found_by_id():
    assert callable(estimator("row_noise"))
    assert estimator("gremlins") is None


FROZEN = [id for id, m in MECHANISMS.items() if m.draw_maps is not None]
# Their pattern follows from the colour pattern or the geometry, the same in every unit.
FIXED = ("green_imbalance", "lens_shading", "amplifier_mismatch")


@pytest.mark.parametrize("id", FROZEN)
def test_frozen_patterns_belong_to_the_unit(id):
    size = (32, 48)
    model = camera(id)
    _, _, (first,) = prepared(model, size)
    _, _, (again,) = prepared(dataclasses.replace(model, code_step=np.float32(2)), size)
    _, _, (other,) = prepared(model.with_unit(jax.random.key(6)), size)
    kept = model.with_maps(size).mechanisms[0].maps
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])
        np.testing.assert_allclose(np.asarray(kept[name]), np.asarray(first[name]), rtol=1e-6)
        if id not in FIXED:
            assert not np.array_equal(first[name], other[name])
    assert model.with_maps(size).with_unit(jax.random.key(6)).mechanisms[0].maps == {}


SMOOTH = {
    "prnu": "sigma", "dsnu": "sigma_dn", "row_noise": "sigma_dn", "pink_noise": "exponent",
    "banding": "frequency", "crosstalk": "fraction", "nonlinearity": "loss", "bookkeeping": "black_dn",
    "heavy_tails": "tukey_lambda", "read_noise_error": "error", "in_camera_denoising": "weight",
    "misregistration": "shift_px", "illumination_drift": "sigma", "brighter_fatter": "a00",
}  # fmt: skip


@EACH
def test_every_mechanism_is_traced_with_nothing_known_but_sizes(id):
    """Under jit and vmap keys, scenes, parameters, maps and settings are all unknown numbers."""
    few = dataclasses.replace(SETTINGS, frames=2)

    def sample(key, clean, model, exposure_s):
        return model.sample(key, clean, dataclasses.replace(few, exposure_s=exposure_s))

    keys = jax.random.split(key_of(id), 3)
    batched = jax.vmap(sample, in_axes=(0, None, None, None))
    traced = jax.eval_shape(batched, keys, jnp.asarray(scene()), camera(id), jnp.float32(0.5))
    assert traced.shape == (3, 2, *SIZE) and traced.dtype == jnp.uint16


@pytest.mark.parametrize("id", ["prnu", "in_camera_denoising"])
def test_jit_and_vmap_give_the_eager_frames(id):
    model, few = camera(id), dataclasses.replace(SETTINGS, frames=2)
    keys = jax.random.split(key_of(id), 3)
    batched = jax.jit(jax.vmap(lambda k: model.sample(k, jnp.asarray(scene()), few)))(keys)
    assert batched.shape == (3, 2, *SIZE) and batched.dtype == jnp.uint16
    eager = frames_of(model, keys[1], few)
    # Fused arithmetic may round a value on the other side of a half.
    assert np.mean(np.abs(eager - np.asarray(batched[1], np.float64)) > 0) < 0.02
    assert not np.array_equal(batched[0], batched[1])


@pytest.mark.parametrize(("id", "name"), SMOOTH.items())
def test_gradients_are_finite_differences(id, name):
    model = camera(id)
    context, _, _ = prepared(model)
    fitted = model.mechanisms[0]
    weight = jnp.asarray(np.random.default_rng(0).normal(size=(2, *SIZE)), jnp.float32)

    def value(v):
        changed = dataclasses.replace(
            model, mechanisms=(dataclasses.replace(fitted, parameters={**fitted.parameters, name: v}),)
        )
        values = resolve(changed, context)
        y = chain.run_chain(changed, jax.random.key(1), context, values, 2)[0]
        if fitted.record.acts_on == "code":
            y = fitted.record.sample(jax.random.key(1), y, values[0], {}, context)
        return jnp.sum(weight * (y - 200.0))

    at = float(fitted.parameters[name])
    if fitted.record.acts_on == "mean":  # counts are whole numbers: the expected charge is what is smooth

        def value(v):
            values = {**resolve(model, context)[0], name: v}
            maps = chain.maps_of(model, 0, values, context)
            x = jnp.broadcast_to(context.mean_dn, (2, *SIZE))
            return jnp.sum(weight * fitted.record.sample(jax.random.key(1), x, values, maps, context))

    slope = float(jax.grad(value)(jnp.float32(at)))
    h = 0.01 * abs(at)
    difference = (float(value(jnp.float32(at + h))) - float(value(jnp.float32(at - h)))) / (2 * h)
    assert slope != 0 and slope == pytest.approx(difference, rel=0.05)


SCORED = [id for id, m in MECHANISMS.items() if m.score is not None]


@pytest.mark.parametrize("id", SCORED)
def test_score_is_standard_normal_without_the_mechanism(id):
    size, record, draws = (32, 48), mechanism(id), 64
    context, values, maps = prepared(camera(id), size)
    z = np.random.default_rng(11).normal(size=(draws, 4, *size))
    score = jax.vmap(lambda z: record.score(z, values[0], maps[0], context))
    scores = np.asarray(score(jnp.asarray(z, jnp.float32)))
    assert abs(scores.mean()) < 4.5 / np.sqrt(draws)
    assert 0.75 < scores.std() < 1.3


@pytest.mark.parametrize("id", SCORED)
def test_score_sees_the_mechanism(id):
    # Peaks are few, and a third of the pixels of a colour either way stand for them.
    size = (128, 192) if id == "hot_pixel_suppression" else (32, 48)
    model, record = camera(id), mechanism(id)
    # Effects on the noise of a flat; photons are few enough to be skewed in a dark one.
    clean = scene(size)
    if id in ("brighter_fatter", "hot_pixel_suppression"):
        clean = np.full(size, 0.2, np.float32)
    if id == "poisson_skew":
        clean, model = (
            np.full(size, 0.01, np.float32),
            camera(id).without(id).with_mechanism(id, strength=1.0),
        )
    context = context_of(model, jnp.asarray(clean)[None], SETTINGS)
    values = resolve(model, context)
    maps = chain.maps_of(model, 0, values[0], context)
    y, step = chain.run_chain(model, key_of(id), context, values, 8)
    y = np.asarray(chain.to_codes(model, key_of(id), y, step, context, values), np.float64)
    sigma = np.sqrt(np.asarray(context.own_variance()) + 1 / 12)
    z = (y - np.asarray(context.black_level + context.mean_dn)) / sigma
    assert float(record.score(jnp.asarray(z, jnp.float32), values[0], maps, context)) > 3.5


def test_equations_can_be_set():
    from matplotlib.mathtext import MathTextParser

    parser = MathTextParser("agg")
    for record in MECHANISMS.values():
        parser.parse(f"${record.equation}$")
