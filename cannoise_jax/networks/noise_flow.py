"""Noise Flow (Abdelhamed et al. 2019): an invertible network between camera noise and white Gaussian noise.

The architecture S-A4-G-A4-CAM of the reference's code, 2,433 parameters for five cameras and five ISOs:
noise is divided by a signal, ISO and camera dependent standard deviation, passes four pairs of a 1x1
convolution and an affine coupling, one scalar gain, and four more pairs. Sampling is the exact inverse.

Every layer owns its weights by name, and both directions run through the same ones. The reference's released
sampler restores the weights of its eight coupling networks in reversed order, which makes its noise about
three times too strong; nothing here depends on the order of calls.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Int

_WIDTH = 4
_CHANNELS = 4
_LOWER, _UPPER = np.tril_indices(_CHANNELS, -1), np.triu_indices(_CHANNELS, 1)
_LEAST = 1e-12
_small = nn.initializers.normal(_WIDTH / 512 * 0.05)


class SignalLayer(nn.Module):
    """Standard deviation of the noise: s^2 = b1 clean / g + b2, with b1, b2, g moved by camera and ISO.

    Start: the reference's. `with_levels` starts from known noise levels, as its released weights did.
    """

    isos: tuple[float, ...]
    cameras: int

    @nn.compact
    def __call__(
        self, clean: Float[Array, "b h w 4"], camera: Int[Array, "b"], iso: Int[Array, "b"]
    ) -> Float[Array, "b h w 4"]:
        beta = self.param("beta", lambda _: jnp.array([-5.0, 0.0]))
        gamma = self.param("gamma", nn.initializers.constant(-5.0), (len(self.isos),))
        shift = jnp.exp(self.param("camera", nn.initializers.ones, (3, self.cameras)))[:, camera]
        # Declared by the reference and used by nothing: kept so that the count of parameters agrees.
        self.param("unused", nn.initializers.ones, ())
        b1, b2 = jnp.exp(beta[0] * shift[0]), jnp.exp(beta[1] * shift[1])
        g = jnp.asarray(self.isos)[iso] * jnp.exp(gamma[iso] * shift[2])
        b1, b2, g = (v[:, None, None, None] for v in (b1, b2, g))
        return jnp.sqrt(b1 * jnp.maximum(clean, 0) / g + b2 + _LEAST)


class Mixing(nn.Module):
    """An invertible 1x1 convolution, A = P L (U + diag(sign e^log_s)): P and the signs stay as drawn."""

    @nn.compact
    def __call__(self) -> tuple[Float[Array, "4 4"], Float[Array, ""]]:
        """The matrix and the logarithm of its determinant's size."""
        fixed = lower = upper = jnp.eye(_CHANNELS)  # of their shapes alone, once the weights exist
        if self.is_initializing():
            q, _ = jnp.linalg.qr(jax.random.normal(self.make_rng("params"), (_CHANNELS, _CHANNELS)))
            fixed, lower, upper = jax.scipy.linalg.lu(q)
        permutation = self.variable("fixed", "permutation", lambda: fixed)
        sign = self.variable("fixed", "sign", lambda: jnp.sign(jnp.diag(upper)))
        low = self.param("lower", lambda _: lower[_LOWER])
        up = self.param("upper", lambda _: upper[_UPPER])
        log_s = self.param("log_s", lambda _: jnp.log(jnp.abs(jnp.diag(upper))))
        left = jnp.eye(_CHANNELS).at[_LOWER].set(low)
        right = jnp.zeros((_CHANNELS, _CHANNELS)).at[_UPPER].set(up)
        right = right + jnp.diag(sign.value * jnp.exp(log_s))
        return permutation.value @ left @ right, jnp.sum(log_s)


class Coupling(nn.Module):
    """Shift and log scale of the last two channels from the first two; zero shift and scale one at first."""

    @nn.compact
    def __call__(
        self, half: Float[Array, "b h w 2"], *, train: bool
    ) -> tuple[Float[Array, "b h w 2"], Float[Array, "b h w 2"]]:
        size = self.param("size", nn.initializers.constant(1e-4), ())

        def normed(x, name):
            return nn.relu(
                nn.BatchNorm(
                    not train, momentum=0.9, epsilon=1e-4, use_bias=False, use_scale=False, name=name
                )(x)
            )

        x = normed(nn.Conv(_WIDTH, (3, 3), kernel_init=_small, name="first")(half), "norm1")
        x = normed(nn.Conv(_WIDTH, (1, 1), kernel_init=_small, name="second")(x), "norm2")
        # A mask tells the last convolution where the image ends.
        x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
        mask = jnp.ones(x.shape[1:3]).at[1:-1, 1:-1].set(0)
        x = jnp.concatenate([x, jnp.broadcast_to(mask[None, ..., None], (*x.shape[:3], 1))], -1)
        x = nn.Conv(_CHANNELS, (3, 3), padding="VALID", kernel_init=nn.initializers.zeros, name="last")(x)
        x = x * jnp.exp(3 * self.param("logs", nn.initializers.zeros, (_CHANNELS,)))
        shift, scale = jnp.split(x, 2, -1)
        return shift, size * jnp.tanh(scale)


