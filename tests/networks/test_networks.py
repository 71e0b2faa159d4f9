"""What the networks do: where they start, what the table cannot do, norms, folding, what E sees."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.networks import Discriminator, Encoder, Generator
from cannoise_jax.networks.layers import Block, Conv, fold_spectral_norm, instance_norm, spectral_norm
from cannoise_jax.networks.statistics import noise_statistics

WIDTH = 1 / 64


def jit(function):
    return jax.jit(function)


def draw(seed, *shape, size=1.0):
    return jnp.asarray(size * np.random.default_rng(seed).normal(size=shape), jnp.float32)


def filled(shapes, seed=0, size=0.2):
    rng = np.random.default_rng(seed)
    return jax.tree.map(lambda leaf: jnp.asarray(size * rng.normal(size=leaf.shape), jnp.float32), shapes)


def inputs(batch=2, side=64):
    clean = jnp.abs(draw(0, batch, side, side, 4, size=0.2))
    sigma = jnp.sqrt(1e-3 * clean + 1e-5)
    return clean, sigma * draw(1, batch, side, side, 4), sigma


@pytest.mark.slow
def test_the_generator_starts_as_its_initial_noise():
    clean, noise, sigma = inputs(1)
    latent, keys = draw(2, 1, 8), {"params": jax.random.key(0), "noise": jax.random.key(1)}
    generator = Generator(WIDTH, hidden=4, physics=False)

    def start(clean, noise, latent, sigma):
        variables = generator.init(keys, clean, noise, latent, sigma, train=False)
        return generator.apply(variables, clean, noise, latent, sigma, train=False, rngs=keys)

    np.testing.assert_array_equal(jit(start)(clean, noise, latent, sigma), noise)


def test_row_noise_is_common_to_the_two_channels_of_a_sensor_row():
    clean, _, sigma = inputs(1, 32)
    latent, keys = draw(2, 1, 8), {"noise": jax.random.key(1)}
    generator = Generator(WIDTH, hidden=4, spectral=False, physics=False)
    shapes = jax.eval_shape(
        lambda: generator.init({"params": keys["noise"], **keys}, clean, clean, latent, sigma, train=False)
    )
    variables = jax.tree.map(jnp.zeros_like, shapes)
    bias = jnp.zeros(12).at[8:].set(0.5)  # the row gain alone
    variables = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), variables)
    variables["params"]["pixels"]["out"]["bias"] = bias
    apply = jit(lambda v: generator.apply(v, clean, 0 * clean, latent, sigma, train=False, rngs=keys))
    rows = np.asarray(apply(variables))[0]
    np.testing.assert_allclose(rows, np.broadcast_to(rows[:, :1], rows.shape))  # constant along the row
    units = rows[:, 0] / (np.mean(np.asarray(sigma)[0], 1) * np.tanh(0.5))
    np.testing.assert_allclose(units[:, 0], units[:, 1], rtol=1e-4)  # R with Gr
    np.testing.assert_allclose(units[:, 2], units[:, 3], rtol=1e-4)  # Gb with B
    assert abs(np.corrcoef(units[:, 0], units[:, 2])[0, 1]) < 0.6


def test_the_tables_critic_says_the_same_of_everything():
    """Why it is not the default: the mean score is the bias of its last norm, so no loss has a gradient."""
    clean, noise, sigma = inputs()
    critic = Discriminator(WIDTH, literal=True)
    shapes = jax.eval_shape(lambda: critic.init(jax.random.key(0), noise, clean, sigma, train=False))
    variables = {"params": filled(shapes["params"])}
    bias = variables["params"]["out_norm"]["bias"]

    def score(noise):
        return jnp.mean(critic.apply(variables, noise, clean, sigma, train=False)[0], (1, 2))

    value, slope = jit(lambda n: (score(n), jax.grad(lambda n: jnp.sum(score(n)))(n)))(noise)
    np.testing.assert_allclose(value, np.broadcast_to(bias, value.shape), atol=1e-6)
    assert float(jnp.linalg.norm(slope)) < 1e-4

    repaired = Discriminator(WIDTH, hidden=4)
    shapes = jax.eval_shape(lambda: repaired.init(jax.random.key(0), noise, clean, sigma, train=False))
    variables = filled(shapes)
    apply = jit(lambda n: repaired.apply(variables, n, clean, sigma, train=False))
    scores, features = apply(noise)
    assert scores.shape == (2, 7, 7, 1) and features.shape == (2, 8, 8, 4)
    assert abs(float(jnp.mean(scores) - jnp.mean(apply(1.5 * noise)[0]))) > 1e-3


def test_a_literal_generator_pins_the_residuals_level():
    """Why it is not the default: whatever the input's scale, R's spread is that of its last norm."""
    clean, noise, sigma = inputs()
    generator, latent = Generator(WIDTH, literal=True), draw(2, 2, 8)
    shapes = jax.eval_shape(
        lambda: generator.init(jax.random.key(0), clean, noise, latent, sigma, train=False)
    )
    variables = {"params": filled(shapes["params"])}
    norm = variables["params"]["unet"]["out_norm"]
    norm |= {"scale": jnp.full(4, 0.05), "bias": jnp.zeros(4)}
    apply = jit(lambda clean, noise: generator.apply(variables, clean, noise, latent, sigma, train=False))
    for scale in (1, 10):
        residual = apply(scale * clean, scale * noise) - scale * noise
        np.testing.assert_allclose(jnp.std(residual, (1, 2)), 0.05, rtol=0.02)


def test_instance_norm_against_its_definition_and_on_single_pixels():
    x, scale, bias = draw(0, 2, 3, 5, 4), draw(1, 4), draw(2, 4)
    expected = (x - x.mean((1, 2), keepdims=True)) / np.sqrt(np.var(x, (1, 2), keepdims=True) + 1e-5)
    np.testing.assert_allclose(instance_norm(x, scale, bias), expected * scale + bias, atol=1e-5)
    one = instance_norm(x[:, :1, :1], scale, bias)
    np.testing.assert_array_equal(one, np.broadcast_to(bias, one.shape))


def test_power_iteration_finds_the_largest_singular_value():
    kernel = draw(0, 3, 3, 4, 6)
    u, v = jnp.ones(6) / 6**0.5, jnp.zeros(36)
    first = spectral_norm(kernel, u, v, iterate=True)
    matrix = np.asarray(kernel).reshape(36, 6)
    by_hand = matrix @ np.asarray(u)
    np.testing.assert_allclose(first[2], by_hand / np.linalg.norm(by_hand), rtol=1e-5)
    np.testing.assert_allclose(first[0], np.linalg.norm(matrix.T @ np.asarray(first[2])), rtol=1e-5)
    sigma = first[0]
    for _ in range(100):
        sigma, u, v = spectral_norm(kernel, u, v, iterate=True)
    np.testing.assert_allclose(sigma, np.linalg.svd(matrix, compute_uv=False)[0], rtol=1e-4)


@pytest.mark.parametrize("transposed", [False, True])
def test_spectral_state_moves_in_training_only_and_folds(transposed):
    layer, x = Conv(6, 4, 2, 1, transposed=transposed, initial="he"), draw(0, 2, 4, 4, 3)
    start = layer.init(jax.random.key(0), x, train=True)
    kernel = start["params"]["kernel"] * draw(3, 4, 4, 3, 6)  # the vectors no longer fit the kernel
    variables = {"params": {"kernel": kernel}, "spectral": start["spectral"]}
    _, trained = layer.apply(variables, x, train=True, mutable=["spectral"])
    _, evaluated = layer.apply(variables, x, train=False, mutable=["spectral"])
    assert not np.array_equal(trained["spectral"]["u"], start["spectral"]["u"])
    np.testing.assert_array_equal(evaluated["spectral"]["u"], start["spectral"]["u"])
    np.testing.assert_array_equal(evaluated["spectral"]["v"], start["spectral"]["v"])
    wanted = layer.apply(variables, x, train=False)
    folded = fold_spectral_norm(variables)
    assert set(folded) == {"params"}
    np.testing.assert_allclose(layer.apply(folded, x, train=False), wanted, rtol=1e-5, atol=1e-6)
    doubled = {"params": {"kernel": 2 * kernel}, "spectral": start["spectral"]}
    np.testing.assert_allclose(layer.apply(doubled, x, train=False), wanted, rtol=1e-5, atol=1e-6)


def test_a_whole_network_folds():
    """Nested layers keep their place: the literal encoder folded is the literal encoder."""
    encoder, x = Encoder(WIDTH, literal=True), draw(0, 1, 16, 16, 4)
    shapes = jax.eval_shape(lambda: encoder.init(jax.random.key(0), x, train=False))
    variables = filled(shapes)
    apply = jit(lambda v: encoder.apply(v, x, train=False))
    np.testing.assert_allclose(apply(fold_spectral_norm(variables)), apply(variables), rtol=1e-3, atol=1e-5)


def test_a_block_without_norm_has_a_bias_unless_literal():
    x = draw(0, 1, 4, 4, 3)
    for initial, names in (("he", {"kernel", "bias"}), ("torch", {"kernel"})):
        block = Block(4, norm="none", initial=initial, spectral=False)
        assert set(block.init(jax.random.key(0), x, train=False)["params"]["conv"]) == names


def test_the_latent_has_the_length_asked_for_and_takes_any_size():
    encoder = Encoder(WIDTH, hidden=4, latent_scale=3.0)
    x = draw(0, 2, 16, 22, 4, size=0.1)
    variables = filled(jax.eval_shape(lambda: encoder.init(jax.random.key(0), x, train=False)))
    latent = jit(lambda x: encoder.apply(variables, x, train=False))(x)
    assert latent.shape == (2, 8)
    np.testing.assert_allclose(jnp.linalg.norm(latent, axis=-1), 3.0, rtol=1e-4)


def test_statistics_tell_level_tails_rows_and_neighbours_apart():
    """Each kind of noise moves its own numbers, on a scene whose smooth content moves none."""
    rng = np.random.default_rng(3)
    n, side = 24, 64
    y, x = np.mgrid[:side, :side] / side
    scene = 0.2 + 0.1 * np.sin(3 * x + 2 * y)[..., None]
    white = rng.normal(size=(n, side, side, 4))
    row = np.repeat(rng.normal(size=(n, side, 1, 2)), 2, -1)
    tails = rng.standard_t(4, size=white.shape) / 2**0.5
    smooth = (white + 0.4 * np.roll(white, 1, 2)) / 1.16**0.5
    statistics = jax.jit(lambda noise: noise_statistics(scene + 0.01 * noise)[0])

    def measure(noise):
        s = np.asarray(statistics(noise.astype(np.float32)))
        return s.mean(0), s.std(0) / n**0.5

    base, error = measure(white)

    def moved(noise):
        mean, spread = measure(noise)
        return np.abs(mean - base) / np.hypot(error, spread + 1e-9)

    levels, kurtosis, horizontal = slice(0, 20), slice(38, 42), slice(59, 63)
    rows, next_rows, columns = [73, 81], [78, 82], [84, 92]
    louder = moved(1.3 * white)
    assert louder[levels].max() > 20 and louder[kurtosis].max() < 5
    assert moved(tails)[kurtosis].max() > 10
    by_rows = moved(white + 0.3 * row)
    assert by_rows[rows].min() > 5 > by_rows[columns].max()
    column = np.tile(rng.normal(size=(n, 1, side, 2)), 2)
    by_columns = moved(white + 0.3 * column)
    assert by_columns[columns].min() > 5 > by_columns[rows].max()
    pairs = np.repeat(rng.normal(size=(n, side, 1, 1)), 4, -1)  # the two sensor rows of a cell alike
    assert moved(white + 0.3 * pairs)[next_rows].min() > 5 > by_rows[next_rows].max()
    assert moved(smooth)[horizontal].min() > 10
