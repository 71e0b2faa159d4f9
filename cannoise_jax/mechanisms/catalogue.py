"""The catalogue: one self-contained page that shows, for every mechanism, what it does and how it is told
apart.

Pictures and curves come from the mechanisms themselves: the same camera with and without one, drawn from
the same key, so that their difference is the mechanism alone.
"""

from __future__ import annotations

import base64
import functools
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jinja2
import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cannoise_jax.mechanisms import ENTRIES, curves
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core import chain
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.core.settings import context_of, resolve
from cannoise_jax.recordings.atomic import texts_in_place
from cannoise_jax.recordings.recording import BadInput

SIDE, FRAMES = 128, 24
"""Pixels of a side, and frames, of a picture: chosen small; what is `shown` is plain at this size."""
SETTINGS = Settings(iso=100.0, exposure_s=1.0, frames=FRAMES)
INK, ACCENT, QUIET = "#1f2933", "#c2410c", "#7b8794"


class Shot(NamedTuple):
    """Frames [T, H, W] in DN with and without a mechanism, and the expected signal above black."""

    without: np.ndarray
    with_it: np.ndarray
    signal: np.ndarray
    black: float


def scene() -> np.ndarray:
    """A clean mosaic: a ramp from black, bars, and a disc bright enough to fill a pixel."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] / SIDE
    clean = 0.35 * x
    clean = np.where((y > 0.7) & (y < 0.9) & (np.floor(x * 16) % 2 == 0), 0.3, clean)
    return np.where((x - 0.35) ** 2 + (y - 0.32) ** 2 < 0.03, 0.6, clean).astype(np.float32)


def shoot(entry: Entry, clean: np.ndarray | None = None) -> Shot:
    """The catalogue's camera with and without a mechanism, from one key."""
    if clean is None:
        clean = scene() * np.float32(0.03 if entry.examples.dim else 1.0)
    base = SensorModel.poisson_gaussian(0.5, 3.0, 64.0, 1087.0, "RGGB", unit_key=jax.random.key(2))
    without, context = _frames(base, clean)
    shown: dict[str, Any] = dict(entry.examples.shown)
    with_it, _ = _frames(base.with_mechanism(entry, **shown), clean)
    return Shot(without, with_it, np.asarray(context.mean_dn)[0], 64.0)


@functools.lru_cache(maxsize=4)
def _context(model: SensorModel, clean: bytes, size: tuple[int, int]):
    return context_of(model, jnp.asarray(np.frombuffer(clean, np.float32).reshape(1, *size)), SETTINGS)


def _frames(model: SensorModel, clean: np.ndarray):
    # Not compiled: fifty programs for a few frames each would cost minutes of compiling.
    context = _context(model, clean.tobytes(), clean.shape)
    values = resolve(model, context)
    key = jax.random.key(1)
    y, step = chain.run_chain(model, key, context, values, FRAMES)
    return np.asarray(chain.to_codes(model, key, y, step, context, values)), context


def _png(figure: Figure) -> str:
    content = io.BytesIO()
    FigureCanvasAgg(figure)
    figure.savefig(content, format="png", dpi=110)
    return base64.b64encode(content.getvalue()).decode()


def _clean_axes(axes, x: str, y: str) -> None:
    axes.set_xlabel(x, fontsize=8)
    axes.set_ylabel(y, fontsize=8)
    axes.tick_params(labelsize=7)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    axes.grid(alpha=0.2, linewidth=0.5)


