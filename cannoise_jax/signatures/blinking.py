"""The pixels of darks that jump between levels: how many, by how much, and which."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.charge_noise import own_charge
from cannoise_jax.signatures.handed import Many
from cannoise_jax.signatures.jump_law import (
    NOISY,
    Kinds,
    Law,
    jump_laws,
    jumping_pixels,
    kinds_of,
    share_and_mean,
)
from cannoise_jax.signatures.jumps import frames_of
from cannoise_jax.signatures.known_shape import darks
from cannoise_jax.signatures.remembered import Kept
from cannoise_jax.signatures.squares import dark_sigma, square_map
from cannoise_jax.signatures.two_levels import log_ratio_of_two

_MOST = 60_000
"""Values of noisy pixels that are looked at."""


_MOST_NATS = 20.0
"""What one pixel may count on other frames: a hit there is no jump."""
_LONGER = 0.05
"""Relative error of the rms of jumps beside chance: traps that change seldom have up to a tenth more of it
than the frames of a recording show."""


_MAPS: Kept[Float[np.ndarray, "h w"]] = Kept(4)
"""The last maps of pixels that jump."""


class Expected(NamedTuple):
    """Of pixels that were looked at, where, the chance that they jump, and the distance of the levels and the
    variance by it if they do, in units of the noise."""

    at: Int[np.ndarray, "k"]
    chance: Float[np.ndarray, "k"]
    jump: Float[np.ndarray, "k"]
    variance: Float[np.ndarray, "k"]


NONE_EXPECTED = Expected(np.zeros(0, int), *np.zeros((3, 0)))
"""No pixel is."""


class Blinking(NamedTuple):
    """Share of the pixels that jump, mean distance of their levels, DN, and rms of the jumps over all pixels,
    DN, each with its error; and what is expected of the pixels that were looked at."""

    share: tuple[float, float]
    jump: tuple[float, float]
    rms: tuple[float, float]
    pixels: Expected


class _Looked(NamedTuple):
    """The noisy pixels: where, their sums of squares over those of most, the limit of these and their degrees
    of freedom; by how much the noise of most is more than it was taken to be; and how many pixels there are.
    """

    at: Int[np.ndarray, "k"]
    squares: Float[np.ndarray, "k"]
    limit: float
    freedom: int
    louder: float
    pixels: int


def blinking(fields: Many) -> Blinking | None:
    """What the darks tell; None where they do not tell noise."""
    fields = _among_themselves(fields)
    looked = _looked(fields)
    if looked is None:
        return None
    step, own, kinds, laws = _fitted(fields, looked)
    told = jumping_pixels(kinds, laws)
    excess = np.maximum(own / looked.freedom - 1, 0.0)
    inside = step * np.array([told.chance @ excess, np.sqrt(told.chance @ excess**2)]) / looked.pixels
    sigma = dark_sigma(tuple(darks(fields))) * looked.louder
    share, mean = share_and_mean(laws, looked.pixels // step)
    # What those below the limit have is about as much as the others seem to have more by chance.
    root = float(np.sqrt(inside[0]))
    error = float(np.hypot(inside[1] / (2 * max(root, 1e-12)), _LONGER * root))
    rms = sigma * root, sigma * error
    expected = Expected(looked.at[::step], told.chance, told.jump, told.variance)
    return Blinking(share, (mean[0] * sigma, mean[1] * sigma), rms, expected)


def blinking_again(fields: Many, expected: Expected) -> tuple[float, float, float] | None:
    """On other frames, by how much the variance of the pixels that are expected to jump is that of jumps, as
    a share of what is expected, its error, and the nats by which their frames are as expected rather than
    noise alone; None where there are no such frames."""
    own = _among_themselves(fields)
    looked = _looked(own)
    if looked is None or not expected.at.size:
        return None
    frames = [_unbiased(x) / looked.louder for x in frames_of(darks(own), expected.at, own_charge(own))]
    usable = np.all([f.usable for f in darks(own)], axis=0).ravel()[expected.at]
    squares = sum((np.sum(x**2, 0) for x in frames), start=np.zeros(expected.at.size))
    power = expected.chance * expected.variance * usable
    whole = float(np.sum(power**2))
    if not whole > 0:
        return None
    share = float(power @ (squares / looked.freedom - 1)) / whole
    noise = 2 * (1 + expected.variance) ** 2 / looked.freedom
    error = float(np.sqrt(power**2 @ (noise + expected.variance**2 * (1 - expected.chance)))) / whole
    ratio = np.clip(log_ratio_of_two(frames, expected.jump), -_MOST_NATS, _MOST_NATS)
    return share, error, float(np.sum(np.log1p(usable * expected.chance * np.expm1(ratio))))


def _among_themselves(fields: Many) -> Many:
    """Without what the frames differ by from those before."""
    return tuple(
        f._replace(contrasts=f.contrasts[: f.frames - 1], before=0) if f.before else f for f in fields
    )


def blinking_map(fields: Many) -> Float[np.ndarray, "h w"]:
    """The temporal standard deviation by their jumps of the pixels that more likely jump than not, DN; 0 in
    all others. Read-only: every model with a finding has the same."""
    read = [v for f in fields for v in (f.contrasts, f.static, f.mean, f.signal, f.sigma, f.usable, f.gain)]
    which = tuple((f.number, f.kind, f.group, f.frames, f.before, f.exposure_s, f.unit) for f in fields)
    return _MAPS.of(read, which, lambda: _blinking_map(fields))


def _blinking_map(fields: Many) -> Float[np.ndarray, "h w"]:
    out = np.zeros(fields[0].mean.shape)
    looked = _looked(fields)
    if looked is None or not looked.at.size:
        out.setflags(write=False)
        return out
    _, _, _, laws = _fitted(fields, looked)
    most = max(_MOST // _frames(fields), 1)
    for first in range(0, looked.at.size, most):
        at = looked.at[first : first + most]
        told = jumping_pixels(_kinds(fields, looked, at), laws)
        out.flat[at] = np.where(told.chance > 0.5, np.sqrt(told.variance), 0.0)
    out *= dark_sigma(tuple(darks(fields))) * looked.louder
    out.setflags(write=False)
    return out


def _frames(fields: Many) -> int:
    return sum(f.frames for f in darks(fields))


def _looked(fields: Many) -> _Looked | None:
    found = square_map(fields)
    if found is None:
        return None
    squares, usable, freedom = found
    if not usable.any():
        return None
    of_most = float(median(squares[usable])) / float(stats.chi2.median(freedom))
    squares = squares / max(of_most, 1e-12)
    limit = float(stats.chi2.isf(NOISY, freedom))
    at = np.flatnonzero(usable & (squares > limit))
    pixels = int(np.count_nonzero(usable))
    return _Looked(at, squares.ravel()[at], limit, freedom, float(np.sqrt(of_most)), pixels)


def _fitted(fields: Many, looked: _Looked) -> tuple[int, Float[np.ndarray, "k"], Kinds, list[Law]]:
    """Of every so many pixels, their squares and what they are told by, and the laws of their jumps."""
    step = -(-looked.at.size // max(_MOST // _frames(fields), 1)) or 1
    kinds = _kinds(fields, looked, looked.at[::step])
    unseen = (looked.pixels - looked.at.size) // step
    return step, looked.squares[::step], kinds, jump_laws(kinds, unseen)


def _kinds(fields: Many, looked: _Looked, at: Int[np.ndarray, "k"]) -> Kinds:
    seen = darks(fields)
    frames = frames_of(seen, at, own_charge(fields))
    return kinds_of([_unbiased(x) / looked.louder for x in frames], looked.limit)


def _unbiased(frames: Float[np.ndarray, "t k"]) -> Float[np.ndarray, "t k"]:
    """Frames about their mean, which are given with the variance of frames about a known one."""
    return (frames - frames.mean(0)) * np.sqrt((len(frames) - 1) / len(frames))
