"""The critic D: Table A-2 of Chang et al. 2020, and the version of it that trains.

The table puts an instance norm on D's one-channel output. The spatial mean of each score map is then the
norm's bias, for every input, and the Wasserstein loss has no gradient at all. Spectral norm on every layer
also bounds the slope that the gradient penalty wants at one, and instance norm in the hidden layers hides the
noise's level, which is the first thing a camera's published noise level function gets wrong.
The default therefore
- sees noise in units of the initial noise's sigma, and log sigma and the clean image beside it;
- has no norm on its output, and `spectral` and `norm` as fields for the other layers;
- has a full-resolution pointwise branch, averaged over 8x8 pixels: a test of the marginal distribution, which
  is what the KL metric measures;
- sees |z| and a bounded z^2 beside z = noise / sigma, so that level and tails are linear in what it sees;
- sees row means, since row noise of a fifth of sigma is invisible in a 46-pixel neighbourhood;
- may be told the camera's latent, so that another camera's noise is as wrong as none.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from cannoise_jax.networks.generator import in_sigma_units
from cannoise_jax.networks.layers import Block, Conv, Norm, leaky_relu, scaled


class Discriminator(nn.Module):
    """Realness of noise given the clean image, at the scale of 46x46 packed pixels.

    width: scales every channel count. literal: Table A-2 as printed (668,416 parameters without the norm of
    the last layer: no biases, affine instance norms after d2 and d3; that last norm adds 2); stride 1 and
    padding 1 on the last layer, so 64x64 gives 7x7 scores (the printed h/16 would need stride 2).
    spectral, norm ("none", "channel", "instance"): of d2, d3 and, spectral only, the last layer.
    hidden: channels of the pointwise branch; 0: none. rows: show row means. moments: show size and square.
    output_norm: the literal table's last norm, with which the loss has no gradient. dtype: of the products of
    all but the pointwise branch, see `Conv`.

    `noise`: normalised units. `latent`: of the camera, or None; to be given always or never.
    Returns (scores, features): the score map, and d3 (the table's D_f) at an eighth of the size.
    Height and width must be multiples of 8.
    """

    width: float = 1.0
    literal: bool = False
    spectral: bool = False
    norm: str = "none"
    hidden: int = 32
    rows: bool = True
    moments: bool = True
    level_input: bool = True
    output_norm: bool = True
    dtype: str | None = None

    @nn.compact
    def __call__(
        self,
        noise: Float[Array, "b h w 4"],
        clean: Float[Array, "b h w 4"],
        sigma: Float[Array, "b h w 4"],
        *,
        train: bool,
        latent: Float[Array, "b l"] | None = None,
    ) -> tuple[Float[Array, "b y x 1"], Float[Array, "b h/8 w/8 c"]]:
        spectral, norm = (True, "instance") if self.literal else (self.spectral, self.norm)
        shared: dict[str, Any] = {
            "spectral": spectral,
            "initial": "torch" if self.literal else "he",
            "twice": True,
            "dtype": self.dtype,
        }
        if self.literal:
            x = pixels = jnp.concatenate([clean, noise], -1)
        else:
            x = pixels = in_sigma_units(clean, noise, sigma, level=self.level_input)
            if self.moments:
                size = jnp.abs(noise / sigma)
                x = pixels = jnp.concatenate([x, size, 4 * jnp.tanh(jnp.square(size) / 16)], -1)
            if self.rows:
                rows = jnp.mean(noise / sigma, 2, keepdims=True) * noise.shape[2] ** 0.5
                x = jnp.concatenate([x, jnp.broadcast_to(rows, noise.shape)], -1)
        for i, channels in enumerate((64, 128, 256), 1):
            kind = "none" if i == 1 else norm
            x = Block(scaled(self.width, channels), norm=kind, **shared, name=f"d{i}")(x, train=train)
        features = x
        if not self.literal:
            x = self._join(x, pixels, latent, train)
        scores = Conv(1, 4, 1, 1, use_bias=not self.literal, **shared, name="out")(x, train=train)
        if self.dtype is not None:
            scores, features = (v.astype(jnp.float32) for v in (scores, features))
        if self.literal and self.output_norm:
            scores = Norm("instance", name="out_norm")(scores)
        return scores, features

    def _join(self, x, pixels, latent, train):
        """d3 beside the pointwise branch and the latent, mixed once so that they can act on one another."""
        parts = [x]
        if self.hidden:
            for i in range(2):
                pixels = Conv(self.hidden, 1, spectral=False, use_bias=True, initial="he", name=f"p{i}")(
                    pixels, train=train
                )
                pixels = leaky_relu(pixels)
            batch, height, width, channels = pixels.shape
            cells = pixels.reshape(batch, height // 8, 8, width // 8, 8, channels)
            parts.append(jnp.mean(cells, (2, 4)))
        if latent is not None:
            parts.append(jnp.broadcast_to(latent[:, None, None], (*x.shape[:3], latent.shape[-1])))
        if len(parts) == 1:
            return x
        x = jnp.concatenate(parts, -1)
        x = Conv(
            scaled(self.width, 256), 1, spectral=self.spectral, use_bias=True, initial="he",
            dtype=self.dtype, name="mix",
        )(x, train=train)  # fmt: skip
        return leaky_relu(x)
