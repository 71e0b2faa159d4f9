"""The pictures of a report: where a finding lives, and the simulator before and after.

Every panel is a PNG of its own in base64, so that a page sets them side by side or, on a telephone, one
below the other.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from cannoise_jax.discovery.proof.curves import Curves
from cannoise_jax.discovery.proof.quality import Quality
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.lag_sums import LAGS
from cannoise_jax.signatures.line_sums import line_sums

_INCHES = (3.9, 2.8)
"""Width and height of a picture."""
_FAR = 15.0
"""Standard errors beyond which a logarithmic scale shows more."""
_BEFORE, _AFTER, _REAL = "#c8553d", "#2f6fd0", "#1c2430"


class Picture(NamedTuple):
    """A PNG in base64, and what it shows."""

    png: str
    alt: str


def _picture(draw: Callable[..., None], *more: Any) -> Picture:
    """One panel, drawn by draw(panel, ...), which titles it."""
    from matplotlib.figure import Figure  # a diagnosis that is not written down does not wait for it

    figure = Figure(figsize=_INCHES, layout="constrained")
    panel = figure.subplots()
    draw(panel, *more)
    panel.tick_params(labelsize=8)
    alt = panel.get_title().replace("\n", " ")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return Picture(base64.b64encode(buffer.getvalue()).decode(), alt)


def _maps(
    before: tuple[Fields, ...], after: tuple[Fields, ...], redrawn: bool, of_light: bool
) -> tuple[list, str]:
    """What the finding changes most, without and with it, `[H, W]` in standard errors, and what that is: one
    difference between two frames, or the frozen residual of the darks or of what is lit. of_light: whether it
    is of the light, where it changes neither."""
    if redrawn:
        pairs = [(f, g, n) for f, g in _same(before, after) for n in range(min(len(f.contrasts), 4))]
        if pairs:
            f, g, n = max(
                pairs, key=lambda p: float(np.mean((p[0].contrasts[p[2]] - p[1].contrasts[p[2]]) ** 2))
            )
            return [f.contrasts[n], g.contrasts[n]], f"difference of two frames ({f.kind})"
    still = [
        (f.lit, np.stack([f.static, g.static]))
        for f, g in _same(before, after)
        if f.static is not None and g.static is not None
    ]
    if not still:
        return [np.zeros(before[0].mean.shape)] * 2, "nothing to show"
    groups = [[pair for lit, pair in still if lit == group] for group in (False, True)]
    moved = [float(np.mean([np.mean((f - g) ** 2) for f, g in group])) if group else -1.0 for group in groups]
    chosen = int(np.argmax(moved)) if max(moved) > 0 else int(bool(groups[1]) and (of_light or not groups[0]))
    alike = [p for p in groups[chosen] if p.shape == groups[chosen][0].shape]
    return list(np.mean(alike, axis=0) * np.sqrt(len(alike))), f"what stays ({('darks', 'lit')[chosen]})"


def _same(before: tuple[Fields, ...], after: tuple[Fields, ...]) -> list[tuple[Fields, Fields]]:
    later = {f.number: f for f in after}
    return [(f, later[f.number]) for f in before if f.number in later]


def _blocks(mean: np.ndarray) -> np.ndarray:
    """Means of square blocks, times the root of their pixels."""
    b = max(min(mean.shape) // 48, 1)
    h, w = mean.shape[0] // b * b, mean.shape[1] // b * b
    return mean[:h, :w].reshape(h // b, b, w // b, b).mean((1, 3)) * b


def where_pictures(
    before: tuple[Fields, ...], after: tuple[Fields, ...], axis: str, redrawn: bool, of_light: bool = False
) -> list[Picture]:
    """Where: what the finding takes out of the frozen map, or of the difference of two frames for what is
    redrawn in each, and what its axis shows (power of lines, spectrum, offsets or levels of frames,
    distribution of pixels), without and with the finding in the model, or once where both are the same."""
    whole, what = _maps(before, after, redrawn, of_light)
    taken = _blocks(whole[0] - whole[1])
    moved = bool(np.abs(taken).max() > 1e-3)
    image = taken if moved else _blocks(whole[0])
    made = [_picture(_map, image, f"{what}:\nwhat the finding takes out" if moved else what)]
    sides = [(before, whole[0], "without", _BEFORE), (after, whole[1], "with", _AFTER)]
    if axis in ("row", "column") and redrawn:
        return [*made, _picture(_lines, sides, axis)]
    if axis == "frame" and not redrawn and len({f.exposure_s for f in before if not f.lit} - {None}) > 1:
        return [*made, _picture(_levels, before)]
    if axis == "frame":
        return [*made, _picture(_frames, sides)]
    if not moved:
        sides = [(before, whole[0], "recordings", _REAL)]
    if axis in ("row", "column", "frequency"):
        return [*made, _picture(_spectra, sides, "column" if axis == "column" else "row")]
    return [*made, _picture(_distributions, sides, what)]


def _map(panel, image: np.ndarray, title: str) -> None:
    from matplotlib.colors import SymLogNorm

    top = float(np.clip(np.quantile(np.abs(image), 0.995), 1, 400))
    norm = SymLogNorm(linthresh=min(3.0, top / 2), vmin=-top, vmax=top)
    shown = panel.imshow(image, cmap="RdBu_r", norm=norm, aspect="auto", interpolation="nearest")
    panel.set_title(title, fontsize=9)
    panel.set_xticks([])
    panel.set_yticks([])
    ticks = [v for v in (-100, -30, -10, -3, -1, 0, 1, 3, 10, 30, 100) if abs(v) <= top]
    bar = panel.figure.colorbar(shown, ax=panel, ticks=ticks)
    bar.ax.set_yticklabels([str(v) for v in ticks], fontsize=7)
    bar.set_label("standard errors", fontsize=8)


def _legend(panel) -> None:
    if panel.get_legend_handles_labels()[0]:
        panel.legend(fontsize=8, frameon=False)


def _lines(panel, sides, line: str) -> None:
    for fields, _, label, colour in sides:
        values, width = _profile(fields, line)
        if values.size:
            panel.semilogy(np.arange(values.size) * width, values, lw=1, label=label, color=colour)
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_title(f"power of {line} offsets between frames\n(white noise: 1)", fontsize=9)
    panel.set_xlabel(line, fontsize=8)
    _legend(panel)


def _spectra(panel, sides, line: str) -> None:
    for _, image, label, colour in sides:
        means = image.mean(1 if line == "row" else 0) * np.sqrt(image.shape[1 if line == "row" else 0])
        power = np.abs(np.fft.rfft(means - means.mean()))[1:] ** 2 / means.size
        panel.loglog(np.arange(1, power.size + 1), np.maximum(power, 1e-3), lw=1, label=label, color=colour)
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_ylim(bottom=0.03)
    panel.set_title(f"spectrum of {line} means of these maps\n(white noise: 1)", fontsize=9)
    panel.set_xlabel("cycles per frame", fontsize=8)
    _legend(panel)


def _frames(panel, sides) -> None:
    furthest = 0.0
    for fields, _, label, colour in sides:
        offsets = [x.sum() / np.sqrt(f.usable.sum()) for f in fields for x in f.contrasts]
        panel.plot(offsets, ".", ms=4, label=label, color=colour)
        furthest = max(furthest, *np.abs(offsets)) if offsets else furthest
    panel.axhline(0, color="0.5", lw=0.7)
    if furthest > _FAR:
        panel.set_yscale("symlog", linthresh=3)
    panel.set_title("offsets between whole frames,\nstandard errors", fontsize=9)
    panel.set_xlabel("differences of frames, all recordings", fontsize=8)
    _legend(panel)


def _levels(panel, fields: tuple[Fields, ...]) -> None:
    darks = [f for f in fields if not f.lit and f.exposure_s is not None and f.usable.any()]
    seconds = np.array([f.exposure_s for f in darks], float)
    levels = np.array([np.mean(f.mean[f.usable]) for f in darks])
    panel.plot(seconds, levels - levels[np.argmin(seconds)], "o", ms=5, color=_REAL)
    panel.axhline(0, color="0.5", lw=0.7)
    panel.set_title("level of the darks above the shortest, DN", fontsize=9)
    panel.set_xlabel("exposure, s", fontsize=8)


def _distributions(panel, sides, what: str) -> None:
    edges = np.linspace(-10, 10, 81)
    middle = (edges[1:] + edges[:-1]) / 2
    for _, image, label, colour in sides:
        counts, _ = np.histogram(np.clip(image, -9.99, 9.99), edges)
        panel.semilogy(middle, np.maximum(counts / image.size / 0.25, 1e-7), lw=1, label=label, color=colour)
    panel.semilogy(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), color="0.5", lw=0.7, label="normal")
    panel.set_ylim(1e-7, 1)
    panel.set_title("distribution of the pixels\n(beyond 10: at 10)", fontsize=9)
    panel.set_xlabel(f"{what}, standard errors", fontsize=8)
    _legend(panel)


def _profile(fields: tuple[Fields, ...], line: str) -> tuple[np.ndarray, int]:
    """Mean power of the offsets of groups of neighbouring lines, and how many lines are in a group."""
    powers: dict[int, np.ndarray] = {}
    number: dict[int, int] = {}
    for f in fields:
        if len(f.contrasts):
            s = line_sums(f, f.contrasts, line, "additive")
            power = (s.score**2 / np.maximum(s.information, 1e-30)).sum(0)
            powers[power.size] = powers.get(power.size, 0) + power
            number[power.size] = number.get(power.size, 0) + len(f.contrasts)
    if not powers:
        return np.zeros(0), 1
    size = max(number, key=lambda k: number[k])
    values = powers[size] / number[size]
    width = max(size // 64, 1)
    return values[: size // width * width].reshape(-1, width).mean(1), width


def quality_pictures(quality: Quality) -> list[Picture]:
    """Spectra, photon-transfer curve, covariance maps and probability integral transform of the recordings
    and of draws of the simulator before and after."""
    sides = (
        (quality.real, "recordings", _REAL, 1.6),
        (quality.before.curves, "draws before", _BEFORE, 1.0),
        (quality.after.curves, "draws after", _AFTER, 1.0),
    )
    top = max(float(np.max(np.abs(quality.real.covariance))), 0.003)
    return [
        *(_picture(_spectrum, sides, name) for name in ("row", "column")),
        *(_picture(draw, sides) for draw in (_transfer, _ratio)),
        *(_picture(_neighbours, curves, label, top) for curves, label, _, _ in sides),
        _picture(_ranks, quality),
    ]


def _spectrum(panel, sides, name: str) -> None:
    for curves, label, colour, width in sides:
        frequency, power = _binned(getattr(curves, f"{name}_spectrum"))
        panel.loglog(frequency, power, lw=width, label=label, color=colour)
    panel.set_title(f"spectrum of {name} means (white noise: 1)", fontsize=9)
    panel.set_xlabel("cycles per frame", fontsize=8)
    _legend(panel)


def _neighbours(panel, curves: Curves, label: str, top: float) -> None:
    shown = panel.imshow(covariance_map(curves), cmap="RdBu_r", vmin=-top, vmax=top)
    panel.set_title(f"correlation of neighbours, {label}", fontsize=9)
    panel.set_xticks(range(0, 9, 2), [str(v) for v in range(-4, 5, 2)])
    panel.set_yticks(range(0, 9, 2), [str(v) for v in range(-4, 5, 2)])
    panel.figure.colorbar(shown, ax=panel).ax.tick_params(labelsize=7)


def _ranks(panel, quality: Quality) -> None:
    centre = (np.arange(quality.before.pit.size) + 0.5) / quality.before.pit.size
    for side, label, colour in ((quality.before, "before", _BEFORE), (quality.after, "after", _AFTER)):
        panel.plot(centre, side.pit * side.pit.size, lw=1.2, label=label, color=colour, marker=".")
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_title("probability integral transform (right: 1)", fontsize=9)
    panel.set_xlabel("share of draws below the recorded value", fontsize=8)
    _legend(panel)


def _binned(spectrum: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A spectrum averaged in about thirty bins of equal ratio."""
    frequency = np.arange(1, spectrum.size + 1)
    edges = np.unique(np.round(np.geomspace(1, spectrum.size + 1, 30)).astype(int))
    pairs = list(zip(edges[:-1], edges[1:], strict=True))
    middle = [float(frequency[a - 1 : b - 1].mean()) for a, b in pairs]
    return np.array(middle), np.maximum([float(spectrum[a - 1 : b - 1].mean()) for a, b in pairs], 1e-3)


