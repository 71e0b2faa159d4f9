"""The denoiser that noise models are judged by: DnCNN of 9 layers (Zhang et al. 2017), on packed raw images.

As in the evaluation of Chang et al. 2020: 3x3 convolutions, batch norm in the seven layers between the first
and the last, and the network's output is what it takes away from the noisy image. At 64 features it has
264,068 parameters. The last layer starts at zero, so that training starts from the noisy image itself: from
the release's normal weights a few hundred steps do not even get back to it.
"""

from __future__ import annotations

import jax
from flax import linen as nn
from jaxtyping import Array, Float

from cannoise_jax.networks.layers import Conv


class DnCNN(nn.Module):
    """Noisy to clean, packed `[b, h, w, 4]` of any size. Collections: `params`, `batch_stats`.

    depth: layers, of which the receptive field is 2 depth + 1 packed pixels; features: of every hidden layer.
    momentum: of the running statistics, 0.9 as in the release; train: use and update those of the batch.
    """

    depth: int = 9
    features: int = 64
    momentum: float = 0.9

    @nn.compact
    def __call__(self, noisy: Float[Array, "b h w 4"], *, train: bool) -> Float[Array, "b h w 4"]:
        x = noisy
        for i in range(self.depth - 1):
            x = Conv(self.features, 3, 1, 1, spectral=False, use_bias=True, initial="he", name=f"c{i}")(
                x, train=train
            )
            if i:
                x = nn.BatchNorm(not train, momentum=self.momentum, epsilon=1e-5, name=f"n{i}")(x)
            x = jax.nn.relu(x)
        x = Conv(noisy.shape[-1], 3, 1, 1, spectral=False, use_bias=True, initial="zeros", name="out")(
            x, train=train
        )
        return noisy - x

    @property
    def reach(self) -> int:
        """Packed pixels beyond its place that an output pixel depends on, on every side."""
        return self.depth
