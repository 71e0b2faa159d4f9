"""Where training's numbers and pictures go: one line of JSON a record, and TensorBoard.

The interface is that of clu's metric writers: `write_scalars`, `write_images`, `flush`, `close`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.summary import image as image_summary
from tensorboardX.summary import scalar as scalar_summary

from cannoise_jax.recordings.recording import BadInput


class MetricWriter:
    """Appends to `metrics.jsonl` and to a TensorBoard event file in one folder, in the caller's thread.

    A thread of its own would die of a full disk unseen, and leave the caller waiting for it. As a context it
    closes at the end, and then hides no error that ended it. All but `close` raise BadInput where the folder
    cannot be written.
    """

    def __init__(self, folder: Path):
        self._folder = Path(folder)
        with self._writable():
            self._lines = (self._folder / "metrics.jsonl").open("a")
            self._events = EventsWriter(str(self._folder / "events"))

    def __enter__(self) -> MetricWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            self.close()
        except BadInput:
            if kind is None:
                raise

    def write_scalars(self, step: int, scalars: Mapping[str, float]) -> None:
        """Named numbers of one step. A number that is not finite is written as null."""
        finite = {name: float(value) if np.isfinite(value) else None for name, value in scalars.items()}
        with self._writable():
            self._lines.write(json.dumps({"step": step, **finite}) + "\n")
            for name, value in scalars.items():
                self._write_event(step, scalar_summary(name, float(value)))

    def write_images(self, step: int, images: Mapping[str, UInt8[np.ndarray, "h w"]]) -> None:
        """Named grey images, uint8."""
        with self._writable():
            for name, image in images.items():
                self._write_event(step, image_summary(name, image[None]))

    def flush(self) -> None:
        """Everything written so far is on disk."""
        with self._writable():
            self._lines.flush()
            self._events.flush()

    def close(self) -> None:
        """Flushes, and ends both. Raises BadInput where the last lines cannot be written."""
        with self._writable():
            try:
                self._lines.close()
            finally:
                self._events.close()

    def _write_event(self, step: int, summary) -> None:
        self._events.write_event(Event(wall_time=time.time(), step=step, summary=summary))

    @contextmanager
    def _writable(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            reason = error.strerror or " ".join(str(error).split())
            raise BadInput(
                f"{self._folder}: cannot be written ({reason}): free some space and run again; it will resume"
            ) from error


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
