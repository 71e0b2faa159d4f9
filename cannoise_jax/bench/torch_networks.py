"""G, E and D with the paper's tables, in PyTorch and for comparison only: `networks` with equal weights. Maps
are `[b, c, h, w]`. train, keep: see `torch_layers.conv`."""

from __future__ import annotations

import torch

from cannoise_jax.bench.torch_layers import Weights, block, conv, instance_norm


def encoder(w: Weights, noisy, *, train: bool, keep: bool = False):
    """The latents of noisy images, `[b, l]`."""
    x = noisy
    for i in range(1, 5):
        shape = (7, 1, 3) if i == 1 else (4, 2, 1)
        norm = "none" if i == 1 else "instance"
        x = block(w.at(f"e{i}"), x, *shape, norm=norm, train=train, keep=keep)
    return x.mean((2, 3))


def generator(w: Weights, clean, n_init, latent, *, train: bool, keep: bool = False):
    """The noise, like the initial noise in shape."""
    x = unet(w.at("unet"), torch.cat([clean, n_init], 1), latent, train=train, keep=keep)
    return n_init + torch.tanh(x)


def unet(w: Weights, x, latent, *, train: bool, keep: bool = False):
    """c1 to c5, four residual blocks, t1 to t4 and the last deconvolution with its norm."""
    told = {"train": train, "keep": keep}
    skips = []
    for i in range(1, 6):
        x = block(w.at(f"c{i}"), x, norm="none" if i == 1 else "instance", **told)
        skips.append(x)
    for i in range(1, 5):
        if i == 3:
            spread = latent[:, :, None, None].expand(-1, -1, *x.shape[2:])
            x = torch.cat([x, spread], 1)
        part = w.at(f"res{i}")
        y = block(part.at("first"), x, 3, 1, 1, norm="instance", activate=False, **told)
        x = x + conv(part.at("second"), y, 1, 1, **told)
    for i in range(1, 5):
        x = block(w.at(f"t{i}"), x, norm="instance", transposed=True, **told)
        x = torch.cat([x, skips[4 - i]], 1)
    x = conv(w.at("out"), x, 2, 1, transposed=True, **told)
    return _last_norm(w, x)


def critic(w: Weights, noise, clean, *, train: bool, keep: bool = False):
    """Scores and features of noise beside its clean image."""
    x = torch.cat([clean, noise], 1)
    for i in range(1, 4):
        x = block(w.at(f"d{i}"), x, norm="none" if i == 1 else "instance", train=train, keep=keep)
    scores = conv(w.at("out"), x, 1, 1, train=train, keep=keep)
    return _last_norm(w, scores), x


def _last_norm(w: Weights, x):
    """The table's norm of the output, where the network has it."""
    return instance_norm(w.at("out_norm"), x) if "out_norm" in w.params else x
