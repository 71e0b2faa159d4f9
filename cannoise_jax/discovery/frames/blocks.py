"""Parts of the frames held back, to be left out in turn: bands of rows, and blocks of whole frames."""

from __future__ import annotations

import numpy as np

from cannoise_jax.signatures.fields import Fields, helmert


def bands(size: tuple[int, int], most: int) -> list[np.ndarray]:
    """The frame in at most `most` bands of whole mosaic cells, one marked in each array."""
    edges = np.linspace(0, size[0] // 2, most + 1).round().astype(int) * 2
    rows = np.arange(size[0])[:, None]
    return [np.broadcast_to((rows >= a) & (rows < b), size) for a, b in zip(edges, edges[1:], strict=False)]


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
