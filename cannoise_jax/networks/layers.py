"""The layers under every network here: normalised convolutions, norms, the paper's block of them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from jax import lax
from jaxtyping import Array, Float

from cannoise_jax.networks.convolutions import conv2d, conv_transpose2d

LEAK = 0.2
"""Slope of every leaky rectifier (reference release)."""


def leaky_relu(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """max(x, 0.2 x)."""
    return jnp.maximum(x, LEAK * x)


def bent(noise: Float[Array, "*s"], knee: float) -> Float[Array, "*s"]:
    """Noise in units of its sigma as it is up to the knee, and logarithmic beyond (its slope goes on): a hot
    pixel of a hundred sigma then counts, and not alone. A knee of zero: nothing is bent."""
    if not knee:
        return noise
    size = jnp.abs(noise)
    return jnp.sign(noise) * jnp.where(size < knee, size, knee * (1 + jnp.log(jnp.maximum(size / knee, 1.0))))


def spectral_norm(
    kernel: Float[Array, "k k i o"], u: Float[Array, "o"], v: Float[Array, "k*k*i"], *, iterate: bool
) -> tuple[Float[Array, ""], Float[Array, "o"], Float[Array, "k*k*i"]]:
    """Largest singular value of the kernel as a matrix out x rest, by power iteration from (u, v).

    iterate: one iteration first (training); otherwise sigma = u' W v with the vectors as they are. The
    vectors are constants for differentiation. The same matrix serves transposed kernels (their dim 1 in
    PyTorch is out). Miyato et al. 2018, as in `torch.nn.utils.spectral_norm`, eps 1e-12.
    """
    matrix = kernel.reshape(-1, kernel.shape[-1])
    if iterate:
        frozen = lax.stop_gradient(matrix)
        v = _unit(frozen @ u)
        u = _unit(v @ frozen)
    return (v @ matrix) @ u, u, v


def _unit(x):
    return x / jnp.maximum(jnp.linalg.norm(x), 1e-12)


def instance_norm(
    x: Float[Array, "b h w c"], scale: Float[Array, "c"], bias: Float[Array, "c"]
) -> Float[Array, "b h w c"]:
    """Per image and channel: zero mean, unit biased variance (eps 1e-5), then scale and bias.

    On 1x1 maps every value is its own mean: the result is `bias`, whatever the input.
    """
    if x.shape[1] * x.shape[2] == 1:
        return jnp.broadcast_to(bias, x.shape)
    return _normalise(x, (1, 2)) * scale + bias


def channel_norm(
    x: Float[Array, "b h w c"], scale: Float[Array, "c"], bias: Float[Array, "c"]
) -> Float[Array, "b h w c"]:
    """Per pixel, over the channels: zero mean, unit variance (eps 1e-5), then scale and bias.

    Nothing crosses pixels, so a network with this norm gives the same answer on a tile as on the whole image.
    """
    return _normalise(x, (-1,)) * scale + bias


def _normalise(x, axes):
    centred = x - jnp.mean(x, axes, keepdims=True)
    return centred * lax.rsqrt(jnp.mean(jnp.square(centred), axes, keepdims=True) + 1e-5)


def _at_least_single(x):
    """In float32 where it has fewer bits: sums over many pixels need them."""
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


class Norm(nn.Module):
    """`kind`: "instance", "channel", or "none" (no parameters)."""

    kind: str

    @nn.compact
    def __call__(self, x: Float[Array, "b h w c"]) -> Float[Array, "b h w c"]:
        if self.kind == "none":
            return x
        scale = self.param("scale", nn.initializers.ones, (x.shape[-1],))
        bias = self.param("bias", nn.initializers.zeros, (x.shape[-1],))
        norm = {"instance": instance_norm, "channel": channel_norm}[self.kind]
        return norm(_at_least_single(x), scale, bias).astype(x.dtype)


# PyTorch's default for convolutions, uniform on +-1/sqrt(fan in), and the one that keeps the signal's
# variance.
torch_init = nn.initializers.variance_scaling(1 / 3, "fan_in", "uniform")
he_init = nn.initializers.variance_scaling(2 / (1 + LEAK**2), "fan_in", "truncated_normal")
INITS = {"torch": torch_init, "he": he_init, "zeros": nn.initializers.zeros}


class Conv(nn.Module):
    """A convolution, or a transposed one (4x4, stride 2, padding 1), optionally spectrally normalised.

    spectral: divides by the kernel's largest singular value; the vectors live in the collection `spectral`
    and move only when that is mutable and `train` is true; without that collection the kernel is taken as
    normalised already (see `fold_spectral_norm`). twice: a gradient of this layer will be
    differentiated again. dtype: of the products and of what is returned, as "bfloat16"; None: that of
    the input. Parameters keep their own.
    """

    features: int
    size: int
    stride: int = 1
    padding: int = 0
    transposed: bool = False
    spectral: bool = True
    use_bias: bool = False
    initial: str = "torch"
    twice: bool = False
    dtype: str | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "b h w i"], *, train: bool) -> Float[Array, "b y x o"]:
        shape = (self.size, self.size, x.shape[-1], self.features)
        kernel = self.param("kernel", INITS[self.initial], shape)
        normalised = self.spectral and (self.is_initializing() or self.has_variable("spectral", "u"))
        sigma = self._sigma(kernel, train) if normalised else None
        if self.dtype is not None:
            # Divided before it is rounded: sigma in few bits would scale the whole layer wrongly.
            kernel, sigma = (kernel if sigma is None else kernel / sigma), None
            x, kernel = x.astype(self.dtype), kernel.astype(self.dtype)
        if self.transposed:
            y = conv_transpose2d(x, kernel)
        else:
            y = conv2d(x, kernel, self.stride, self.padding, twice=self.twice)
        if sigma is not None:
            # Scaling the output is the same as scaling the kernel, and far less to write.
            y = y / sigma
        if self.use_bias:
            y = y + self.param("bias", nn.initializers.zeros, (self.features,)).astype(y.dtype)
        return y

    def _sigma(self, kernel, train):
        def start():
            matrix = kernel.reshape(-1, self.features)
            u = _unit(jax.random.normal(self.make_rng("params"), (self.features,), kernel.dtype))
            v = jnp.zeros(matrix.shape[0], kernel.dtype)
            # PyTorch starts from random vectors; a few iterations make evaluation right from the first step.
            return lax.fori_loop(0, 15, lambda _, s: spectral_norm(kernel, *s, iterate=True)[1:], (u, v))

        started = start() if self.is_initializing() else (None, None)
        u: Any = self.variable("spectral", "u", lambda: started[0])
        v: Any = self.variable("spectral", "v", lambda: started[1])
        sigma, new_u, new_v = spectral_norm(kernel, u.value, v.value, iterate=train)
        if train and self.is_mutable_collection("spectral") and not self.is_initializing():
            u.value, v.value = new_u, new_v
        return sigma


class Block(nn.Module):
    """Convolution, norm, leaky rectifier: one row of the paper's tables."""

    features: int
    size: int = 4
    stride: int = 2
    padding: int = 1
    transposed: bool = False
    spectral: bool = True
    norm: str = "instance"
    initial: str = "torch"
    activate: bool = True
    twice: bool = False
    dtype: str | None = None

    @nn.compact
    def __call__(self, x: Float[Array, "b h w i"], *, train: bool) -> Float[Array, "b y x o"]:
        x = Conv(
            self.features, self.size, self.stride, self.padding, self.transposed, self.spectral,
            use_bias=self.norm == "none" and self.initial != "torch", initial=self.initial, twice=self.twice,
            dtype=self.dtype, name="conv",
        )(x, train=train)  # fmt: skip
        x = Norm(self.norm, name="norm")(x)
        return leaky_relu(x) if self.activate else x


def scaled(width: float, channels: int) -> int:
    """The paper's channel count at this width, at least 4."""
    return max(4, round(width * channels))


def fold_spectral_norm(variables: dict[str, Any]) -> dict[str, Any]:
    """The same network with every kernel divided by its singular value, and no `spectral` collection.

    Applied by the same module, it gives what the unfolded variables give with `train=False`.
    """

    def fold(params, spectral):
        folded = dict(params)
        for name, state in spectral.items():
            if name in ("u", "v"):
                continue
            folded[name] = fold(params[name], state)
        if "u" in spectral:
            kernel = params["kernel"]
            folded["kernel"] = kernel / spectral_norm(kernel, spectral["u"], spectral["v"], iterate=False)[0]
        return folded

    return {"params": fold(variables["params"], variables.get("spectral", {}))}
