"""Sampling: any shape, jit, vmap, grad; no seams; what is refused."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks import Encoder, Generator
from cannoise_jax.physics.initial_noise import poisson_gaussian
from cannoise_jax.sampling import Model, make_model, sample_noise
from tests.small_model import NLF, READ, SHOT, WIDTH, drawn, noisy, scene, small_model

sample = jax.jit(sample_noise)


@pytest.fixture(scope="module")
def model() -> Model:
    return small_model()


def loudness(model, nlf=NLF):
    """Standard deviation of the noise at a level that is told. At the start of a model the references say
    nothing else: one serves, of the size that other tests have compiled for."""
    noise = sample(model, jax.random.key(1), scene(32, 32), noisy(jax.random.key(2)), nlf)
    return float(jnp.std(noise))


def at_its_start(model):
    params = model.generator["params"]
    out, physics = (jax.tree.map(jnp.zeros_like, p) for p in (params["pixels"]["out"], params["physics"]))
    start = params | {"pixels": params["pixels"] | {"out": out}, "physics": physics}
    return model.replace(generator={"params": start})


def test_at_its_zero_start_the_noise_is_the_initial_noise(model):
    model = at_its_start(model)
    clean = jnp.full((2, 96, 96, 4), 0.2)
    noise = jax.jit(sample_noise)(model, jax.random.key(1), clean, noisy(jax.random.key(2)), NLF)
    assert noise.dtype == jnp.float32 and noise.shape == clean.shape
    n = noise.size
    expected = SHOT * 0.2 + READ
    assert abs(float(jnp.var(noise)) / expected - 1) < 5 * (2 / n) ** 0.5
    assert abs(float(jnp.mean(noise))) < 5 * (expected / n) ** 0.5


@pytest.mark.parametrize(
    "size",
    [
        pytest.param((16, 16), marks=pytest.mark.slow),
        (17, 31),
        pytest.param((100, 34), marks=pytest.mark.slow),
    ],
)
def test_any_size_leading_axes_and_type(model, size):
    clean = scene(*size)
    reference = noisy(jax.random.key(2))[:32, :32] if size == (16, 16) else noisy(jax.random.key(2), 17, 23)
    noise = sample(model, jax.random.key(1), clean, reference, NLF)
    assert noise.shape == clean.shape and bool(jnp.all(jnp.isfinite(noise)))
    if size == (16, 16):
        half = sample(model, jax.random.key(1), np.asarray(clean, np.float64), reference, NLF)
        np.testing.assert_array_equal(noise, half)
        whole = jnp.broadcast_to(clean, (2, 1, *clean.shape))
        assert sample(model, jax.random.key(1), whole, reference[None, None], NLF).shape == whole.shape


@jax.jit
def slope_at(model, key, clean, reference):
    """Slopes of the noise's power along the clean image and along the reference."""

    def energy(clean, reference):
        return jnp.mean(jnp.square(sample_noise(model, key, clean, reference)))

    return jax.grad(energy, (0, 1))(clean, reference)


def test_images_in_dn_are_not_numbers_under_jit(model):
    """Nothing can be refused there; numbers that look like noise would be worse."""
    key, clean, reference = jax.random.key(1), scene(32, 32), noisy(jax.random.key(2))
    right = sample(model, key, clean, reference, NLF)
    assert bool(jnp.isfinite(right).all())
    assert jnp.allclose(right, sample_noise(model, key, clean, reference, NLF), atol=1e-5)
    assert bool(jnp.isnan(sample(model, key, 4000 * clean, reference, NLF)).all())
    assert bool(jnp.isnan(sample(model, key, clean, 4000 * reference, NLF)).all())
    glint = clean.at[:8].set(50.0)  # beyond the white level, as of a scene
    assert bool(jnp.isfinite(sample(model, key, glint, reference, NLF)).all())


def test_jit_vmap_and_grad(model):
    clean, reference = jnp.stack([scene(32, 32)] * 2), noisy(jax.random.key(2))
    keys = jax.random.split(jax.random.key(1), 2)
    each = jax.jit(jax.vmap(sample_noise, (None, 0, 0, None, None)))
    noise = each(model, keys, clean, reference, NLF)
    for i in range(2):
        np.testing.assert_allclose(noise[i], sample(model, keys[i], clean[i], reference, NLF), atol=1e-5)
    assert float(jnp.std(noise[0] - noise[1])) > 0

    slope = slope_at(model, keys[0], scene(16, 16), jnp.full((16, 16, 4), 0.1))[0]
    assert bool(jnp.all(jnp.isfinite(slope))) and float(jnp.max(jnp.abs(slope))) > 0


