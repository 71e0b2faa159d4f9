"""Peaks that are clamped.

A camera that clamps what rises above all eight neighbours of its colour leaves no peaks, but every pit. Of
any noise that is symmetric about its mean, correlated or not, both are as high; skewness of few electrons
makes peaks higher."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from cannoise_jax.physics.robust import median
from cannoise_jax.signatures.fields import Fields, each_frame
from cannoise_jax.signatures.plain import carried, plain
from cannoise_jax.signatures.score import Score, student_log_p
from cannoise_jax.signatures.signature import CONTRASTS, STATIC, Axes, Signature, unchanged

_FOOTPRINT = np.zeros((5, 5), bool)
_FOOTPRINT[::2, ::2] = True
_FOOTPRINT[2, 2] = False
_TALL = 2.5
"""Height above all neighbours, standard deviations, from which a pixel is defective, not one of the noise."""


_MAP = 0.25
"""Spread of the levels of the pixels over that of the noise of a frame, at most."""


_DOUBT = 0.03
"""Share of the height of the peaks that skewness of rounding may take off."""


_WEIGHT = 3.0
"""Nats of a weight between 0 and 1 that is known to 0.02: its Occam factor log(1 / (2.5 x 0.02)). Thirty
frames of 96 x 128 pixels know it to 0.007, which would be 4.1."""


def suppression_score(fields: tuple[Fields, ...]) -> Score | None:
    """Height of the peaks above all eight neighbours of a colour against the depth of the pits. Amplitude:
    the weight of the clamped value."""
    up, down = [], []
    for f in fields:
        if not f.frames or median(f.sigma) < f.step or f.usable.mean() < 0.5:
            continue
        if f.static is None:
            continue
        # A map of levels beyond the noise, as in long darks, has peaks and pits of its own.
        if median(np.abs(f.static[f.usable])) > 1.4 * np.sqrt(f.frames) * _MAP:
            continue
        far = ndimage.binary_dilation(
            np.abs(f.static) > 4 + 4 * _MAP * np.sqrt(f.frames), np.ones((5, 5), bool)
        )
        kept = f.usable & ~far
        peaks, pits = np.zeros(f.mean.shape), np.zeros(f.mean.shape)
        for z in each_frame(f):
            above = z - ndimage.maximum_filter(z, footprint=_FOOTPRINT, mode="mirror")
            below = ndimage.minimum_filter(z, footprint=_FOOTPRINT, mode="mirror") - z
            peaks += np.where((above > 0) & (above < _TALL) & kept, above, 0.0)
            pits += np.where((below > 0) & (below < _TALL) & kept, below, 0.0)
        up.append(_by_blocks(peaks))
        down.append(_by_blocks(pits))
    if not up:
        return None
    high, deep = np.concatenate(up), np.concatenate(down)
    if high.size < 16 or deep.sum() <= 0:
        return None
    lost = 1 - high.sum() / deep.sum()
    rest = (deep - high) - lost * deep
    error = float(np.sqrt(np.sum(rest**2) / (high.size - 1) * high.size) / deep.sum())
    z = (lost - _DOUBT) / max(error, 1e-9)
    return Score(
        log_p=student_log_p(z, high.size - 1, 1),
        gain=0.5 * max(z, 0.0) ** 2,
        penalty=_WEIGHT,
        amplitude=max(float(lost), 0.0),
        error=error,
        shift=error,
        power=1,
        parameters={"weight": (float(lost), "1", error)},
        where={"axis": "pixel", "edge": "peaks"},
    )


def _by_blocks(values: np.ndarray, side: int = 16) -> np.ndarray:
    """Sums over blocks, whose scatter tells how sure the sum of all is."""
    h, w = (n // side * side for n in values.shape)
    return values[:h, :w].reshape(h // side, side, w // side, side).sum((1, 3)).ravel()


def peaks(*, name: str, covers: tuple[str, ...], lifted_by: tuple[str, ...]) -> Signature:
    """Pixels that never stand out above all of their neighbours."""
    return plain(
        name=name,
        axes=Axes("digital", "pixel", "redrawn", "all noise", "clamp"),
        reads=CONTRASTS | STATIC,
        score=suppression_score,
        absorb=unchanged,
        simulate=carried(lambda s: {"weight": s.amplitude}),
        covers=covers,
        lifted_by=lifted_by,
    )
