"""The layers under the networks, in PyTorch and for comparison only: `networks.layers` with equal weights.

Plain functions of nested dictionaries of tensors, as the Flax variables are; maps are `[b, c, h, w]`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

LEAK = 0.2


class Weights(NamedTuple):
    """Parameters and spectral vectors of a network or a part of it."""

    params: dict[str, Any]
    spectral: dict[str, Any]

    def at(self, name: str) -> Weights:
        """Those of a layer."""
        return Weights(self.params[name], self.spectral.get(name, {}))


def weights(variables: Mapping[str, Any], dtype: torch.dtype = torch.float32) -> Weights:
    """The variables of a Flax network of NumPy arrays, its kernels as PyTorch lays them out."""
    return Weights(
        _converted(variables["params"], (), dtype), _converted(variables.get("spectral", {}), (), dtype)
    )


def is_transposed(path: tuple[str, ...]) -> bool:
    """Whether a layer of G upsamples: t1 to t4 and the last one."""
    return "unet" in path and (path[-1] == "out" or any(p in ("t1", "t2", "t3", "t4") for p in path))


def _converted(tree: Mapping[str, Any], path: tuple[str, ...], dtype) -> dict[str, Any]:
    made: dict[str, Any] = {}
    for name, value in tree.items():
        if isinstance(value, Mapping):
            made[name] = _converted(value, (*path, name), dtype)
            continue
        array = np.asarray(value)
        if name == "kernel" and array.ndim == 4:
            array = array.transpose((2, 3, 0, 1) if is_transposed(path) else (3, 2, 0, 1))
        elif name == "kernel":
            array = array.T
        made[name] = torch.tensor(np.ascontiguousarray(array), dtype=dtype)
    return made


def spectral_in_order(variables: Mapping[str, Any]) -> dict[str, Any]:
    """The Flax variables with spectral vectors `v` in PyTorch's order of a kernel's rest: input, row, column
    in place of row, column, input."""

    def walk(params, spectral):
        made = {name: walk(params[name], s) for name, s in spectral.items() if isinstance(s, Mapping)}
        if "v" in spectral:
            size, _, inputs, _ = params["kernel"].shape
            v = np.asarray(spectral["v"]).reshape(size, size, inputs)
            made |= {"u": np.asarray(spectral["u"]), "v": v.transpose(2, 0, 1).reshape(-1)}
        return made

    return {
        "params": variables["params"],
        "spectral": walk(variables["params"], variables.get("spectral", {})),
    }


def conv(
    w: Weights, x, stride: int, padding: int, *, train: bool, keep: bool = False, transposed: bool = False
):
    """A convolution, divided by its kernel's largest singular value where it has spectral vectors. train: one
    power iteration first; keep: store its vectors."""
    kernel = w.params["kernel"]
    if w.spectral:
        kernel = kernel / _sigma(kernel, w.spectral, train, keep, transposed)
    bias = w.params.get("bias")
    if transposed:
        return F.conv_transpose2d(x, kernel, bias, stride=2, padding=1)
    return F.conv2d(x, kernel, bias, stride=stride, padding=padding)


def folded(w: Weights, path: tuple[str, ...] = ()) -> Weights:
    """The network with every kernel divided by its singular value for good, as for use after training."""
    params = dict(w.params)
    for name in w.spectral:
        if name not in ("u", "v"):
            params[name] = folded(w.at(name), (*path, name)).params
    if "u" in w.spectral:
        kernel = params["kernel"]
        params["kernel"] = kernel / _sigma(kernel, w.spectral, False, False, is_transposed(path))
    return Weights(params, {})


def _sigma(kernel, spectral, train, keep, transposed):
    matrix = (kernel.transpose(0, 1) if transposed else kernel).flatten(1)
    u, v = spectral["u"], spectral["v"]
    if train:
        with torch.no_grad():
            v = F.normalize(u @ matrix, dim=0, eps=1e-12)
            u = F.normalize(matrix @ v, dim=0, eps=1e-12)
            if keep:
                spectral["u"], spectral["v"] = u, v
    return u @ (matrix @ v)


def instance_norm(w: Weights, x):
    """Per image and channel; the bias alone on maps of one pixel."""
    scale, bias = w.params["scale"], w.params["bias"]
    if x.shape[2] * x.shape[3] == 1:
        return bias[None, :, None, None].expand_as(x)
    return F.instance_norm(x, weight=scale, bias=bias, eps=1e-5)


def channel_norm(w: Weights, x):
    """Per pixel, over the channels."""
    centred = x - x.mean(1, keepdim=True)
    normed = centred * torch.rsqrt(centred.square().mean(1, keepdim=True) + 1e-5)
    return normed * w.params["scale"][:, None, None] + w.params["bias"][:, None, None]


NORMS = {"instance": instance_norm, "channel": channel_norm, "none": lambda w, x: x}


def block(
    w: Weights,
    x,
    size: int = 4,
    stride: int = 2,
    padding: int = 1,
    *,
    norm: str,
    train: bool,
    keep: bool = False,
    transposed: bool = False,
    activate: bool = True,
):
    """Convolution, norm, leaky rectifier."""
    x = conv(w.at("conv"), x, stride, padding, train=train, keep=keep, transposed=transposed)
    if norm != "none":
        x = NORMS[norm](w.at("norm"), x)
    return F.leaky_relu(x, LEAK) if activate else x
