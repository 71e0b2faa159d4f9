"""Plots as SVG text that takes its colours from the page: it prints, and is dark where the page is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np

_WIDTH, _HEIGHT = 420, 290
_LEFT, _RIGHT, _TOP, _BOTTOM = 66, 24, 14, 46
_LINE, _LETTER = 15, 6.5
"""Height of a line and width of a letter of the legend."""
_FEWEST_TICKS = 2
"""One number tells no scale."""
_DIGIT, _TITLE = 7, 26
"""Width of a digit at an axis, and what the title beside it and the gaps about it take."""


class Series(NamedTuple):
    """Points of one channel. colour: number of a colour of the page. line: joined, else dots."""

    label: str
    x: Sequence[float] | np.ndarray
    y: Sequence[float] | np.ndarray
    colour: int = 0
    line: bool = False
    dashed: bool = False


def plot(series: Sequence[Series], x_label: str, y_label: str, *, log_x=False, log_y=False) -> str:
    """One figure with axes, grid and legend; points that an axis cannot show are left out."""
    kept = [s for s in (_shown(s, log_x, log_y) for s in series) if len(s.x)]
    if not kept:
        return ""
    xs, ys = (np.concatenate([np.asarray(getattr(s, a), float) for s in kept]) for a in "xy")
    scale_y = _scale(ys, log_y, _HEIGHT - _BOTTOM, _TOP)
    left = max(_LEFT, _TITLE + _DIGIT * max(map(len, _numbers(scale_y.ticks)), default=0))
    scale_x = _scale(xs, log_x, left, _WIDTH - _RIGHT)
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" role="img" '
        f'aria-label="{escape(y_label)} over {escape(x_label)}">'
    ]
    parts += _across(scale_x, x_label) + _up(scale_y, y_label, left)
    paths = [[(scale_x.place(x), scale_y.place(y)) for x, y in zip(s.x, s.y, strict=True)] for s in kept]
    for s, at in zip(kept, paths, strict=True):
        style = f"c{s.colour}{' dashed' if s.dashed else ''}"
        if s.line:
            parts.append(
                f'<polyline class="line {style}" points="{" ".join(f"{x:.1f},{y:.1f}" for x, y in at)}"/>'
            )
        else:
            parts += [f'<circle class="dot {style}" cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in at]
    labelled = list({s.label: s for s in kept if s.label}.values())
    edge, top = _free_corner(kept, paths, [s.label for s in labelled], left)
    for n, s in enumerate(labelled):
        y = top + 12 + _LINE * n
        parts.append(f'<rect class="key c{s.colour}" x="{edge + 8}" y="{y - 7}" width="12" height="4"/>')
        parts.append(f'<text class="legend" x="{edge + 25}" y="{y - 1}">{escape(s.label)}</text>')
    return "\n".join([*parts, "</svg>"])


def _free_corner(
    kept: Sequence[Series], paths: Sequence[list[tuple[float, float]]], labels: Sequence[str], left: float
) -> tuple[float, float]:
    """Left and top of the legend, in the corner where least of the data lies; the upper left where all are
    as good."""
    width, height = 32 + _LETTER * max(map(len, labels), default=0), 8 + _LINE * len(labels)
    points = [p for s, path in zip(kept, paths, strict=True) for p in (_filled(path) if s.line else path)]
    corners = [(x, y) for y in (_TOP, _HEIGHT - _BOTTOM - height) for x in (left, _WIDTH - _RIGHT - width)]

    def covered(corner: tuple[float, float]) -> int:
        return sum(0 <= x - corner[0] <= width and 0 <= y - corner[1] <= height for x, y in points)

    return min(corners, key=covered)


def _filled(path: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points along a line, some pixels apart."""
    out = path[:1]
    for (x0, y0), (x1, y1) in pairwise(path):
        count = 1 + int(math.hypot(x1 - x0, y1 - y0) / _LINE * 2)
        out += [(x0 + (x1 - x0) * n / count, y0 + (y1 - y0) * n / count) for n in range(1, count + 1)]
    return out


