"""The figures of the proof: detection against the limit, who is taken for whom, gain against the truth."""

from __future__ import annotations

import io
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from cannoise_jax.blind import curves
from cannoise_jax.blind.expected import EXPECTED

_COLOURS = {"mean": "C0", "covariance": "C1", "variance": "C2", "shape": "C3"}


def png(figure) -> bytes:
    """The figure as PNG; closes it."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110, bbox_inches="tight")
    plt.close(figure)
    return buffer.getvalue()


def detection(result: dict[str, Any]) -> bytes:
    """Share of sets whose effect was seen against strength, one curve a signature family, and the limit."""
    figure, axes = plt.subplots(figsize=(7.2, 4.4))
    strength = np.geomspace(0.2, 12, 300)
    axes.plot(
        strength, curves.limit(strength), "k--", lw=1.5, label="limit: likelihood ratio that knows the effect"
    )
    groups = {"all effects": result["detection"]["all"], **result["detection"]["family"]}
    for n, (name, fit) in enumerate(groups.items()):
        colour = _COLOURS.get(name, "0.4")
        points = np.array(fit["points"], float).reshape(-1, 2)
        if n == 0:
            edges = np.geomspace(0.3, 10, 8)
            for low, high in zip(edges[:-1], edges[1:], strict=True):
                inside = (points[:, 0] >= low) & (points[:, 0] < high)
                if inside.any():
                    axes.plot(np.sqrt(low * high), points[inside, 1].mean(), "s", color=colour, ms=5)
        else:
            jitter = 0.012 * (n - 2.5)
            axes.plot(points[:, 0], points[:, 1] + jitter, "|", color=colour, ms=7, alpha=0.7)
        if fit["half_at"] is not None:
            label = f"{name}: half at {fit['half_at']:.2g} ({fit['sets']} sets)"
            axes.plot(
                strength, curves.chance(strength, fit["half_at"], fit["slope"]), color=colour, label=label
            )
        else:
            axes.plot([], [], color=colour, label=f"{name}: no curve ({fit['sets']} sets)")
    axes.axvline(2, color="0.8", lw=1)
    axes.set(
        xscale="log",
        xlabel="strength, multiples of the minimum detectable effect",
        ylabel="share of sets seen",
    )
    axes.set_xticks([0.3, 0.5, 1, 2, 4, 10], ["0.3", "0.5", "1", "2", "4", "10"])
    axes.legend(fontsize=8, loc="lower right")
    return png(figure)


def confusion(result: dict[str, Any]) -> bytes:
    """Injected mechanism (row) against leading finding (column), sets at 4 x MDE."""
    table = result["confusion"]
    order = [m for m in EXPECTED if m in table]
    said = {name for row in table.values() for name in row}
    columns = [*order, *sorted(said - set(order) - {"nothing", "unknown"}), "unknown", "nothing"]
    counts = np.array([[table[m].get(c, 0) for c in columns] for m in order], float).reshape(
        len(order), len(columns)
    )
    figure, axes = plt.subplots(figsize=(0.32 * len(columns) + 3, 0.28 * len(order) + 2.4))
    if counts.size:
        axes.imshow(counts / np.maximum(counts.sum(1, keepdims=True), 1), cmap="Blues", vmin=0, vmax=1.2)
        for i, j in zip(*np.nonzero(counts), strict=True):
            colour = "w" if counts[i, j] > 0.6 * counts[i].sum() else "k"
            axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=8, color=colour)
    axes.set_xticks(range(len(columns)), [c.replace("_", " ") for c in columns], rotation=90, fontsize=8)
    axes.set_yticks(range(len(order)), [m.replace("_", " ") for m in order], fontsize=8)
    axes.set(xlabel="leading finding", ylabel="injected at 4 x MDE")
    return png(figure)


def gain(result: dict[str, Any]) -> bytes:
    """Held-out gain of the tool over that of the true model, by mechanism."""
    rows = result["gain"]["by_mechanism"]
    names = [m for m in EXPECTED if m in rows and rows[m]["ratio"] is not None]
    figure, axes = plt.subplots(figsize=(6.4, 0.26 * len(names) + 1.2))
    values = np.array([rows[m]["ratio"] for m in names])
    shown = np.clip(values, -0.5, 1.5)
    axes.barh(range(len(names)), shown, color=np.where(values >= 0.8, "C0", "C1"))
    for n, value in enumerate(values):
        axes.text(max(shown[n], 0) + 0.02, n, f"{value:.2f}", va="center", fontsize=8)
    axes.axvline(0.8, color="0.5", lw=1, ls="--")
    axes.axvline(1, color="k", lw=1)
    axes.set_yticks(range(len(names)), [m.replace("_", " ") for m in names], fontsize=8)
    axes.invert_yaxis()
    axes.set(xlim=(-0.55, 1.7), xlabel="held-out gain over the true model's (dashed: 0.8)")
    return png(figure)
