"""Parts of the frames held back, to be left out in turn: bands of rows, and blocks of whole frames.

Every part has bands from all over the frame: an effect that is strong in one corner is no less sure for that.
"""

from __future__ import annotations

import numpy as np

from cannoise_jax.signatures.fields import Fields, helmert

_DEALT = 4
"""Bands of each part."""


def bands(size: tuple[int, int], most: int) -> list[np.ndarray]:
    """The frame in at most `most` parts, bands of whole mosaic cells dealt out in turn, one part marked in
    each array."""
    cells = size[0] // 2
    edges = np.linspace(0, cells, min(_DEALT * most, max(cells, 1)) + 1).round().astype(int) * 2
    edges[-1] = size[0]
    band = np.searchsorted(edges, np.arange(size[0]), side="right") - 1
    parts = min(most, len(edges) - 1)
    return [np.broadcast_to((band % parts == k)[:, None], size) for k in range(parts)]


def frame_blocks(fields: tuple[Fields, ...], most: int) -> list[list[tuple[int, int]]]:
    """Frames as (field, frame), in at most `most` blocks. The two frames of a recording of two that is seen
    against no others stay together: one alone says nothing."""
    units: list[list[tuple[int, int]]] = []
    for n, f in enumerate(fields):
        if f.frames == 2 and not f.before:
            units.append([(n, 0), (n, 1)])
        elif f.frames > 2 or f.before:
            units += [[(n, t)] for t in range(f.frames)]
    count = min(most, len(units))
    return [[frame for unit in units[k::count] for frame in unit] for k in range(count)]


def leave_out(fields: tuple[Fields, ...], block: list[tuple[int, int]]) -> tuple[Fields, ...]:
    """The fields without some of their frames; recordings of which nothing could be told then drop out."""
    out = []
    for n, f in enumerate(fields):
        gone = [t for m, t in block if m == n]
        if not gone:
            out.append(f)
            continue
        kept = [t for t in range(f.frames) if t not in gone]
        if len(kept) < (1 if f.before else 2):
            continue
        inner = np.einsum("nt,nij->tij", helmert(f.frames).astype(np.float32), f.contrasts[: f.frames - 1])
        static = None
        if f.static is not None:
            static = (inner[kept] + f.static / np.float32(np.sqrt(f.frames))).sum(0) / np.float32(
                np.sqrt(len(kept))
            )
        contrasts = np.einsum("nt,tij->nij", helmert(len(kept)).astype(np.float32), inner[kept])
        if f.before:
            moved = inner[kept].mean(0) + f.contrasts[-1] * np.float32(np.sqrt(1 / f.frames + 1 / f.before))
            outer = moved / np.float32(np.sqrt(1 / len(kept) + 1 / f.before))
            contrasts = np.concatenate([contrasts, outer[None]])
        out.append(f._replace(frames=len(kept), contrasts=contrasts, static=static))
    return tuple(out)
