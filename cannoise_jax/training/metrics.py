"""Where training's numbers and pictures go: one line of JSON a record, and TensorBoard.

The interface is that of clu's metric writers: `write_scalars`, `write_images`, `flush`, `close`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from tensorboardX import SummaryWriter


class MetricWriter:
    """Appends to `metrics.jsonl` and to TensorBoard event files in one folder."""

    def __init__(self, folder: Path):
        self._lines = (Path(folder) / "metrics.jsonl").open("a")
        self._events = SummaryWriter(str(folder), flush_secs=30)

    def write_scalars(self, step: int, scalars: Mapping[str, float]) -> None:
        """Named numbers of one step. A number that is not finite is written as null."""
        finite = {name: float(value) if np.isfinite(value) else None for name, value in scalars.items()}
        self._lines.write(json.dumps({"step": step, **finite}) + "\n")
        for name, value in scalars.items():
            self._events.add_scalar(name, float(value), step)

    def write_images(self, step: int, images: Mapping[str, UInt8[np.ndarray, "h w"]]) -> None:
        """Named grey images, uint8."""
        for name, image in images.items():
            self._events.add_image(name, image[None], step)

    def flush(self) -> None:
        """Everything written so far is on disk."""
        self._lines.flush()
        self._events.flush()

    def close(self) -> None:
        """Flushes, and ends both."""
        self._lines.close()
        self._events.close()


def noise_panel(
    clean: Float[np.ndarray, "b h w 4"], noises: tuple[Float[np.ndarray, "b h w 4"], ...]
) -> UInt8[np.ndarray, "H W"]:
    """One row per image: clean, then each noise, the first green of each, as one grey picture.

    Noise of one row shares one scale, three times the rms of the last (the real one); mid-grey is zero.
    """
    rows = []
    for i, image in enumerate(clean):
        bright = float(np.quantile(image[..., 1], 0.99)) + 1e-6
        limit = 3 * float(np.sqrt(np.mean(np.square(noises[-1][i])))) + 1e-9
        cells = [np.clip(image[..., 1] / bright, 0, 1) ** (1 / 2.2)]
        cells += [np.clip(noise[i, ..., 1] / (2 * limit) + 0.5, 0, 1) for noise in noises]
        rows.append(np.concatenate(cells, 1))
    return (255 * np.concatenate(rows)).round().astype(np.uint8)