class NoiseFlow(nn.Module):
    """Noise to latent with `__call__`, latent to noise with `inverse`; packed `[b, h, w, 4]`, normalised.

    isos: the settings known; cameras: how many. Of both an image states the index. Collections: `params`,
    `batch_stats` (of the coupling networks), `fixed` (the permutations).
    """

    isos: tuple[float, ...] = (100.0, 400.0, 800.0, 1600.0, 3200.0)
    cameras: int = 5
    steps: int = 4

    def setup(self):
        self.signal = SignalLayer(self.isos, self.cameras)
        self.mixings = [Mixing(name=f"mix{i}") for i in range(2 * self.steps)]
        self.couplings = [Coupling(name=f"couple{i}") for i in range(2 * self.steps)]
        self.gain = self.param("gain", nn.initializers.ones, ())
        self.param("unused", nn.initializers.ones, ())

    def __call__(
        self,
        noise: Float[Array, "b h w 4"],
        clean: Float[Array, "b h w 4"],
        camera: Int[Array, "b"],
        iso: Int[Array, "b"],
        *,
        train: bool = False,
    ) -> tuple[Float[Array, "b h w 4"], Float[Array, "b"]]:
        """The latent, and the logarithm of the determinant of its derivative by the noise."""
        sigma = self.signal(clean, camera, iso)
        z, log_det = noise / sigma, -jnp.sum(jnp.log(sigma), (1, 2, 3))
        pixels = z.shape[1] * z.shape[2]
        for i in range(2 * self.steps):
            if i == self.steps:
                z = z / self.gain
                log_det = log_det - pixels * _CHANNELS * jnp.log(jnp.abs(self.gain))
            matrix, log_size = self.mixings[i]()
            kept, moved = jnp.split(z @ matrix, 2, -1)
            shift, log_scale = self.couplings[i](kept, train=train)
            z = jnp.concatenate([kept, moved * jnp.exp(log_scale) + shift], -1)
            log_det = log_det + pixels * log_size + jnp.sum(log_scale, (1, 2, 3))
        return z, log_det

    def inverse(
        self,
        latent: Float[Array, "b h w 4"],
        clean: Float[Array, "b h w 4"],
        camera: Int[Array, "b"],
        iso: Int[Array, "b"],
    ) -> Float[Array, "b h w 4"]:
        """The noise of which this is the latent."""
        z = latent
        for i in reversed(range(2 * self.steps)):
            kept, moved = jnp.split(z, 2, -1)
            shift, log_scale = self.couplings[i](kept, train=False)
            z = jnp.concatenate([kept, (moved - shift) * jnp.exp(-log_scale)], -1)
            matrix, _ = self.mixings[i]()
            z = z @ jnp.linalg.inv(matrix)
            if i == self.steps:
                z = z * self.gain
        return z * self.signal(clean, camera, iso)


def log_likelihood(latent: Float[Array, "b h w 4"], log_det: Float[Array, "b"]) -> Float[Array, "b"]:
    """Log density of the noise per value, nats: standard normal latent and the change of variables."""
    count = latent[0].size
    normal = -0.5 * jnp.sum(jnp.square(latent), (1, 2, 3)) - 0.5 * count * jnp.log(2 * jnp.pi)
    return (normal + log_det) / count


def with_levels(variables: dict, isos: tuple[float, ...], shot: Float[np.ndarray, "i"], read: float) -> dict:
    """The variables with the signal layer at these noise levels, for all cameras: var = shot[ISO] clean +
    read, normalised. From the reference's own start, sigma 1, likelihood takes most of the training to get
    to the noise's order of magnitude."""
    beta = jnp.array([-5.0, np.log(max(read, 1e-9))], jnp.float32)
    gamma = beta[0] - jnp.log(jnp.asarray(shot, jnp.float32) * jnp.asarray(isos, jnp.float32))
    signal = variables["params"]["signal"]
    signal = {**signal, "beta": beta, "gamma": gamma, "camera": jnp.zeros_like(signal["camera"])}
    return {**variables, "params": {**variables["params"], "signal": signal}}
