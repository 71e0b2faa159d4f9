"""The losses against plain NumPy in float64, their derivatives against finite differences."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cannoise_jax.training import losses


@pytest.fixture(autouse=True)
def float64():
    with jax.enable_x64(True):
        yield


RNG = np.random.default_rng(0)
NOISE = RNG.normal(size=(3, 2, 4, 2))
WEIGHTS = RNG.normal(size=(5, 16)) * 0.4


def scores(weights, noise):
    """Five scores a sample: tanh of projections of its noise."""
    return jnp.tanh(noise.reshape(noise.shape[0], -1) @ weights.T)[:, :, None, None]


def numpy_slopes(weights, noise):
    """The gradient of the summed score, written out: sum_p (1 - tanh^2(w_p n)) w_p."""
    flat = noise.reshape(noise.shape[0], -1)
    return np.array([np.linalg.norm((1 - np.tanh(weights @ n) ** 2) @ weights) for n in flat])


def numpy_penalty(weights, noise, target):
    return np.mean((numpy_slopes(weights, noise) - target) ** 2)


def test_critic_and_generator_losses_are_means_over_samples_and_positions():
    real, fake = RNG.normal(size=(2, 3, 5, 1, 1))
    np.testing.assert_allclose(losses.critic_loss(real, fake), fake.mean() - real.mean())
    np.testing.assert_allclose(losses.generator_loss(fake), -fake.mean())


def test_interpolation_has_one_weight_per_sample():
    real, fake = RNG.normal(size=(2, *NOISE.shape))
    weight = np.array([0.0, 1.0, 0.25])
    mixed = losses.interpolate(real, fake, weight)
    expected = [real[0], fake[1], 0.75 * real[2] + 0.25 * fake[2]]
    np.testing.assert_allclose(mixed, np.stack(expected))


def test_slopes_are_norms_per_sample_of_the_gradient_of_the_summed_score():
    got = losses.slopes(lambda n: scores(WEIGHTS, n), jnp.asarray(NOISE))
    np.testing.assert_allclose(got, numpy_slopes(WEIGHTS, NOISE), rtol=1e-12)


@pytest.mark.parametrize("target", [1.0, 0.0])
def test_gradient_penalty_and_its_derivative_by_the_critic(target):
    def penalty(weights):
        return losses.gradient_penalty(lambda n: scores(weights, n), jnp.asarray(NOISE), target)

    value, gradient = jax.value_and_grad(penalty)(jnp.asarray(WEIGHTS))
    np.testing.assert_allclose(value, numpy_penalty(WEIGHTS, NOISE, target), rtol=1e-12)
    step = 1e-5
    for place in [(0, 0), (2, 7), (4, 15)]:
        shift = np.zeros_like(WEIGHTS)
        shift[place] = step
        slope = numpy_penalty(WEIGHTS + shift, NOISE, target) - numpy_penalty(WEIGHTS - shift, NOISE, target)
        np.testing.assert_allclose(gradient[place], slope / (2 * step), rtol=1e-6, atol=1e-9)


def test_gradient_penalty_of_a_flat_critic_is_one_and_differentiable():
    def penalty(weights):
        return losses.gradient_penalty(lambda n: scores(weights, n), jnp.asarray(NOISE))

    value, gradient = jax.value_and_grad(penalty)(jnp.zeros_like(WEIGHTS))
    assert value == 1
    assert np.isfinite(gradient).all()


def test_feature_matching_is_a_mean_and_its_target_is_constant():
    fake, target = RNG.normal(size=(2, 2, 3, 3, 4))
    value, (by_fake, by_target) = jax.value_and_grad(losses.feature_matching_loss, (0, 1))(fake, target)
    np.testing.assert_allclose(value, np.abs(fake - target).mean())
    np.testing.assert_allclose(by_fake, np.sign(fake - target) / fake.size)
    assert not by_target.any()


def numpy_triplet(anchor, positive, negative, margin):
    near = np.sqrt(((anchor - positive) ** 2).sum(1))
    far = np.sqrt(((anchor - negative) ** 2).sum(1))
    return np.maximum(near - far + margin, 0).mean()


def test_triplet_loss_and_its_derivative():
    latents = RNG.normal(size=(3, 6, 4))
    value, gradient = jax.value_and_grad(losses.triplet_loss)(*latents)
    np.testing.assert_allclose(value, numpy_triplet(*latents, 0.2))
    assert value > 0  # some triplets are active, some are not: both branches are seen
    assert (np.sqrt(((latents[0] - latents[1]) ** 2).sum(1)) + 0.2
            < np.sqrt(((latents[0] - latents[2]) ** 2).sum(1))).any()  # fmt: skip
    step = 1e-6
    for place in np.ndindex(gradient.shape):
        up, down = latents[0].copy(), latents[0].copy()
        up[place] += step
        down[place] -= step
        slope = (numpy_triplet(up, *latents[1:], 0.2) - numpy_triplet(down, *latents[1:], 0.2)) / (2 * step)
        np.testing.assert_allclose(gradient[place], slope, atol=1e-8)


def test_triplet_loss_at_distance_zero_has_a_finite_gradient():
    same = np.ones((2, 3))
    value, gradient = jax.value_and_grad(losses.triplet_loss, (0, 1, 2))(same, same, same)
    assert value == pytest.approx(0.2)
    assert all(np.isfinite(g).all() for g in gradient)


def numpy_batch_triplet(latents, camera, margin):
    terms = [
        max(np.linalg.norm(latents[a] - latents[p]) - np.linalg.norm(latents[a] - latents[n]) + margin, 0)
        for a, p, n in np.ndindex(*(len(camera),) * 3)
        if a != p and camera[a] == camera[p] != camera[n]
    ]
    return np.mean(terms)


def test_batch_triplet_loss_against_loops():
    latents, camera = RNG.normal(size=(7, 4)) * 0.3, np.array([0, 1, 2, 0, 1, 0, 3])
    value, gradient = jax.value_and_grad(losses.batch_triplet_loss)(latents, camera)
    np.testing.assert_allclose(value, numpy_batch_triplet(latents, camera, 0.2), rtol=1e-12)
    assert gradient.any() and np.isfinite(gradient).all()


@pytest.mark.parametrize("camera", [[0, 0, 0], [0, 1, 2]])
def test_batch_triplet_loss_without_triplets_is_zero(camera):
    value, gradient = jax.value_and_grad(losses.batch_triplet_loss)(np.ones((3, 2)), np.array(camera))
    assert value == 0 and not gradient.any()


def correlation_z(values, axis):
    a, b = np.delete(values, -1, axis), np.delete(values, 0, axis)
    return 0.5 * np.log((np.mean((a + b) ** 2) + 1e-6) / (np.mean((a - b) ** 2) + 1e-6))


def numpy_moments(noise, clean):
    """The statistics by loops: each image, each channel, pixels below and above the mean signal."""
    count, height, _, channels = noise.shape
    levels, means = np.empty((count, 2, 2, channels)), np.empty((count, 2, channels))
    neighbours, rows = np.empty((count, 2)), np.empty(count)
    for b in range(count):
        for c in range(channels):
            values, signal = noise[b, ..., c], clean[b, ..., c]
            for side, chosen in enumerate((signal <= signal.mean(), signal > signal.mean())):
                size = np.sqrt(values[chosen] ** 2 + 1e-6)
                n = chosen.sum() + 1e-3
                levels[b, side, :, c] = np.log([(size.sum() + 1e-3) / n, ((size**2).sum() + 1e-3) / n])
                means[b, side, c] = values[chosen].sum() / n
        neighbours[b] = [correlation_z(noise[b], axis) for axis in (0, 1)]
        sensor = [
            noise[b, y, :, 2 * k : 2 * k + 2].mean() for y in range(height) for k in range(channels // 2)
        ]
        rows[b] = np.log(np.mean(np.square(sensor)) + 1e-6)
    return levels, means, neighbours, rows


def test_statistics_loss_against_loops():
    fake, real, clean = RNG.normal(size=(3, 2, 6, 5, 4))
    for got, wanted in zip(losses.noise_moments(fake, clean), numpy_moments(fake, clean), strict=True):
        np.testing.assert_allclose(got, wanted, rtol=1e-10)
    pairs = zip(numpy_moments(fake, clean), numpy_moments(real, clean), (1, 1, 1, 0.1), strict=True)
    wanted = sum(weight * np.mean((a - b) ** 2) for a, b, weight in pairs)
    np.testing.assert_allclose(losses.statistics_loss(fake, real, clean), wanted, rtol=1e-10)


def test_neighbours_are_fishers_z_of_their_correlation():
    white = RNG.normal(size=(1, 200, 200, 4))
    blend = white[:, :, 1:] + 0.5 * white[:, :, :-1]
    vertical, horizontal = losses.noise_moments(blend, np.zeros_like(blend)).neighbours[0]
    assert vertical == pytest.approx(0, abs=0.01)
    assert horizontal == pytest.approx(np.arctanh(0.5 / 1.25), abs=0.01)


def test_statistics_loss_leads_to_the_level_of_each_image():
    real = RNG.normal(size=(4, 32, 32, 4)) * np.array([0.5, 1.0, 1.5, 2.0])[:, None, None, None]
    start, clean = RNG.normal(size=(2, *real.shape))
    scale = jnp.ones(4)
    descend = jax.jit(jax.grad(lambda s: losses.statistics_loss(start * s[:, None, None, None], real, clean)))
    for _ in range(200):
        scale = scale - 0.5 * scale**2 * descend(scale)
    np.testing.assert_allclose(scale, [0.5, 1.0, 1.5, 2.0], rtol=0.05)


def test_statistics_loss_has_finite_gradients_without_noise_or_contrast():
    nothing, noise = np.zeros((1, 4, 4, 2)), RNG.normal(size=(1, 4, 4, 2))
    gradient = jax.grad(losses.statistics_loss)(nothing, noise, nothing)
    assert np.isfinite(gradient).all()


def test_a_deviance_is_least_at_the_mean():
    true = RNG.gamma(2.0, size=4000)
    costs = [np.mean(losses.deviance(true, factor * true.mean())) for factor in (0.8, 1.0, 1.25)]
    assert costs[1] < min(costs[0], costs[2])
    assert float(losses.deviance(jnp.array(3.0), jnp.array(3.0))) == 0
    # Twice the KL of normal distributions of these variances.
    assert float(losses.deviance(jnp.array(2.0), jnp.array(1.0))) == pytest.approx(2 - 1 - np.log(2))


def test_the_level_loss_is_the_kl_of_normal_noise_and_is_not_moved_by_a_few():
    close = losses.level_loss(jnp.array(1.02), jnp.array(1.0))
    assert float(close) == pytest.approx((1.02 - 1 - np.log(1.02)) / 2, rel=0.03)
    true = np.concatenate([RNG.gamma(100.0, 0.01, 950), np.full(50, 20.0)])  # 5 % beyond all bounds
    found = np.linspace(0.8, 2.5, 171)
    least = [
        found[np.argmin([float(np.mean(loss(true, f))) for f in found])]
        for loss in (losses.level_loss, losses.deviance)
    ]
    assert abs(least[0] - 1) < 0.03 and least[1] > 1.5


def test_the_loss_of_two_draws_asks_for_the_tails_and_that_of_one_does_not():
    """Laplace tails of any weight, sorted: the slope of the loss at the true weight, mean over draws."""
    key = jax.random.key(0)

    def noise(weight, key):
        z, e = jax.random.normal(key, (2, 400, 64))
        return losses.quantiles((z * jnp.exp(weight * e))[:, :, None, None])

    real = noise(0.5, jax.random.key(7))

    def paired(weight):
        first, second = (noise(weight, k) for k in jax.random.split(key))
        return losses.paired_loss(first, second, real)

    def single(weight):
        return jnp.mean(jnp.square(noise(weight, key) - real))

    weights = np.linspace(0.2, 0.8, 25)
    least = [weights[np.argmin([float(loss(w)) for w in weights])] for loss in (paired, single)]
    assert abs(least[0] - 0.5) < 0.06 and least[1] < least[0]


def test_spectra_see_rows_columns_and_neighbours_apart():
    white = RNG.normal(size=(40, 32, 32, 4))
    rows = np.repeat(RNG.normal(size=(40, 32, 1, 2)), 2, -1)
    columns = np.tile(RNG.normal(size=(40, 1, 32, 2)), 2)
    blend = (white + np.roll(white, 1, 2)) / 2**0.5
    plain, by_row, by_column, by_blend = (
        np.asarray(losses.log_spectra(n)).mean(0)
        for n in (white, white + 0.3 * rows, white + 0.3 * columns, blend)
    )
    assert np.abs(plain).max() < 0.25
    assert (by_row - plain)[:4].min() > 1 and np.abs(by_row - plain)[4:8].max() < 0.2
    assert (by_column - plain)[4:8].min() > 1 and np.abs(by_column - plain)[:4].max() < 0.2
    assert (by_blend - plain)[8:].max() > 0.3 and (by_blend - plain)[8:].min() < -0.5


def test_the_physics_loss_is_zero_at_the_truth():
    from cannoise_jax.networks.branches import NoiseLevel, Physics, line_variance

    one = jnp.ones(2)
    level = NoiseLevel(1e-3 * jnp.ones((2, 4)), 1e-5 * jnp.ones((2, 4)), one, one)
    physics = Physics(
        0 * one, 0 * one, -0.1 * one, 0.01 * one, 0.02 * one, 0 * one, 0.1 * one, jnp.zeros((2, 4))
    )
    truth = losses.Truth(level.shot, level.read, *physics[2:7])
    clean = jnp.asarray(RNG.random((2, 8, 8, 4)))
    parts = losses.physics_loss(line_variance(physics, level, clean), clean, physics, truth)
    assert all(abs(float(v)) < 1e-12 for v in parts.values())
    louder = line_variance(physics._replace(log_shot=0.2 * one, log_read=0.2 * one), level, clean)
    more = losses.physics_loss(louder, clean, physics, truth)
    assert float(more["level"]) == pytest.approx(float(losses.level_loss(1.0, np.exp(0.2))), rel=1e-6)