@pytest.mark.parametrize(
    "size", [pytest.param((3, 40), marks=pytest.mark.slow), pytest.param((1, 1), marks=pytest.mark.slow)]
)
def test_a_reference_of_any_size(model, size):
    small = noisy(jax.random.key(2))[: size[0], : size[1]]
    noise = sample(model, jax.random.key(1), scene(16, 16), small)
    assert bool(jnp.all(jnp.isfinite(noise)))
    tiled = jnp.tile(small, (16, 16, 1))[: max(16, size[0]), : max(16, size[1])]
    # Two programs, which round differently.
    same = sample(model, jax.random.key(1), scene(16, 16), tiled)
    np.testing.assert_allclose(noise, same, rtol=0, atol=1e-7)


def test_small_references_tell_the_noise_level(model):
    model = at_its_start(model)
    patches = jnp.stack([noisy(k)[:8, :8] for k in jax.random.split(jax.random.key(7), 64)])
    estimated = sample(model, jax.random.key(1), scene(32, 32), patches)
    assert 0.85 < float(jnp.std(estimated)) / loudness(model) < 1.15


@pytest.mark.parametrize("level", [0.0, 0.1, 1.0])
def test_the_slope_at_a_reference_without_noise_is_finite(model, level):
    slope = slope_at(model, jax.random.key(1), scene(16, 16), jnp.full((16, 16, 4), level))[1]
    assert bool(jnp.all(jnp.isfinite(slope)))


def test_a_negative_shot_counts_as_zero(model):
    clean, reference = scene(32, 32), noisy(jax.random.key(2))
    negative, zero = (sample(model, jax.random.key(1), clean, reference, (s, READ)) for s in (-1e-3, 0.0))
    assert bool(jnp.all(jnp.isfinite(negative)))
    np.testing.assert_array_equal(negative, zero)


