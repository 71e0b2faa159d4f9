"""The pictures of a report, as PNGs in base64: where a finding lives, and the simulator before and after."""

from __future__ import annotations

import base64
import io

import matplotlib
import numpy as np
from matplotlib.colors import SymLogNorm

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from cannoise_jax.discovery.quality import Curves, Quality
from cannoise_jax.signatures.covariance import LAGS
from cannoise_jax.signatures.fields import Fields
from cannoise_jax.signatures.line_sums import line_sums

_BEFORE, _AFTER, _REAL = "#c8553d", "#2f6fd0", "#1c2430"


def _png(figure) -> str:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=90, bbox_inches="tight")
    plt.close(figure)
    return base64.b64encode(buffer.getvalue()).decode()


def _maps(before: tuple[Fields, ...], after: tuple[Fields, ...], redrawn: bool) -> tuple[list, str]:
    """What the finding changes most, without and with it, `[H, W]` in standard errors, and what that is: one
    difference between two frames, or the frozen residual of the darks or of what is lit."""
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
    chosen = int(np.argmax(moved))
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


def where_picture(before: tuple[Fields, ...], after: tuple[Fields, ...], axis: str, redrawn: bool) -> str:
    """Where: what the finding takes out of the frozen map, or of the difference of two frames for what is
    redrawn in each, and what its axis shows (power of lines, spectrum, offsets of frames, distribution of
    pixels), without and with the finding in the model."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 2.9), layout="constrained", width_ratios=(1.2, 1))
    whole, what = _maps(before, after, redrawn)
    taken = _blocks(whole[0] - whole[1])
    moved = bool(np.abs(taken).max() > 1e-3)
    image = taken if moved else _blocks(whole[0])
    top = float(np.clip(np.quantile(np.abs(image), 0.995), 1, 400))
    norm = SymLogNorm(linthresh=min(3.0, top / 2), vmin=-top, vmax=top)
    shown = axes[0].imshow(image, cmap="RdBu_r", norm=norm, aspect="auto", interpolation="nearest")
    axes[0].set_title(f"{what}: what the finding takes out" if moved else what, fontsize=9)
    axes[0].set_xticks([])
    axes[0].set_yticks([])
    ticks = [v for v in (-100, -30, -10, -3, -1, 0, 1, 3, 10, 30, 100) if abs(v) <= top]
    bar = figure.colorbar(shown, ax=axes[0], ticks=ticks)
    bar.ax.set_yticklabels([str(v) for v in ticks], fontsize=7)
    bar.set_label("standard errors", fontsize=8)
    sides = ((before, whole[0], "without", _BEFORE), (after, whole[1], "with", _AFTER))
    if axis in ("row", "column") and redrawn:
        _lines(axes[1], sides, axis)
    elif axis in ("row", "column", "frequency"):
        _spectra(axes[1], sides, "column" if axis == "column" else "row")
    elif axis == "frame":
        _frames(axes[1], sides)
    else:
        _distributions(axes[1], sides, what)
    axes[1].tick_params(labelsize=8)
    if axes[1].get_legend_handles_labels()[0]:
        axes[1].legend(fontsize=8, frameon=False)
    return _png(figure)


def _lines(panel, sides, line: str) -> None:
    for fields, _, label, colour in sides:
        values, width = _profile(fields, line)
        if values.size:
            panel.semilogy(np.arange(values.size) * width, values, lw=1, label=label, color=colour)
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_title(f"power of {line} offsets between frames (white noise: 1)", fontsize=9)
    panel.set_xlabel(line, fontsize=8)


def _spectra(panel, sides, line: str) -> None:
    for _, image, label, colour in sides:
        means = image.mean(1 if line == "row" else 0) * np.sqrt(image.shape[1 if line == "row" else 0])
        power = np.abs(np.fft.rfft(means - means.mean()))[1:] ** 2 / means.size
        panel.loglog(np.arange(1, power.size + 1), np.maximum(power, 1e-3), lw=1, label=label, color=colour)
    panel.axhline(1, color="0.5", lw=0.7)
    panel.set_ylim(bottom=0.03)
    panel.set_title(f"spectrum of {line} means on the left (white noise: 1)", fontsize=9)
    panel.set_xlabel("cycles per frame", fontsize=8)


def _frames(panel, sides) -> None:
    for fields, _, label, colour in sides:
        offsets = [x.sum() / np.sqrt(f.usable.sum()) for f in fields for x in f.contrasts]
        panel.plot(offsets, ".", ms=4, label=label, color=colour)
    panel.axhline(0, color="0.5", lw=0.7)
    panel.set_yscale("symlog", linthresh=3)
    panel.set_title("offsets between whole frames, standard errors", fontsize=9)
    panel.set_xlabel("differences of frames, all recordings", fontsize=8)


def _distributions(panel, sides, what: str) -> None:
    edges = np.linspace(-10, 10, 81)
    middle = (edges[1:] + edges[:-1]) / 2
    for _, image, label, colour in sides:
        counts, _ = np.histogram(np.clip(image, -9.99, 9.99), edges)
        panel.semilogy(middle, np.maximum(counts / image.size / 0.25, 1e-7), lw=1, label=label, color=colour)
    panel.semilogy(middle, np.exp(-(middle**2) / 2) / np.sqrt(2 * np.pi), color="0.5", lw=0.7, label="normal")
    panel.set_ylim(1e-7, 1)
    panel.set_title("distribution of the pixels on the left (beyond 10: at 10)", fontsize=9)
    panel.set_xlabel(f"{what}, standard errors", fontsize=8)


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


def quality_picture(quality: Quality) -> str:
    """Spectra, covariance maps, photon-transfer curve and probability integral transform of the recordings
    and of draws of the simulator before and after."""
    figure, axes = plt.subplots(2, 4, figsize=(13, 5.4), layout="constrained")
    sides = (
        (quality.real, "recordings", _REAL, 1.6),
        (quality.before.curves, "draws before", _BEFORE, 1.0),
        (quality.after.curves, "draws after", _AFTER, 1.0),
    )
    for panel, name in ((axes[0, 0], "row"), (axes[0, 1], "column")):
        for curves, label, colour, width in sides:
            frequency, power = _binned(getattr(curves, f"{name}_spectrum"))
            panel.loglog(frequency, power, lw=width, label=label, color=colour)
        panel.set_title(f"spectrum of {name} means (white noise: 1)", fontsize=9)
        panel.set_xlabel("cycles per frame", fontsize=8)
    axes[0, 0].legend(fontsize=8, frameon=False)
    _transfer(axes[0, 2], axes[0, 3], sides)
    top = max(float(np.max(np.abs(quality.real.covariance))), 0.003)
    for panel, (curves, label, _, _) in zip(axes[1, :3], sides, strict=True):
        shown = panel.imshow(covariance_map(curves), cmap="RdBu_r", vmin=-top, vmax=top)
        panel.set_title(f"correlation of neighbours, {label}", fontsize=9)
        panel.set_xticks(range(0, 9, 2), [str(v) for v in range(-4, 5, 2)])
        panel.set_yticks(range(0, 9, 2), [str(v) for v in range(-4, 5, 2)])
    figure.colorbar(shown, ax=axes[1, 2])
    centre = (np.arange(quality.before.pit.size) + 0.5) / quality.before.pit.size
    for side, label, colour in ((quality.before, "before", _BEFORE), (quality.after, "after", _AFTER)):
        axes[1, 3].plot(centre, side.pit * side.pit.size, lw=1.2, label=label, color=colour, marker=".")
    axes[1, 3].axhline(1, color="0.5", lw=0.7)
    axes[1, 3].set_title("probability integral transform (right: 1)", fontsize=9)
    axes[1, 3].set_xlabel("share of draws below the recorded value", fontsize=8)
    axes[1, 3].legend(fontsize=8, frameon=False)
    for panel in axes.ravel():
        panel.tick_params(labelsize=8)
    return _png(figure)


def _binned(spectrum: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A spectrum averaged in about thirty bins of equal ratio."""
    frequency = np.arange(1, spectrum.size + 1)
    edges = np.unique(np.round(np.geomspace(1, spectrum.size + 1, 30)).astype(int))
    pairs = list(zip(edges[:-1], edges[1:], strict=True))
    middle = [float(frequency[a - 1 : b - 1].mean()) for a, b in pairs]
    return np.array(middle), np.maximum([float(spectrum[a - 1 : b - 1].mean()) for a, b in pairs], 1e-3)


