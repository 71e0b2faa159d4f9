"""The camera encoder E: Table A-3 of Chang et al. 2020, and the version of it that trains.

E sees noisy images only. In the table, instance norms erase the noise's level in every hidden layer, and
spectral norms leave latents so short that a triplet margin of 0.2 is never reached. The default therefore
adds the image's noise statistics (see `statistics`), in units of their own spread, to the pooled features,
shows the convolutions the high-pass residual in units of its own level instead of the image, pools the
absolute size of their responses, and normalises the latent.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from flax import linen as nn
from jax import lax
from jaxtyping import Array, Float

from cannoise_jax.networks.layers import Block, leaky_relu, scaled
from cannoise_jax.networks.statistics import noise_statistics


class Encoder(nn.Module):
    """The latent of a noisy image of any size from 16x16 packed pixels: `[B, 512 width]`.

    width: scales every channel count. literal: Table A-3 as printed (2,766,848 parameters: no biases, affine
    instance norms after e2..e4, spectral norm on every layer as released, raw average-pooled latent).
    spectral, norm ("none", "channel", "instance"): of e1..e4. latent_scale: the latent's length; 0: raw, so
    that an image that tells much counts for more in the mean of several.
    hidden: width of the layers that read the statistics. Their parameters `centre` and `spread` are constants
    of the data, see `standardised`. dtype: of the products of e1..e4, see `Conv`.
    """

    width: float = 1.0
    literal: bool = False
    spectral: bool = False
    norm: str = "none"
    latent_scale: float = 1.0
    hidden: int = 64
    dtype: str | None = None

    @nn.compact
    def __call__(self, noisy: Float[Array, "b h w 4"], *, train: bool) -> Float[Array, "b l"]:
        latent_size = scaled(self.width, 512)
        if self.literal:
            return jnp.mean(self._features(noisy, train), (1, 2))
        statistics, residual = noise_statistics(noisy)
        centre = self.param("centre", nn.initializers.zeros, statistics.shape[1:])
        spread = self.param("spread", nn.initializers.ones, statistics.shape[1:])
        statistics = (statistics - lax.stop_gradient(centre)) / lax.stop_gradient(spread)
        pooled = jnp.mean(self._features(jnp.clip(residual, -8, 8), train), (1, 2))
        x = leaky_relu(nn.Dense(self.hidden, name="statistics")(statistics))
        x = leaky_relu(nn.Dense(self.hidden, name="join")(jnp.concatenate([x, pooled], -1)))
        latent = nn.Dense(latent_size, name="latent")(x)
        if not self.latent_scale:
            return latent
        return self.latent_scale * unit_length(latent)

    def _features(self, x, train):
        """e1..e4."""
        spectral, norm = (True, "instance") if self.literal else (self.spectral, self.norm)
        shared: dict[str, Any] = {
            "spectral": spectral,
            "initial": "torch" if self.literal else "he",
            "dtype": self.dtype,
        }
        for i, channels in enumerate((64, 128, 256, 512), 1):
            size, stride, padding = (7, 1, 3) if i == 1 else (4, 2, 1)
            kind = "none" if i == 1 else norm
            x = Block(scaled(self.width, channels), size, stride, padding, norm=kind, **shared, name=f"e{i}")(
                x, train=train
            )
        return x if self.dtype is None else x.astype(jnp.float32)


def standardised(params: Mapping[str, Any], noisy: Float[Array, "n h w 4"]) -> dict[str, Any]:
    """Parameters of E whose statistics have mean zero and variance one over these noisy images.

    Cameras differ by a fraction of a statistic's own scale (a correlation by hundredths, a log level by one):
    without this the small ones are learned last. Literal parameters have no statistics and stay as they are.
    """
    if "centre" not in params:
        return dict(params)
    statistics = noise_statistics(noisy)[0]
    spread = jnp.std(statistics, 0)
    # What is the same in all images says nothing: it is not blown up.
    return {**params, "centre": jnp.mean(statistics, 0), "spread": jnp.maximum(spread, 0.01)}


def mean_latent(encoder: Encoder, latents: Float[Array, "*b n l"]) -> Float[Array, "*b l"]:
    """One latent for n images of a camera: their mean, as long as each of them."""
    mean = jnp.mean(latents, -2)
    if encoder.literal or not encoder.latent_scale:
        return mean
    return encoder.latent_scale * unit_length(mean)


def unit_length(latent: Float[Array, "*b l"]) -> Float[Array, "*b l"]:
    """Each latent divided by its length."""
    return latent / jnp.sqrt(jnp.sum(jnp.square(latent), -1, keepdims=True) + 1e-12)