class _Scale(NamedTuple):
    low: float
    high: float
    log: bool
    start: float
    end: float
    ticks: tuple[float, ...]

    def place(self, value: float) -> float:
        v = math.log10(value) if self.log else value
        return self.start + (v - self.low) / (self.high - self.low) * (self.end - self.start)


def _shown(s: Series, log_x: bool, log_y: bool) -> Series:
    x, y = np.asarray(s.x, float), np.asarray(s.y, float)
    keep = np.isfinite(x) & np.isfinite(y)
    keep &= (x > 0) | (not log_x)
    keep &= (y > 0) | (not log_y)
    return s._replace(x=x[keep], y=y[keep])


def _scale(values: np.ndarray, log: bool, start: float, end: float) -> _Scale:
    v = np.log10(values) if log else values
    low, high = float(v.min()), float(v.max())
    if not log and 0 < low < 0.3 * high:
        low = 0.0
    span = high - low or abs(high) or 1.0
    low, high = low - (0.04 * span if low else 0.0), high + 0.06 * span
    if log:
        whole = range(math.floor(low), math.ceil(high) + 1)
        fine = (1, 2, 3, 5, 7) if high - low < 0.9 else (1, 2, 5) if high - low < 2.2 else (1,)
        ticks = tuple(f * 10.0**e for e in whole for f in fine if low <= math.log10(f * 10.0**e) <= high)
        if len(ticks) < _FEWEST_TICKS:  # of a range too short for round factors
            ticks = _even_ticks(10.0**low, 10.0**high)
    else:
        ticks = _even_ticks(low, high)
    return _Scale(low, high, log, start, end, ticks)


def _even_ticks(low: float, high: float) -> tuple[float, ...]:
    step = 10.0 ** math.floor(math.log10((high - low) / 4))
    step *= next((f for f in (1, 2, 5, 10) if (high - low) / (f * step) <= 6), 10)
    first = math.ceil(low / step)
    return tuple(n * step for n in range(first, first + 20) if n * step <= high)


def _across(scale: _Scale, label: str) -> list[str]:
    bottom = _HEIGHT - _BOTTOM
    out = []
    for tick, text in zip(scale.ticks, _numbers(scale.ticks), strict=True):
        at = scale.place(tick)
        out.append(f'<path class="grid" d="M{at:.1f} {_TOP}V{bottom}"/>')
        out.append(f'<text class="tick" x="{at:.1f}" y="{bottom + 16}" text-anchor="middle">{text}</text>')
    middle = (scale.start + scale.end) / 2
    title = f'<text class="title" x="{middle}" y="{_HEIGHT - 8}" text-anchor="middle">{escape(label)}</text>'
    return [*out, title]


def _up(scale: _Scale, label: str, left: float) -> list[str]:
    out = []
    for tick, text in zip(scale.ticks, _numbers(scale.ticks), strict=True):
        at = scale.place(tick)
        out.append(f'<path class="grid" d="M{left} {at:.1f}H{_WIDTH - _RIGHT}"/>')
        out.append(f'<text class="tick" x="{left - 6}" y="{at + 4:.1f}" text-anchor="end">{text}</text>')
    middle = (scale.start + scale.end) / 2
    title = f'<text class="title" x="14" y="{middle}" text-anchor="middle" '
    return [*out, f'{title}transform="rotate(-90 14 {middle})">{escape(label)}</text>']


def _numbers(ticks: Sequence[float]) -> list[str]:
    """The ticks as text, with the digits that tell one from the next."""
    texts = [_number(t, 6) for t in ticks]
    for digits in range(7, 16):
        if len(set(texts)) == len(texts) and _evenly(texts, ticks):
            break
        texts = [_number(t, digits) for t in ticks]
    return texts


def _evenly(texts: Sequence[str], ticks: Sequence[float]) -> bool:
    """Whether no tick is rounded by a visible part of what parts it from the next."""
    gap = min((b - a for a, b in pairwise(ticks)), default=math.inf)
    return all(abs(float(text) - tick) < 0.02 * gap for text, tick in zip(texts, ticks, strict=True))


def _number(value: float, digits: int) -> str:
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits}g}"
    text = f"{value:.{digits - 6}e}"
    return text.replace("e+0", "e").replace("e-0", "e-")
