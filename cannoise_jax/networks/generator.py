"""The noise generator G: Table A-1 of Chang et al. 2020, and the version of it that trains.

Why the table is not the default. Its last layer (instance norm, then tanh) pins the mean and spread of the
residual to two learned numbers per channel, whatever the ISO, and they start at 0.63 where real noise is
0.01; instance norm in the hidden layers erases the level of the noise, and its statistics differ between a
training patch and a whole image. The default therefore
- sees noise in units of the initial noise's standard deviation sigma, and sigma itself beside it;
- changes the initial noise by factors: n = n_init exp(tanh a) + sigma tanh b + row noise, with a, b and the
  row gain zero at the start, so that training begins at n = n_init exactly;
- normalises over channels at each pixel instead of over pixels;
- makes what is known to be in a camera by small branches that each have one parameter of it (`branches`):
  the latent sets levels, tails, rows, columns, neighbours and offsets, the networks add what is left;
- ends in a small full-resolution branch, modulated by the latent and the image's noise level function: at
  small widths the U-Net's first layer has fewer channels than pixels under its stride, and no pointwise
  function (a camera's level, tails, offset) could pass it;
- draws numbers per sensor row and column. White initial noise has no such structure, and a convolution of
  finite reach cannot make any.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import lax
from jaxtyping import Array, Float, Key

from cannoise_jax.networks.branches import (
    LEAST_READ,
    LEAST_SHOT,
    OUTPUTS,
    Draws,
    NoiseLevel,
    Physics,
    branch_draws,
    physical_noise,
    physics_of,
)
from cannoise_jax.networks.layers import Block, Conv, Norm, bent, he_init, leaky_relu, scaled

KNEE = 4.0
"""Sigma from which on the U-Net and the pixel branch see noise by its logarithm only."""


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions and a skip: conv, SN, norm, conv, SN (no activation inside, as released)."""

    spectral: bool = True
    norm: str = "instance"
    literal: bool = True
    dtype: str | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"], *, train: bool) -> Float[Array, "b h w c"]:
        shared: dict[str, Any] = {
            "spectral": self.spectral,
            "initial": "torch" if self.literal else "he",
            "dtype": self.dtype,
        }
        y = Block(
            x.shape[-1], 3, 1, 1, norm=self.norm, activate=not self.literal, **shared, name="first"
        )(x, train=train)  # fmt: skip
        return x + Conv(x.shape[-1], 3, 1, 1, **shared, name="second")(y, train=train)


class UNet(nn.Module):
    """c1..c5, four residual blocks with the latent joined after the second, t1..t4 and a last deconvolution.

    Height and width must be multiples of 32. The channel counts are the table's, times `width`.
    """

    width: float
    outputs: int
    spectral: bool
    norm: str
    literal: bool
    output_norm: bool = True
    dtype: str | None = None

    @nn.compact
    def __call__(
        self, x: Float[Array, "b h w i"], latent: Float[Array, "b l"], *, train: bool
    ) -> Float[Array, "b h w o"]:
        shared: dict[str, Any] = {
            "spectral": self.spectral,
            "initial": "torch" if self.literal else "he",
            "dtype": self.dtype,
        }
        full = x.dtype
        skips = []
        for i, channels in enumerate((64, 128, 256, 512, 512), 1):
            norm = "none" if i == 1 else self.norm
            x = Block(scaled(self.width, channels), norm=norm, **shared, name=f"c{i}")(x, train=train)
            skips.append(x)
        for i in range(1, 5):
            if i == 3:
                spread = jnp.broadcast_to(latent[:, None, None], (*x.shape[:3], latent.shape[-1]))
                x = jnp.concatenate([x, spread], -1)
            x = ResidualBlock(self.spectral, self.norm, self.literal, self.dtype, name=f"res{i}")(
                x, train=train
            )
        for i, channels in enumerate((512, 256, 128, 64), 1):
            x = Block(
                scaled(self.width, channels), transposed=True, norm=self.norm, **shared, name=f"t{i}"
            )(x, train=train)  # fmt: skip
            x = jnp.concatenate([x, skips[4 - i]], -1)
        x = Conv(self.outputs, 4, transposed=True, **shared, name="out")(x, train=train).astype(full)
        return Norm("instance", name="out_norm")(x) if self.literal and self.output_norm else x