def _transfer(curve, ratio, sides) -> None:
    """Variance against signal, and the draws' variance over the recordings'."""
    real = sides[0][0]
    order = np.argsort(real.signal)
    shown = np.maximum(real.signal, 1.0)
    for curves, label, colour, width in sides:
        curve.loglog(shown[order], curves.variance[order], ".-", lw=width, ms=4, label=label, color=colour)
        if curves is not real:
            share = curves.variance / np.maximum(real.variance, 1e-30)
            ratio.semilogx(shown[order], share[order], ".-", lw=width, ms=4, color=colour)
    curve.set_title("temporal variance against signal", fontsize=9)
    curve.set_xlabel("DN above black", fontsize=8)
    curve.set_ylabel("DN²", fontsize=8)
    ratio.axhline(1, color="0.5", lw=0.7)
    ratio.set_title("variance of draws over recordings", fontsize=9)
    ratio.set_xlabel("DN above black", fontsize=8)


def covariance_map(curves: Curves) -> np.ndarray:
    """Correlation with the pixel (dy, dx) away, `[9, 9]`, symmetric, 0 at the centre."""
    out = np.zeros((9, 9))
    for (dy, dx), value in zip(LAGS, curves.covariance, strict=True):
        out[4 + dy, 4 + dx] = out[4 - dy, 4 - dx] = value
    return out
