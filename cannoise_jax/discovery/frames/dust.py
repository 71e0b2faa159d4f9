"""Where dust lies in the flats of a camera, told from all of them together.

A weak shadow stands out of no dim flat by itself, but is in its light all the same. Lens and dust are mostly
those of one evening, so what the flats leave beside their smooth surfaces is averaged, each by how noisy it
is, and the places that stand out in the average are those of all (`shadows`). How dark a place is each flat
says by itself: another aperture draws another shadow of the same grain.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from cannoise_jax.discovery.frames.contrasts import Stack
from cannoise_jax.discovery.frames.shadows import places, shadows
from cannoise_jax.discovery.frames.smooth import relative, smooth_mean, surface_of
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.packing import SITES

_ROUNDS = 8
"""Most times that surfaces are fitted anew beside shadows, which bend those that are fitted through them."""
_FEW = 0.5
"""Share of the frame beyond which what stands out is no shadow of a few grains."""
_SHALLOWER = 0.3
"""Depth, over the deepest, down to which shadows are left out in the first round; squared in the next."""
_SETTLED = 0.002
"""Share of the frame by which places change that bend a surface no more."""


def beside_dust(stacks: Sequence[Stack]) -> tuple[Stack, ...]:
    """The stacks, flats with the places of shadows and with their light."""
    where = dusty([s for s in stacks if _of_light_alone(s)])

    def lit(stacked: Stack) -> Stack:
        if stacked.recording.kind != "flat":
            return stacked
        marked = stacked._replace(dust=where if _of_light_alone(stacked) else None)
        return marked._replace(light=smooth_mean(marked))

    return tuple(each(lit, stacks))


def _of_light_alone(stacked: Stack) -> bool:
    return stacked.recording.kind == "flat" and stacked.recording.clean is None


def dusty(flats: Sequence[Stack]) -> Bool[np.ndarray, "h w"] | None:
    """Where the light of the flats, which are of one size, holds shadows; None: nowhere."""
    where = None
    for round_ in range(_ROUNDS if flats else 0):
        left = each(partial(_left, dust=where), flats)
        weights = [_weight(x) for x in left]
        total = np.sum(weights, 0)
        found = shadows(np.sum([w * x for w, x in zip(weights, left, strict=True)], 0) / total, total)
        if not found.any():
            return where
        if np.mean(places(found)) > _FEW:
            return None
        # A surface that is drawn towards a deep shadow lies below the light around it, which looks bright,
        # and sways where there is none: the deepest are left out first.
        before, where = where, places(found < found.min() * _SHALLOWER ** (round_ + 1))
        known = np.zeros_like(where) if before is None else before
        if np.mean(where ^ known) < _SETTLED:
            break
    return where if where is None else places(found)


def _left(flat: Stack, dust: Bool[np.ndarray, "h w"] | None) -> Float[np.ndarray, "h w"]:
    return relative(flat, surface_of(flat, dust))


def _weight(values: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Inverse variance of the pixels of each site of the mosaic."""
    out = np.zeros(values.shape)
    for at in SITES:
        out[at] = 1 / max(robust_std(values[at], 0), 1e-9) ** 2
    return out