class PixelBranch(nn.Module):
    """Full-resolution 3x3 and 1x1 layers whose channels `told` scales and shifts; starts at zero.

    direct: `told` also sets every output for the whole image at once.
    """

    hidden: int
    outputs: int
    direct: bool = True

    @nn.compact
    def __call__(
        self, x: Float[Array, "b h w i"], told: Float[Array, "b l"], *, train: bool
    ) -> Float[Array, "b h w o"]:
        for i, size in enumerate((3, 1)):
            x = Conv(
                self.hidden, size, 1, size // 2, spectral=False, use_bias=True, initial="he", name=f"p{i}"
            )(x, train=train)  # fmt: skip
            film = nn.Dense(2 * self.hidden, kernel_init=nn.initializers.normal(0.05), name=f"film{i}")(told)
            gain, shift = jnp.split(film[:, None, None], 2, -1)
            x = leaky_relu(x * (1 + gain) + shift)
        x = Conv(self.outputs, 1, spectral=False, use_bias=True, initial="zeros", name="out")(x, train=train)
        if self.direct:
            whole = nn.Dense(self.outputs, False, kernel_init=nn.initializers.zeros, name="direct")(told)
            x = x + whole[:, None, None]
        return x


class Generator(nn.Module):
    """Noise like a camera's from a clean image, initial noise and the camera's latent.

    width: scales every channel count; 1.0 is the paper's. literal: Table A-1 as printed (68,053,640
    parameters: no biases, affine instance norms after every "SN-IN" layer and one inside each residual block,
    spectral norm on every layer as released); all further fields are then unused.
    spectral, norm ("channel", "instance", "none"): of the U-Net. hidden: channels of the full-resolution
    branch. level_input: show log sigma to G. Without it G can know the camera from the latent only.
    setting_input: show the full-resolution branch the image's noise level function, beside the camera, and
    whether that function was handed over (`known`: 1) or estimated from the references (0, or None).
    direct: also let both set factor, shift and row gain of each channel for the whole image at once.
    row_noise: add noise common to a sensor row; needs the random stream `noise`.
    physics: the branches; they replace `direct` and `row_noise`, and need the stream `noise`. Their
    parameters are sown into the collection `physics`. residue: the networks after them. output_norm: of the
    literal table's last layer, with which no level can be learned. dtype: of the U-Net's convolutions, as
    `Conv` has it.

    Returns noise in normalised units, not clipped. Height and width must be multiples of 32. For a tile of an
    image, summary: that of the whole image; draws: its part of those of the whole image; lines=False:
    `(noise without row offsets, their sizes)`, the sizes to be averaged over whole rows and multiplied by
    `row_draws`; part: only that part of the tile, `(first row and column, size)`, so that full-resolution
    layers spare the surroundings. The outermost pixels of the part are wrong unless they are the tile's own.
    """

    width: float = 1.0
    literal: bool = False
    spectral: bool = True
    norm: str = "channel"
    hidden: int = 32
    level_input: bool = True
    row_noise: bool = True
    setting_input: bool = True
    direct: bool = True
    physics: bool = True
    residue: bool = True
    output_norm: bool = True
    dtype: str | None = None

    @nn.compact
    def __call__(
        self,
        clean: Float[Array, "b h w 4"],
        n_init: Float[Array, "b h w 4"],
        latent: Float[Array, "b l"],
        sigma: Float[Array, "b h w 4"],
        *,
        train: bool,
        level: NoiseLevel | None = None,
        summary: Float[Array, "b s"] | None = None,
        draws: Draws | None = None,
        lines: bool = True,
        part: tuple[Any, tuple[int, int]] | None = None,
    ) -> Any:
        if self.literal:
            x = jnp.concatenate([clean, n_init], -1)
            unet = UNet(self.width, 4, True, "instance", True, self.output_norm, self.dtype, name="unet")
            noise = _part(n_init + jnp.tanh(unet(x, latent, train=train)), part)
            return noise if lines else (noise, jnp.zeros_like(noise))
        told = latent * latent.shape[-1] ** 0.5
        level = _as_noise(sigma) if level is None else level
        if self.setting_input:
            # An estimate from n images varies as 1 / n, so that more of them than training shows are no leap.
            source = jnp.stack([level.known, (1 - level.known) * (1 - 1 / level.shown)], -1)
            summary = setting_summary(clean, sigma) if summary is None else summary
            told = jnp.concatenate([told, summary, level_summary(level), source], -1)
        if self.physics:
            physics = self._physics(told)
            if draws is None:
                draws = branch_draws(self.make_rng("noise"), n_init.shape)
            n_init = physical_noise(draws, n_init / sigma, clean, level, physics)
            if not self.residue:
                n_init = _part(n_init, part)
                return n_init if lines else (n_init, jnp.zeros_like(n_init))
        noise, row = self._networks(clean, n_init, latent, sigma, told, train, part)
        if not lines:
            return noise, _part(sigma, part) * row
        if self.row_noise and not self.physics:
            offsets = row_draws(self.make_rng("noise"), *noise.shape[:2])
            noise = noise + jnp.mean(sigma * row, 2, keepdims=True) * offsets
        return noise

    def _physics(self, told) -> Physics:
        """The branches' parameters for what is told."""
        for i in range(2):
            told = leaky_relu(nn.Dense(4 * self.hidden, kernel_init=he_init, name=f"physics{i}")(told))
        physics = physics_of(nn.Dense(OUTPUTS, kernel_init=nn.initializers.zeros, name="physics")(told))
        self.sow("physics", "parameters", physics)
        return physics

    def _networks(self, clean, noise, latent, sigma, told, train, part):
        """The U-Net and the full-resolution branch: noise, and the sizes of row offsets beside it."""
        # A hot pixel of a hundred sigma would mark whatever the networks reach around it.
        seen = sigma * bent(noise / sigma, KNEE)
        x = in_sigma_units(clean, seen, sigma, level=self.level_input)
        unet = UNet(self.width, 8, self.spectral, self.norm, False, dtype=self.dtype, name="unet")
        features = unet(x, latent, train=train)
        x, features, noise, sigma = (_part(v, part) for v in (x, features, noise, sigma))
        x = jnp.concatenate([x, features], -1)
        # One hidden layer: how far a camera is from its published noise differs from setting to setting.
        told = leaky_relu(nn.Dense(2 * self.hidden, kernel_init=he_init, name="told")(told))
        direct, rows = (setting and not self.physics for setting in (self.direct, self.row_noise))
        maps = PixelBranch(self.hidden, 12 if rows else 8, direct, name="pixels")(x, told, train=train)
        factor, shift, *row = (jnp.tanh(maps[..., i : i + 4]) for i in range(0, maps.shape[-1], 4))
        noise = noise * jnp.exp(factor) + sigma * shift
        if not rows:
            return noise, jnp.zeros_like(noise)
        return noise, row[0]


