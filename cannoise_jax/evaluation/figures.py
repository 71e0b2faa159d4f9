"""The picture of noise models beside the real noise, after Fig. 2 of "Learning Camera-Aware Noise Models"."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, Key
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cannoise_jax.evaluation.baselines import Sampler
from cannoise_jax.evaluation.compare import Patches, draw_noise, model_columns
from cannoise_jax.evaluation.kl import clipped_noise

_TITLES = {
    "gaussian": "Gaussian",
    "poisson_gaussian": "Poisson-Gaussian\n(published)",
    "model": "model",
    "model_wrong_reference": "model, another\ncamera's reference",
}


def noise_figure(
    path: Path,
    sampler: Sampler | None,
    patches: Patches,
    camera_names: Sequence[str],
    key: Key[Array, ""],
    batch: int = 64,
    references: int = 1,
) -> None:
    """Write a PNG: one row per camera, columns clean, real noise, Gaussian, Poisson-Gaussian, model, and the
    model with another camera's reference.

    Noise of one row shares one colour scale, three times the rms of the real noise. Shown is the green of a
    textured patch of middling brightness. sampler: as for `compare.evaluate_model`; `batch` as there, so that
    it need not compile again; `references` as there.
    """
    camera = np.asarray(patches.camera)
    chosen = np.array([typical(patches, c) for c in range(len(camera_names)) if (camera == c).any()])
    pair_key, draw_key = jax.random.split(key)
    noise = {
        _TITLES[name]: draw_noise(column, patches, jax.random.fold_in(draw_key, i), batch, chosen)
        for i, (name, column) in enumerate(
            model_columns(sampler, patches, pair_key, None, references).items()
        )
        if name in _TITLES
    }
    clean = np.asarray(patches.clean)[chosen]
    real = clipped_noise(np.asarray(patches.noisy)[chosen] - clean, clean)
    columns = {"real": real, **noise}
    labels = [f"{camera_names[camera[i]]}\nISO {int(np.asarray(patches.iso)[i])}" for i in chosen]
    _save(draw_noise_panels(clean, columns, labels), path)


def draw_noise_panels(clean, columns: dict[str, np.ndarray], labels: list[str]) -> Figure:
    """Greens of a clean patch and of noise, one camera a row, one model a column, the first the real one."""
    figure = Figure(figsize=(1.9 * (len(columns) + 1) + 0.5, 1.95 * len(labels) + 0.3), layout="constrained")
    axes = figure.subplots(len(labels), len(columns) + 1, squeeze=False)
    for r, label in enumerate(labels):
        bright = np.quantile(clean[r], 0.99) + 1e-6
        axes[r, 0].imshow(np.clip(clean[r, ..., 1] / bright, 0, 1) ** (1 / 2.2), cmap="gray", vmin=0, vmax=1)
        axes[r, 0].set_ylabel(label, rotation=0, ha="right", va="center")
        limit = 3 * float(np.sqrt(np.square(next(iter(columns.values()))[r]).mean())) + 1e-9
        for c, noise in enumerate(columns.values(), start=1):
            axes[r, c].imshow(
                noise[r, ..., 1], cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest"
            )
            axes[r, c].set_xlabel(f"$\\sigma$ {noise[r, ..., 1].std():.4f}", fontsize=7, labelpad=1)
        for axis in axes[r]:
            axis.set_xticks([])
            axis.set_yticks([])
    for axis, title in zip(axes[0], ["clean", *columns], strict=True):
        axis.set_title(title, fontsize=9)
    return figure


def _save(figure: Figure, path: Path) -> None:
    """Write the PNG atomically."""
    unfinished = path.with_name(f".{path.name}.partial")
    try:
        with unfinished.open("wb") as file:
            FigureCanvasAgg(figure).print_png(file)
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def typical(patches: Patches, camera: int) -> int:
    """The patch of a camera whose clean image is textured and of middling brightness."""
    index = np.flatnonzero(np.asarray(patches.camera) == camera)
    clean = np.asarray(patches.clean)[index][..., 1]
    texture = clean.std(axis=(1, 2)) / (clean.mean(axis=(1, 2)) + 1e-3)
    lively = index[np.argsort(texture)[-max(1, index.size // 4) :]]
    brightness = np.asarray(patches.clean)[lively].mean(axis=(1, 2, 3))
    return int(lively[np.argsort(brightness)[lively.size // 2]])
