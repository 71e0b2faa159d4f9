"""Pixels that one frame alone has far off, at places that do not repeat: those that a particle hit.

Where the simulator draws such events too, at other places, neither its own nor the recorded ones are patterns
or noisy pixels of the camera.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from cannoise_jax.discovery.compare.pixel_noise import stand_out
from cannoise_jax.discovery.compare.view import Raw, bulk_variance
from cannoise_jax.signatures.fields import helmert

_FEWEST = 4
"""Frames from which on one of them is told from the others."""
_FAR = 6.0
"""Standard deviations of the noise by which a hit frame is off its mean, at least."""
_ALIKE = 0.2
"""Share of the recorded places that the simulator has too, from which on they are pixels of the camera."""
_RATE = 0.2
"""Events that the simulator draws, over the recorded ones, from which on it knows them."""


def without_strays(raw: Raw, drawn: Raw) -> tuple[Raw, Raw]:
    """Recorded and drawn frames, the frame that stands out replaced by the mean of the others in every pixel
    that has one; as they are where the simulator draws no such events, or at the same places."""
    recorded, simulated = _strays(raw), _strays(drawn)
    if recorded is None or simulated is None:
        return raw, drawn
    number = float(recorded.sum()), float(simulated.sum()) * raw.frames / drawn.frames
    if not number[0] or number[1] < _RATE * number[0]:
        return raw, drawn
    if (recorded & simulated).sum() > _ALIKE * min(recorded.sum(), simulated.sum()):
        return raw, drawn
    return _calm(raw, recorded), _calm(drawn, simulated)


def _strays(raw: Raw) -> Bool[np.ndarray, "h w"] | None:
    """Pixels of which one frame is far off, and the others are as quiet as all; None of too few frames."""
    n = len(raw.contrasts)
    if n + 1 < _FEWEST or n + 1 != raw.frames:
        return None
    own = np.mean(raw.contrasts**2, 0)
    bulk = bulk_variance(own.ravel(), n)
    if not bulk > 0:
        return None
    out = stand_out(own / bulk, n) & raw.usable
    off, _ = _farthest(raw, out)
    rest = (n * own[out] - off**2 * raw.frames / n) / (n - 1)
    out[out] = (np.abs(off) > _FAR * np.sqrt(bulk)) & ~stand_out(rest / bulk, n - 1)
    return out


def _farthest(raw: Raw, at: Bool[np.ndarray, "h w"]) -> tuple[Float[np.ndarray, "p"], Int[np.ndarray, "p"]]:
    """How far the frame that is farthest off is from the mean of all, and which it is."""
    off = raw.contrasts[:, at].T @ helmert(raw.frames)
    which = np.argmax(np.abs(off), 1)
    return off[np.arange(len(off)), which], which


def _calm(raw: Raw, at: Bool[np.ndarray, "h w"]) -> Raw:
    off, which = _farthest(raw, at)
    mean, contrasts = raw.mean.copy(), raw.contrasts.copy()
    # Its value becomes the mean of the others: by n / (n - 1) of how far it is from the mean of all.
    more = off * raw.frames / (raw.frames - 1)
    mean[at] -= more / raw.frames
    contrasts[:, at] -= helmert(raw.frames)[:, which] * more
    return raw._replace(mean=mean, contrasts=contrasts)