def _part(values, part):
    """Of images the part that is wanted, `(first row and column, size)`; all of them for None."""
    if part is None:
        return values
    (y, x), (height, width) = part
    count, _, _, channels = values.shape
    return lax.dynamic_slice(values, (0, y, x, 0), (count, height, width, channels))


def row_draws(key: Key[Array, ""], images: int, rows: int) -> Float[Array, "b h 1 4"]:
    """One standard normal draw a sensor row: R and Gr share the row above, Gb and B the one below."""
    return jnp.repeat(jax.random.normal(key, (images, rows, 1, 2)), 2, -1)


def _as_noise(sigma) -> NoiseLevel:
    """The level where none is told: all of it read noise."""
    read = jnp.mean(jnp.square(sigma), (1, 2))
    count = sigma.shape[0]
    return NoiseLevel(jnp.zeros_like(read), read, jnp.zeros(count), jnp.ones(count))


def level_summary(level: NoiseLevel) -> Float[Array, "b 2"]:
    """Logs of shot and of read noise in electrons, of about -1.5..1.5."""
    shot = jnp.mean(jnp.log(jnp.maximum(level.shot, LEAST_SHOT)), -1)
    read = jnp.mean(jnp.log(jnp.maximum(level.read, LEAST_READ)), -1)
    return jnp.stack([(shot + 6) / 1.5, (read / 2 - shot - 0.5) / 1.5], -1)


def setting_summary(clean: Float[Array, "b h w 4"], sigma: Float[Array, "b h w 4"]) -> Float[Array, "b s"]:
    """The noise level function of each image in three numbers of about -1.5..1.5: mean log of variance over
    signal, the signal raised by a little (the shot coefficient), more, and most (the variance itself)."""
    variance, signal = jnp.square(sigma), jnp.maximum(clean, 0)
    toes = (0.002, 0.02, 0.2)
    means = [jnp.mean(jnp.log(variance / (signal + toe)), (1, 2, 3)) for toe in toes]
    return (jnp.stack(means, -1) + 6) / 1.5


def in_sigma_units(
    clean: Float[Array, "b h w 4"],
    noise: Float[Array, "b h w 4"],
    sigma: Float[Array, "b h w 4"],
    *,
    level: bool,
) -> Float[Array, "b h w c"]:
    """What G and D see: clean, noise / sigma and, if `level`, log sigma brought to about -1.5..1.5."""
    parts = [clean, noise / sigma]
    if level:
        parts.append((jnp.log(sigma) + 4.5) / 1.5)
    return jnp.concatenate(parts, -1)