def _transfer(panel, sides) -> None:
    """Variance against signal."""
    order, shown = _by_signal(sides)
    for curves, label, colour, width in sides:
        panel.loglog(shown[order], curves.variance[order], ".-", lw=width, ms=4, label=label, color=colour)
    panel.set_title("temporal variance against signal", fontsize=9)
    panel.set_xlabel("DN above black", fontsize=8)
    panel.set_ylabel("DN²", fontsize=8)
    _legend(panel)


def _ratio(panel, sides) -> None:
    """The draws' variance over the recordings'."""
    order, shown = _by_signal(sides)
    real = np.maximum(sides[0][0].variance, 1e-30)
    for curves, label, colour, width in sides[1:]:
        share = (curves.variance / real)[order]
        panel.semilogx(shown[order], share, ".-", lw=width, ms=4, label=label, color=colour)
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_title("variance of draws over recordings", fontsize=9)
    panel.set_xlabel("DN above black", fontsize=8)
    _legend(panel)


def _by_signal(sides) -> tuple[np.ndarray, np.ndarray]:
    signal = sides[0][0].signal
    return np.argsort(signal), np.maximum(signal, 1.0)


def covariance_map(curves: Curves) -> np.ndarray:
    """Correlation with the pixel (dy, dx) away, `[9, 9]`, symmetric, 0 at the centre."""
    out = np.zeros((9, 9))
    for (dy, dx), value in zip(LAGS, curves.covariance, strict=True):
        out[4 + dy, 4 + dx] = out[4 - dy, 4 - dx] = value
    return out
