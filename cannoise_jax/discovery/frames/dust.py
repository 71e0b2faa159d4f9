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
from scipy import optimize

from cannoise_jax.discovery.frames.contrasts import Stack
from cannoise_jax.discovery.frames.shadows import places, shadows
from cannoise_jax.discovery.frames.smooth import above_black, relative, smooth_mean, surface_of
from cannoise_jax.discovery.frames.threads import each
from cannoise_jax.physics.robust import robust_std
from cannoise_jax.recordings.packing import SITES

_ROUNDS = 8
"""Most times that surfaces are fitted anew beside shadows, which bend those that are fitted through them."""
_FEW = 0.5
"""Share of the frame beyond which what stands out is no shadow of a few grains."""
_SHALLOWER = 0.3
"""Depth, over the deepest, down to which shadows are left out in the first round; squared in the next."""
_PARTS, _FEWEST = 16, 200
"""Parts of a site by their light, in which pixels scatter alike, and the fewest pixels of one."""
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
        told = each(partial(_left, dust=where), flats)
        total = np.sum([weight for _, weight in told], 0)
        found = shadows(np.sum([weight * left for left, weight in told], 0) / total, total)
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


def _left(flat: Stack, dust: Bool[np.ndarray, "h w"] | None) -> tuple[np.ndarray, np.ndarray]:
    """What a flat leaves beside its surface, as a share of its light, and the inverse variance of that."""
    surface = surface_of(flat, dust)
    left, weight = relative(flat, surface), np.zeros(surface.shape)
    light = above_black(flat, surface)
    for at in SITES:
        weight[at] = 1 / _variance(left[at], light[at])
    return left, weight


def _variance(left: Float[np.ndarray, "h w"], light: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Variance of the pixels of a site as shares of their light: that of their sensitivities, and shot noise,
    of which the corners that a lens leaves dim have more."""
    order = np.argsort(light, axis=None)
    parts = np.array_split(order, max(min(_PARTS, order.size // _FEWEST), 1))
    scatter = np.maximum([robust_std(left.flat[part], 0) for part in parts], 1e-9) ** 2
    inverse = np.array([np.mean(1 / light.flat[part]) for part in parts])
    terms = np.stack([np.ones(len(parts)), inverse], 1) / scatter[:, None]
    even, shot = optimize.nnls(terms, np.ones(len(parts)))[0]
    return np.maximum(even + shot / light, 1e-18)