def picture(shot: Shot) -> str:
    """The last frame with the mechanism, and its difference from the same frame without it, as one PNG."""
    figure = Figure(figsize=(4.6, 2.3), layout="constrained")
    left, right = figure.subplots(1, 2)
    brightest = 1.1 * float(shot.signal.max()) + 8
    frame = np.sqrt(np.clip((shot.with_it[-1] - shot.black) / brightest, 0, 1))
    left.imshow(frame, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    left.set_title("one frame", fontsize=8, color=INK)
    change = shot.with_it[-1] - shot.without[-1]
    changed = np.abs(change[change != 0])
    reach = max(float(np.percentile(changed, 98)), 1.0) if changed.size else 1.0
    image = right.imshow(change, cmap="RdBu_r", vmin=-reach, vmax=reach, interpolation="nearest")
    right.set_title(f"what it changes, ±{reach:.3g} DN", fontsize=8, color=INK)
    bar = figure.colorbar(image, ax=right, shrink=0.85)
    bar.ax.tick_params(labelsize=6)
    for axes in (left, right):
        axes.set_xticks([])
        axes.set_yticks([])
    return _png(figure)


def signature(entry: Entry, shot: Shot) -> str:
    """The curve that tells the mechanism apart, with it and without it, as a PNG."""
    curve = curves.curve_of(entry.examples.curve, shot.without, shot.with_it, shot.signal, shot.black)
    figure = Figure(figsize=(3.4, 2.3), layout="constrained")
    axes = figure.subplots()
    style = {"marker": ".", "linestyle": ""} if curve.points else {"linewidth": 1.1}
    axes.plot(curve.x, curve.without, color=QUIET, label="without", **style)
    axes.plot(curve.x, curve.with_it, color=ACCENT, label="with", **style)
    if curve.log:
        axes.set_yscale("log")
    axes.legend(fontsize=7, frameon=False)
    _clean_axes(axes, curve.x_label, curve.y_label)
    return _png(figure)


def equation(latex: str) -> str:
    """A formula as a PNG, by the mathematics of Matplotlib. Raises ValueError where it cannot be set."""
    figure = Figure(figsize=(0.01, 0.01))
    figure.text(0, 0, f"${latex}$", fontsize=13, color=INK)
    FigureCanvasAgg(figure)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110, bbox_inches="tight", pad_inches=0.04, transparent=True)
    return base64.b64encode(content.getvalue()).decode()


_NEEDS = {
    "pair": "a scene and its noise-free reference",
    "pair_independent": "a scene and a reference not made of the same camera's frames",
    "burst": "several frames of one scene",
    "dark": "darks",
    "flat": "flats at several levels",
    "iso": "several ISOs",
    "exposure": "several exposure times",
    "temperature": "the temperature of each frame",
}


def said_of(entry: Entry) -> dict[str, Any]:
    """What the page says about one mechanism."""
    record, shot = entry.record, shoot(entry)
    point, law = record.point, record.scaling
    scales = [
        text
        for text, on in (
            (f"in proportion to gain^{law.gain:g}", law.gain),
            (f"in proportion to exposure^{law.exposure:g}", law.exposure),
            (f"doubles every {law.doubling_c} K", law.doubling_c),
        )
        if on
    ]
    return {
        "id": record.id,
        "term": entry.term,
        "measured": entry.estimator is not None,
        "record": record,
        "place": f"{point.stage}; varies over {point.over}; {point.time}; {_ACTS[record.acts_on]}",
        "scales": ", ".join(scales) or "its parameters hold at every setting",
        "needs": "; or ".join(_NEEDS[n] for n in record.needs),
        "shown": entry.examples.shown or record.defaults(),
        "picture": picture(shot),
        "signature": signature(entry, shot),
        "equation": equation(record.equation),
    }


_ACTS = {
    "mean": "acts on expected charge",
    "charge": "acts on collected charge",
    "signal": "acts on the analogue value",
    "code": "acts on stored codes",
}


def write_catalogue(
    path: str | Path,
    entries: Sequence[Entry] = ENTRIES,
    tell: Callable[[int, int], None] = lambda number, total: None,
) -> None:
    """Writes the page of some mechanisms, atomically. tell: hears how many are done, of how many.

    Raises BadInput where it cannot be written.
    """
    path = Path(path)
    if path.is_dir() or not path.parent.is_dir():
        raise BadInput(f"{path}: cannot be written: name a file in a folder that exists, as catalogue.html")
    matplotlib.rcParams["mathtext.fontset"] = "cm"
    said = []
    for number, entry in enumerate(entries, start=1):
        said.append(said_of(entry))
        tell(number, len(entries))
    page = jinja2.Environment(autoescape=True).from_string(_PAGE).render(entries=said, count=len(said))
    with texts_in_place({path: page}):
        pass


_PAGE = (Path(__file__).parent / "catalogue.html.jinja").read_text(encoding="utf-8")
