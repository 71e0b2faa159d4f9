"""How much of its noise a high-pass residual does not show, because neighbouring pixels are alike.

A camera that blends each pixel with its neighbours of one colour (denoising, crosstalk) leaves noise with
less of the high frequencies that a residual is made of: at a weight of 0.15 its standard deviation reads 12 %
low. The residual's own covariances tell. Those of white noise are the filter's; those of blended noise are
the filter's on the blend's spectrum, one curve with the weight as its parameter. Two things look similar and
are told apart by what the colour planes share, which is texture and never noise:

- texture that is left among the smooth blocks, whose covariances within and between the planes of a mosaic
  have much the same shape in every scene;
- the choice of smooth blocks itself, which favours those whose products are low by chance.

Both enter the weight's likelihood with amplitudes of their own, which are eliminated. One image says little,
so that half of the cameras count as leaving their pixels alone, and what is taken is the posterior's median.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

_LAGS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))
"""Up to sign and order of the axes."""
WEIGHTS = np.linspace(0, 0.4, 41)
"""Weights of the blend, as of the mechanism in_camera_denoising: 1 - w of a pixel, w / 4 of a neighbour."""
_TEXTURE = np.array([1, -0.41, 0.20, -0.13, 0.03, 0.04]), np.array([0.295, -0.05, 0.01, -0.115, 0.025, 0.035])
"""Covariances of the residual of noise-free training scenes, within and between planes."""
_CHOSEN = 0.042
"""What the choice of smooth blocks takes from the covariances of white noise, simulated."""
_RIDGE = 0.3
"""Shapes hold to about this much of the chance errors of one pixel, squared: combinations of lags that chance
leaves nearly free of error are not to be trusted as much."""
_INDEPENDENT = 0.5
"""Smooth parts are patches with edges, and texture varies: errors are larger than on a whole plane."""
_MOST_PIXELS = 3e4
"""More pixels do not say more: the shapes are not known better."""
_UNTOUCHED = 0.5
"""Prior share of cameras that blend nothing; the other weights are as likely as one another."""


def _filtered(size: int = 64):
    """Per frequency: cosines of the lags, power of the residual's filter, gain of each blend."""
    f = 2 * np.pi * np.fft.fftfreq(size)
    y, x = (v.ravel() for v in np.meshgrid(f, f, indexing="ij"))
    cosines = [(np.cos(a * y) * np.cos(b * x) + np.cos(b * y) * np.cos(a * x)) / 2 for a, b in _LAGS]
    power = np.square((2 - 2 * np.cos(y)) * (2 - 2 * np.cos(x))) / 36
    blend = 1 - WEIGHTS[:, None] + WEIGHTS[:, None] / 2 * (np.cos(y) + np.cos(x))
    return np.array(cosines), power, np.square(blend)


def _constants():
    """Covariances of the blends, their precision for one pixel without what texture and choice of blocks can
    explain, the choice's shape, and log ratio of the standard deviations of noise and residual."""
    cosines, power, gains = _filtered()
    blends = (power * gains) @ cosines.T / power.size
    # The errors of sample covariances (Bartlett), means over four planes and over their six pairs.
    chance = 2 * (cosines * np.square(power)) @ cosines.T / power.size
    none = np.zeros_like(chance)
    errors = np.block([[chance / 4, none], [none, chance / 12]]) + _RIDGE * np.eye(2 * len(_LAGS))
    chosen = cosines @ np.square(power)
    chosen = chosen / chosen[0]
    free = np.stack([np.concatenate(_TEXTURE), np.concatenate([0 * chosen, chosen])], 1)
    precision = np.linalg.inv(errors)
    precision -= precision @ free @ np.linalg.solve(free.T @ precision @ free, free.T @ precision)
    hidden = -0.5 * np.log(blends[:, 0] / np.mean(gains, 1))
    padded = np.concatenate([blends, 0 * blends], 1)
    return padded, padded @ precision, chosen, hidden


_BLENDS, _MATCHED, _CHOICE, _HIDDEN = _constants()
_SQUARE = np.sum(_MATCHED * _BLENDS, 1)
"""What the filter matched to each blend answers to it."""
_PRIOR = np.array([_UNTOUCHED, *np.full(len(WEIGHTS) - 1, (1 - _UNTOUCHED) / (len(WEIGHTS) - 1))])
"""By weight of the blend, none first."""


def hidden_level(
    residual: Float[Array, "n h w 4"], smooth: Float[Array, "n h w"]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(log of noise over residual, standard deviations; weight of the blend) of a camera: at least zero.

    residual: high-pass residuals of its images, in units of their own level; smooth: from 1 where they are
    noise to 0 where they hold texture. Packed colour planes of a mosaic.
    """
    within, between, pixels = _covariances(residual, smooth)
    seen = jnp.concatenate([within + _CHOSEN * within[0] * _CHOICE, between])
    likelihood = jnp.square(jnp.maximum(_MATCHED.astype(np.float32) @ seen, 0)) / _SQUARE
    count = 1 / (1 / (_INDEPENDENT * pixels + 1e-3) + 1 / _MOST_PIXELS)
    posterior = jnp.exp(count / 2 * (likelihood - jnp.max(likelihood))) * _PRIOR
    below = jnp.cumsum(posterior) / jnp.sum(posterior)
    return jnp.interp(0.5, below, _HIDDEN), jnp.interp(0.5, below, WEIGHTS)


def _covariances(z, smooth):
    """At each of the lags, mean over their signs and orders, products of two pixels of one plane and of two
    planes, weighted by how smooth both places are; and how many pixels are."""
    channels = z.shape[-1]
    total = jnp.sum(z, -1)
    made = []
    for lags in ({(a, b), (b, a), (a, -b), (b, -a)} for a, b in _LAGS):
        # (y, x) and (-y, -x) are one.
        ways = sorted({max((y, x), (-y, -x)) for y, x in lags})
        sums = [_products(z, total, smooth, *way) for way in ways]
        own, whole, weight = (sum(s[i] for s in sums) for i in range(3))
        made.append(jnp.stack([own / channels, (whole - own) / (channels * (channels - 1))]) / (weight + 20))
        if lags == {(0, 0)}:
            pixels = weight
    within, between = jnp.stack(made, -1)
    return within, between, pixels


def _products(z, total, smooth, y: int, x: int):
    """Sums over pixel pairs y rows, x columns apart: products of one plane, of all planes, of weights."""
    _, h, w = total.shape
    left, right = slice(max(-x, 0), w - max(x, 0)), slice(max(x, 0), w - max(-x, 0))
    first, second = (slice(None), slice(0, h - y), left), (slice(None), slice(y, h), right)
    weight = smooth[first] * smooth[second]
    own = jnp.sum(jnp.sum(z[first] * z[second], -1) * weight)
    return own, jnp.sum(total[first] * total[second] * weight), jnp.sum(weight)
