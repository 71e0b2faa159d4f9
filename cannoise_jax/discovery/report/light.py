"""What the flats hold at a few places beside their smooth light, which counts as light."""

from __future__ import annotations

from typing import Any

import numpy as np

from cannoise_jax.discovery.frames.smooth import light_of
from cannoise_jax.discovery.result import Result

_LEAST, _FEWEST = 0.002, 200
"""Share of the frame, and pixels, from which on places are worth a word: chance alone takes a few hundred of
a large frame, and of a small one the fifty about one place."""
RECORD = (
    "What lies on the glass and what the pixels do cannot be told apart under one light: clean the camera, "
    "or change the lens or its aperture, and record flats again"
)


def shadowed(diagnosis: Result) -> list[dict[str, Any]]:
    """Every flat that shows shadows, as of dust: file, the share of the frame that they cover, and by what
    share of the light the darkest (below zero) and the brightest place differs."""
    out = []
    for stacked in diagnosis.first.stacks:
        pixels = 0 if stacked.dust is None else int(np.sum(stacked.dust))
        share = pixels / stacked.mean.size
        if share >= _LEAST and pixels >= _FEWEST:
            found = light_of(stacked)[1]
            name = stacked.recording.path or f"recording {stacked.number}"
            extremes = {"darkest": min(found.min(), 0.0), "brightest": max(found.max(), 0.0)}
            out.append({"file": name, "share": share, **extremes})
    return out


def sentence_of(flats: list[dict[str, Any]]) -> str:
    """What a report and the screen say of them."""
    deepest = max(flats, key=lambda f: max(-f["darkest"], f["brightest"]))
    most = max(-deepest["darkest"], deepest["brightest"])
    how = "brighter" if deepest["brightest"] == most else "darker"
    return (
        f"{len(flats)} of the flats hold spots or rings, as of dust: up to {100 * most:.2g} % {how}, on "
        f"{100 * max(f['share'] for f in flats):.2g} % of the frame. They count as light and are not in the "
        f"simulator. {RECORD}"
    )
