"""Panels of noise models side by side, one camera a row: noise as it is stored, and noisy images rendered."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cannoise_jax.evaluation.figures import draw_noise_panels, typical

_DPI = 60


def panels(patches: Any, names: Sequence[str], noise: Mapping[str, Float[np.ndarray, "n h w 4"]]) -> list:
    """Two figures of kind "image". patches: the test's; names: of the cameras; noise: real noise and that of
    every model, by title."""
    camera = np.asarray(patches.camera)
    chosen = [typical(patches, c) for c in range(len(names)) if (camera == c).any()]
    labels = [f"{names[camera[i]]}\nISO {int(np.asarray(patches.iso)[i])}" for i in chosen]
    clean = np.asarray(patches.clean)[chosen]
    shown = {title: np.asarray(n)[chosen] for title, n in noise.items()}
    raw = _png(draw_noise_panels(clean, shown, labels))
    pictures = {"clean": clean, **{title: clean + n for title, n in shown.items()}}
    done = _png(_rendered_panels(pictures, labels))
    titles = ("Noise of the green pixels, raw", "Noisy patches, rendered")
    return [{"title": t, "kind": "image", "data": d} for t, d in zip(titles, (raw, done), strict=True)]


def rendered(packed: Float[np.ndarray, "h w 4"], white: Float[np.ndarray, "3"]) -> Float[np.ndarray, "h w 3"]:
    """A packed patch as a screen shows it: the greens averaged, divided by what is to be white, 1/2.2
    gamma. Half the resolution of the mosaic, so that nothing need be interpolated."""
    colours = np.stack([packed[..., 0], packed[..., 1:3].mean(-1), packed[..., 3]], -1)
    return np.clip(colours / white, 0, 1) ** (1 / 2.2)


def _rendered_panels(pictures: Mapping[str, np.ndarray], labels: Sequence[str]) -> Figure:
    size = (1.9 * len(pictures) + 0.5, 1.95 * len(labels) + 0.3)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(labels), len(pictures), squeeze=False)
    clean = pictures["clean"]
    for r, label in enumerate(labels):
        green = clean[r, ..., 1:3].mean(-1)
        colours = (clean[r, ..., 0], green, clean[r, ..., 3])
        # Grey on average, as bright as the brightest parts of the clean patch allow.
        white = np.array([c.mean() for c in colours]) * np.quantile(green, 0.99) / max(green.mean(), 1e-6)
        for c, image in enumerate(pictures.values()):
            axes[r, c].imshow(rendered(image[r], np.maximum(white, 1e-6)), interpolation="nearest")
            axes[r, c].set_xticks([])
            axes[r, c].set_yticks([])
        axes[r, 0].set_ylabel(label, rotation=0, ha="right", va="center")
    for axis, title in zip(axes[0], pictures, strict=True):
        axis.set_title(title, fontsize=9)
    return figure


def _png(figure: Figure) -> str:
    """Base64, as a page holds it."""
    content = io.BytesIO()
    figure.set_dpi(_DPI)
    FigureCanvasAgg(figure).print_png(content)
    return base64.b64encode(content.getvalue()).decode()
