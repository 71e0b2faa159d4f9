"""The least amplitude that all frames of a capture set together can show: laws of the likelihood ratio.

The likelihood-ratio test that knows an effect's form, with black level, gain and read noise unknown, has its
mean shifted by so many null standard deviations. Knowing the form is knowing the law from which the effect
comes, not the draw: a known pattern (the step between two halves, the two greens) is a template; a pattern
that every camera draws anew (the offsets of rows, the gains of pixels) is a random term, its places unknown,
as in the table of one frame of the noise catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.signatures.fields import channel_index, least_squares, surfaces

_SURFACE = 4
"""Degree of the surface that a fitted mean takes out of a flat."""


class Seen(NamedTuple):
    """One recording with all of its frames.

    fresh: frames that what is redrawn shows in, less where the mean is the frames' own; known: whether what
    stays put shows in the mean; smooth: whether the light is only known to be smooth per channel. weight:
    1 / variance of a pixel in a frame where usable, else 0, DN^-2; signal: light above black, DN; shot, read:
    shares of the variance; tails: share of an excess kurtosis of the read noise that shows; exposure: share
    of the longest one; seconds: itself; gain: DN/e-.
    """

    frames: int
    fresh: float
    known: bool
    smooth: bool
    weight: Float[np.ndarray, "h w"]
    signal: Float[np.ndarray, "h w"]
    shot: Float[np.ndarray, "h w"]
    read: Float[np.ndarray, "h w"]
    tails: Float[np.ndarray, "h w"]
    exposure: float
    seconds: float
    gain: float


Load = Callable[[Seen], np.ndarray]
Law = Callable[[float], float]
"""Amplitude at which the mean is shifted by so many null standard deviations."""
Least = Callable[[tuple[Seen, ...]], Law | None]


def one(s: Seen) -> np.ndarray:
    """Of an offset, DN."""
    return np.ones(s.weight.shape)


def signal(s: Seen) -> np.ndarray:
    """Of a fraction of the signal."""
    return s.signal


def load_of(scaling: str) -> Load:
    """What the mean answers to a unit effect."""
    return signal if scaling == "signal" else one


def random_offsets(over: str, scaling: str, *, frozen: bool) -> Least:
    """Of offsets or factors of rows, columns or pixels."""

    def law(sets: tuple[Seen, ...]) -> Law:
        y, x = np.mgrid[: sets[0].weight.shape[0], : sets[0].weight.shape[1]]
        group = {"row": y, "column": x, "pixel": y * x.shape[1] + x}[over]
        return random(sets, load_of(scaling), group, frozen=frozen)

    return law


def grows(information: float, power: int) -> Law:
    """Shift = sqrt(information) * amplitude ** power."""
    return lambda shift: (shift / np.sqrt(information)) ** (1 / power) if information > 0 else np.inf


def pooled(informations: Iterable[float]) -> Law:
    """Pixels that each tell by themselves."""
    return grows(float(sum(informations)), 1)


def template(sets: tuple[Seen, ...], load: Load, common: bool = False) -> Law:
    """A known pattern in the mean: its norm once black level (per channel, or `common` to all) and one factor
    of the signal are fitted too, and of flats of unknown light a smooth surface per channel."""
    gram = np.zeros((6, 6))
    for s in sets:
        if not s.known:
            continue
        root = np.sqrt(s.frames * s.weight)
        channel = channel_index(root.shape)
        pattern = np.broadcast_to(load(s) * root, root.shape)
        if s.smooth:
            gram[0, 0] += sum(
                _beyond_surface(pattern[channel == c], root[channel == c], root.shape, c) for c in range(4)
            )
            continue
        levels = [(root if c == 0 else 0 * root) if common else root * (channel == c) for c in range(4)]
        basis = np.stack([pattern, *levels, s.signal * root]).reshape(6, -1)
        gram += np.einsum("kn,ln->kl", basis, basis)
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), 1e-300))
    scaled = gram * np.outer(scale, scale)
    rest = np.linalg.lstsq(scaled[1:, 1:], scaled[1:, 0], rcond=1e-10)[0]
    left = float(scaled[0, 0] - scaled[0, 1:] @ rest)
    return grows(gram[0, 0] * left if left > 1e-7 else 0.0, 1)


def _beyond_surface(pattern: np.ndarray, root: np.ndarray, size: tuple[int, int], c: int) -> float:
    """Square of a weighted pattern of one channel that no smooth surface takes away."""
    basis = surfaces(size, _SURFACE, c) * root[:, None]
    left = float(np.sum((pattern - basis @ least_squares(basis, pattern)) ** 2))
    return left if left > 1e-6 * float(np.sum(pattern**2)) else 0.0


def random(sets: tuple[Seen, ...], load: Load, group: np.ndarray, frozen: bool) -> Law:
    """Random offsets (or factors) of groups of pixels: d^2 = a^4 / 2 (sum of squares of the information of
    every draw, less that of the single pixels in it, whose variance alone gain and read noise take up)."""
    total, shared = 0.0, np.zeros(int(group.max()) + 1)
    for s in sets:
        own = s.weight * load(s) ** 2
        groups = np.bincount(group.ravel(), own.ravel())
        if not frozen:
            total += s.fresh * float(np.sum(groups**2) - np.sum(own**2))
        elif s.known:
            shared += s.frames * groups
            total -= s.frames * float(np.sum(own**2))
    return grows((total + float(np.sum(shared**2))) / 2, 2)


def frame_offsets(sets: tuple[Seen, ...]) -> Law:
    """An offset of every frame about a black level that is unknown."""
    i = np.array([s.weight.sum() for s in sets])
    n = np.array([s.fresh for s in sets])
    first, second, third = (float(np.sum(n * i**k)) for k in (1, 2, 3))
    single = float(np.sum([s.fresh * np.sum(s.weight**2) for s in sets]))
    return grows((second - 2 * third / first + second**2 / first**2 - single) / 2, 2)


def pink(sets: tuple[Seen, ...], series: Callable[[Seen], np.ndarray]) -> Law:
    """A series of power 1/f, new in every frame: d^2 = a^4 / 2 sum_ij w_i w_j R_ij^2 without i = j, R the
    series' correlation, a function of the lag."""
    total = 0.0
    for s in sets:
        w = series(s)
        f = np.fft.rfftfreq(w.size)
        power = np.divide(1, f, out=np.zeros_like(f), where=f > 0)
        lag = np.fft.irfft(power, w.size)
        pairs = np.fft.irfft(np.abs(np.fft.rfft(w)) ** 2, w.size)
        # A single pixel's own variance is taken up by the read noise; a row's stands against its pixels'.
        own = float(np.sum(s.weight**2))
        total += s.fresh * (float(np.sum(pairs * (lag / lag[0]) ** 2)) - own)
    return grows(total / 2, 2)


def sinusoid(sets: tuple[Seen, ...], load: Load) -> Law:
    """A wave of known frequency and a new phase in every frame: the power at its frequency is exponential,
    its mean one more by a^2 I / 4, I the frame's information about an offset of that load."""
    return grows(sum(s.fresh * (np.sum(s.weight * load(s) ** 2) / 4) ** 2 for s in sets), 2)
