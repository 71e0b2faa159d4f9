"""One harness for every mechanism: it samples what a naive second implementation samples, it survives jit and
vmap, and its frozen patterns belong to the camera unit."""

import dataclasses
import zlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from cannoise_jax.mechanisms import ENTRIES, MECHANISMS, VOCABULARY, curves
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import STAGES, Scaling
from cannoise_jax.physics.core.registry import mechanism
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import resolve
from tests.physics import naive
from tests.physics.harness import (
    EACH,
    FRAMES,
    PER_RECORDING,
    SETTINGS,
    SIZE,
    camera,
    frames_of,
    key_of,
    numpy_context,
    prepared,
    scene,
    summaries,
)


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


@EACH
def test_record_is_complete(id):
    entry = MECHANISMS[id]
    record, examples = entry.record, entry.examples
    assert record.stage in STAGES and record.acts_on in ("mean", "charge", "signal", "code")
    assert (record.sample is None) != (record.baseline is None), "a mechanism acts in one way"
    assert record.sentence.endswith(".") and record.equation and record.reference and record.needs
    assert record.confused_with and id not in record.confused_with
    assert all(id in mechanism(other).confused_with for other in record.confused_with), "confusion is mutual"
    assert len(set(record.confused_with)) == len(record.confused_with)
    # A moving scene changes the mean by another amount in every frame: there is no one effect to state.
    assert record.effect is not None or id == "scene_motion"
    assert entry.needs and examples.curve in curves.KINDS
    for values in (examples.shown, examples.strong, *(case.truth for case in examples.cases)):
        assert set(values) <= set(record.defaults())
    for p in record.parameters:
        assert p.low <= p.default <= p.high and p.unit and p.definition
    if record.scales is not None:
        assert record.scales in record.defaults()
    context, values, _ = prepared(camera(id))
    assert np.isfinite(float(np.mean(record.amplitude(values[0], context))))


def test_every_name_has_a_mechanism_and_every_mechanism_one_name():
    assert set(MECHANISMS) == set(VOCABULARY) - {"unknown"} and len(MECHANISMS) == len(ENTRIES)
    with pytest.raises(ValueError, match="gremlins"):
        mechanism("gremlins")
    first, second, *_ = ENTRIES
    with pytest.raises(ValueError, match="give both one name"):
        Entry(first.term, second.record, needs="darks")


@pytest.mark.parametrize("law", [Scaling(gain=1.0), Scaling(exposure=1.0), Scaling(doubling_c=7.0)])
def test_a_law_that_would_do_nothing_is_refused(law):
    bare = dataclasses.replace(mechanism("row_noise"), scales=None, scaling=Scaling())
    with pytest.raises(ValueError, match="row_noise: .* name in `scales` the parameter"):
        dataclasses.replace(bare, scaling=law)


FROZEN = [e.id for e in ENTRIES if e.record.draw_maps is not None]
# Their pattern follows from the colour pattern or the geometry, the same in every unit.
FIXED = ("green_imbalance", "lens_shading", "amplifier_mismatch")
# All pixels are alike where nothing is said of them.
VARIED = dict.fromkeys(("dark_current", "compensated_dark_current"), {"variation": 0.4})


@pytest.mark.parametrize("id", FROZEN)
def test_frozen_patterns_belong_to_the_unit(id):
    size = (32, 48)
    model = camera(id)
    if id in VARIED:
        fitted = model.mechanisms[0]
        model = model.without(id).with_mechanism(id, **{**fitted.parameters, **VARIED[id]})
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


def test_a_wrong_description_is_laid_over_all_that_is_analogue():
    """What has saturated, or was cut off at black, is at one code."""
    base = SensorModel.poisson_gaussian(1.0, 3.0, 100, 1023, "MONO").with_mechanism(
        "bookkeeping", black_dn=6.0, white_error=-0.1
    )
    stripes = Point("readout", "signal", "row", "redrawn")
    model = base.with_mechanism("row_noise", sigma_dn=5.0).with_mechanism("black_clipping", level_dn=-2.0)
    model = model.with_mechanism("stripes", point=stripes, sigma_dn=5.0)
    order = [f.mechanism for f in model.mechanisms]
    assert order == ["row_noise", "stripes", "black_clipping", "bookkeeping"]
    clean = np.zeros(SIZE, np.float32)
    clean[4:] = 1.3
    codes = np.asarray(model.sample(jax.random.key(0), clean, Settings(frames=40)))
    low, high = np.round(106 - 0.9 * 2), np.round(106 + 0.9 * 923)
    assert codes[:, :4].min() == low and 0.2 < np.mean(codes[:, :4] == low) < 0.6
    assert np.unique(codes[:, 4:]) == high


def test_equations_can_be_set():
    from matplotlib.mathtext import MathTextParser

    parser = MathTextParser("agg")
    for entry in ENTRIES:
        parser.parse(f"${entry.record.equation}$")


def _spread_factors(rng, p, size):
    """Log-normal read noise of which the mean square is kept and the std over mean is the spread."""
    width = np.sqrt(np.log1p(p["spread"] ** 2))
    factors = rng.lognormal(0.0, width, size)
    return factors / np.sqrt(np.exp(2 * width**2))


MAPS = {
    "prnu": ("field", lambda rng, p, size: rng.normal(size=size)),
    "dsnu": ("field", lambda rng, p, size: rng.normal(size=size)),
    "column_gain": ("field", lambda rng, p, size: rng.normal(size=(1, size[1]))),
    "row_fpn": ("field", lambda rng, p, size: rng.normal(size=(size[0], 1))),
    "dead_pixels": ("dead", lambda rng, p, size: rng.binomial(1, p["fraction"], size)),
    "hot_pixels": (
        "heat",
        lambda rng, p, size: rng.binomial(1, p["fraction"], size) * -np.log(1 - rng.random(size)),
    ),
    "pixel_read_noise_map": ("factor", _spread_factors),
    "row_read_noise_map": ("factor", lambda rng, p, size: _spread_factors(rng, p, (size[0], 1))),
    "column_read_noise_map": ("factor", lambda rng, p, size: _spread_factors(rng, p, (1, size[1]))),
}


@pytest.mark.parametrize("id", MAPS)
def test_frozen_maps_are_distributed_like_a_naive_draw(id):
    """The naive frames are given the maps of the fast code: here the maps themselves are drawn twice."""
    size, (name, draw) = (256, 256), MAPS[id]
    _, (values,), (maps,) = prepared(camera(id), size)
    p = {n: float(np.mean(v)) for n, v in values.items()}
    ours = np.asarray(maps[name], np.float64)[0]
    theirs = draw(np.random.default_rng(zlib.crc32(id.encode())), p, size)
    assert ours.shape == theirs.shape
    assert abs(np.mean(ours == 0) - np.mean(theirs == 0)) < 0.01
    assert stats.ks_2samp(ours[ours != 0], theirs[theirs != 0]).pvalue > 1e-3