def test_the_key_alone_decides(model):
    clean, reference = scene(32, 32), noisy(jax.random.key(2))
    first, again, other = (sample(model, jax.random.key(k), clean, reference, NLF) for k in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_latents_of_several_references_are_averaged(model):
    one, two = noisy(jax.random.key(2)), 3 * noisy(jax.random.key(3))
    encode = jax.jit(lambda x: model.encoder_module.apply(model.encoder, x, train=False))
    a, b = encode(one[None])[0], encode(two[None])[0]
    wanted = (a + b) / jnp.linalg.norm(a + b)
    clean = scene(32, 32)
    both = sample(model, jax.random.key(1), clean, jnp.stack([one, two, one, two]))
    swapped = sample(model, jax.random.key(1), clean, jnp.stack([two, two, one, one]))
    np.testing.assert_allclose(both, swapped, atol=1e-6)

    from cannoise_jax import sampling

    latent = jax.jit(sampling._latent)(model, jnp.stack([one, two]))[0]
    np.testing.assert_allclose(latent, wanted, atol=1e-5)


@pytest.mark.slow
def test_no_seam_in_row_and_column_means(model):
    """Means over many draws of a flat scene are as flat at the border and at every cell as inside."""
    clean = jnp.full((30, 62, 4), 0.1)
    reference = noisy(jax.random.key(2))[:32, :32]
    keys = jax.random.split(jax.random.key(5), 200)
    draw = jax.jit(lambda k: sample_noise(model, k, clean, reference, NLF))
    draws = np.stack([np.asarray(draw(k)) for k in keys])
    for axis in (1, 2):
        means = draws.mean(axis=2 if axis == 1 else 1)  # draw, position, channel
        mean, spread = means.mean(0), means.std(0, ddof=1)
        error = spread / np.sqrt(len(keys))
        inside = slice(8, -8)
        z = (mean - mean[inside].mean(0)) / error
        assert np.abs(z).max() < 4.8, (axis, np.abs(z).max())
        assert np.all(np.abs(spread / spread[inside].mean(0) - 1) < 0.3)


@pytest.mark.slow
def test_the_papers_networks_see_an_image_as_in_training():
    """Their norms reach over the whole image: what they give is what they give on a patch of that size."""
    generator, encoder = Generator(WIDTH, literal=True), Encoder(WIDTH, literal=True)
    images, latent, key = jnp.ones((2, 64, 64, 4)), jnp.ones((2, 8)), jax.random.key(0)
    g = jax.eval_shape(lambda: generator.init(key, images, images, latent, images, train=False))
    e = jax.eval_shape(lambda: encoder.init(key, images, train=False))
    own = make_model(generator, drawn(g, 0.12), encoder, drawn(e, 0.15), level="given")
    clean, reference = jnp.stack([scene(64, 64)] * 2), noisy(jax.random.key(2))
    made = sample(own, jax.random.key(1), clean, reference, NLF)
    level = [jnp.full((2, 4), v) for v in NLF]
    n_init, sigma = poisson_gaussian(jax.random.split(jax.random.key(1))[0], clean, *level)

    def networks(clean, n_init, reference, sigma):
        latent = jnp.repeat(encoder.apply(own.encoder, reference[None], train=False), 2, 0)
        return generator.apply(own.generator, clean, n_init, latent, sigma, train=False)

    wanted = jax.jit(networks)(clean, n_init, reference, sigma)
    np.testing.assert_allclose(made, wanted, atol=1e-5)


def test_the_noise_level_function_is_the_references_without_nlf(model):
    model = at_its_start(model)
    reference = jnp.stack([noisy(k) for k in jax.random.split(jax.random.key(7), 4)])
    clean = scene(32, 32)
    estimated = sample(model, jax.random.key(1), clean, reference)
    assert 0.93 < float(jnp.std(estimated)) / loudness(model) < 1.07
    assert loudness(model, nlf=(jnp.full(4, 4 * SHOT), 4 * READ)) / loudness(model) > 1.5


@pytest.mark.parametrize(
    ("clean", "reference", "message"),
    [
        ((16, 16, 3), (16, 16, 4), "clean must be packed"),
        ((14, 16, 4), (16, 16, 4), "clean must be at least 16x16"),
        ((16, 16, 4), (16, 16, 3), "noisy_ref must be packed"),
        ((16, 16, 4), (0, 16, 16, 4), "noisy_ref must hold at least one image"),
        ((16, 16, 4), (0, 16, 4), "noisy_ref must hold at least one image"),
    ],
)
def test_other_shapes_are_refused(model, clean, reference, message):
    with pytest.raises(ValueError, match=message):
        sample_noise(model, jax.random.key(0), jnp.zeros(clean), jnp.zeros(reference), NLF)


@pytest.mark.parametrize(("shot", "read"), [(-1e-3, 1e-5), (1e-3, -1e-5), (np.nan, 1e-5)])
def test_a_noise_level_that_no_camera_has_is_refused(model, shot, read):
    with pytest.raises(ValueError, match="nlf: (shot|read) must be finite and 0 or more"):
        sample_noise(model, jax.random.key(0), scene(32, 32), noisy(jax.random.key(1)), (shot, read))


@pytest.mark.parametrize("key", [0, None, jnp.zeros(3)])
def test_what_is_no_key_is_refused(model, key):
    with pytest.raises(TypeError, match=r"key is .*: expected (a|one) key"):
        sample_noise(model, key, scene(32, 32), noisy(jax.random.key(1)), (1e-3, 1e-5))


def test_one_number_is_no_noise_level(model):
    with pytest.raises(ValueError, match="give two numbers"):
        sample_noise(model, jax.random.key(0), scene(32, 32), noisy(jax.random.key(1)), (0.01,))


def test_truths_are_refused(model):
    with pytest.raises(ValueError, match="these are truths"):
        sample_noise(model, jax.random.key(1), scene(32, 32) > 0, noisy(jax.random.key(2)))


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_values_that_are_not_finite_are_refused(model, value):
    key, image, reference = jax.random.key(0), scene(32, 32), noisy(jax.random.key(1))
    at = (0,) * (image.ndim - 1) + (1,)
    with pytest.raises(ValueError, match="clean holds NaN or infinite values: replace them"):
        sample_noise(model, key, image.at[at].set(value), reference, (1e-3, 1e-5))
    with pytest.raises(ValueError, match="noisy_ref holds NaN or infinite"):
        sample_noise(model, key, image, reference.at[(0,) * reference.ndim].set(value), (1e-3, 1e-5))


def test_single_values_far_below_black_are_refused_and_noise_around_it_is_not(model):
    key, image, reference = jax.random.key(0), scene(32, 32), noisy(jax.random.key(1))
    at = (0,) * image.ndim
    with pytest.raises(ValueError, match="clean has lowest value -3, so it is not normalised"):
        sample_noise(model, key, image.at[at].set(-3.0), reference, (1e-3, 1e-5))
    noise = sample_noise(model, key, image.at[at].set(-0.1), reference.at[at[:3]].set(-3.0), (1e-3, 1e-5))
    assert np.isfinite(np.asarray(noise)).all()


def test_a_clean_image_in_dn_is_refused(model):
    with pytest.raises(ValueError, match="so it is not normalised"):
        sample_noise(
            model, jax.random.key(0), 1000 * scene(32, 32) + 64, noisy(jax.random.key(1)), (1e-3, 1e-5)
        )
    with pytest.raises(ValueError, match="noisy_ref has median .*, so it is not normalised"):
        sample_noise(model, jax.random.key(0), scene(32, 32), 1000 * noisy(jax.random.key(1)), (1e-3, 1e-5))
    with pytest.raises(ValueError, match="clean has median -3, so it is not normalised"):
        sample_noise(model, jax.random.key(0), 0 * scene(32, 32) - 3, noisy(jax.random.key(1)), (1e-3, 1e-5))


def test_what_is_no_model_is_refused():
    clean = jnp.zeros((16, 16, 4))
    with pytest.raises(TypeError, match=r"params is a NoneType: expected a Model, of load_model"):
        sample_noise(None, jax.random.key(0), clean, clean)
