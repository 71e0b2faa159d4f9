"""The page of a comparison: one small self-contained HTML file."""

from __future__ import annotations

from importlib import resources
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup, escape

from cannoise_jax.discovery.compare.families import STRUCTURE, TEMPORAL, of
from cannoise_jax.discovery.compare.report import Comparison, better_line, percent, sign_in_words
from cannoise_jax.discovery.compare.score import Better
from cannoise_jax.discovery.compare.words import pair
from cannoise_jax.signatures import bank


def page(found: tuple[Comparison, ...], better: Better | None = None) -> str:
    """The page of one comparison, or of two simulators side by side."""
    text = resources.files(__package__).joinpath("page.html").read_text(encoding="utf-8")
    template = jinja2.Environment(autoescape=True).from_string(text)
    first = found[0].bank
    line = better_line(found[0], found[1], better) if better is not None else None
    return template.render(
        title=f"{first.camera}: recordings and simulator compared",
        better=line,
        sides=[_side(c) for c in found],
        alpha=f"{100 * first.alpha:g} %",
    )


def _side(found: Comparison) -> dict[str, Any]:
    rows = [
        {
            "share": percent(d.share),
            "width": round(100 * d.share, 1),
            "side": "less" if d.sign > 0 else "more",
            "what": d.what[0].upper() + d.what[1:],
            "time": d.time,
            "note": d.note,
            "sign": sign_in_words(d.sign),
            **dict(zip(("recorded", "simulated"), pair(d.recorded, d.simulated), strict=True)),
            "unit": d.unit,
            "where": ", ".join(d.where) if len(d.where) <= 3 else f"{len(d.where)} recordings",
        }
        for d in found.differences
    ]
    if found.differences:
        main = found.differences[0]
        recorded, simulated = pair(main.recorded, main.simulated)
        sentence = (
            f"Differs. Most of it, {percent(main.share)}: {main.what}, of which the simulator has "
            f"{sign_in_words(main.sign)} ({recorded} {main.unit} recorded, "
            f"{simulated} simulated)."
        )
    else:
        sentence = "Match: nothing in these frames tells them from draws of the simulator."
    return {
        "heading": f"Against {found.bank.label}",
        "verdict": found.verdict,
        "sentence": sentence,
        "rows": rows,
        "picture": picture(found) if rows else "",
    }


def picture(found: Comparison) -> str:
    """Recorded over simulated power by block height and width, of the recording that differs most: one square
    a size, blue where the simulator has too little."""
    mine = [
        j for j in found.bank.judgements if j.family == of(TEMPORAL, STRUCTURE) and j.where in found.bank.seen
    ]
    if not mine:
        return ""
    worst = max(mine, key=lambda j: float(np.sum(np.minimum(j.z**2, 1e3))))
    size = found.bank.seen[worst.where].size
    shape = bank.counts(size).shape
    ratio = np.log2(np.maximum(worst.recorded, 1e-3) / np.maximum(worst.simulated, 1e-3)).reshape(shape)[0]
    rows, columns = (bank.scales(bank.cropped_side(n) // 2) for n in size)
    cell, left, top = 44, 90, 40
    parts = []
    for i, r in enumerate(rows):
        y = top + cell * i
        label = "whole" if r.whole else f"{r.length}"
        parts.append(f'<text x="{left - 8}" y="{y + 26}" text-anchor="end">{label}</text>')
        for k in range(len(columns)):
            strength = float(np.clip(abs(ratio[i, k]) / 4, 0, 1))
            colour = "var(--less)" if ratio[i, k] > 0 else "var(--more)"
            times = 2 ** ratio[i, k]
            text = f"{times:.0f}" if times >= 100 else f"{times:.2g}"
            parts.append(
                f'<rect x="{left + cell * k}" y="{y}" width="{cell - 2}" height="{cell - 2}" fill="{colour}" '
                f'fill-opacity="{0.05 + 0.8 * strength:.2f}"/>'
                f'<text x="{left + cell * k + 20}" y="{y + 26}" text-anchor="middle">{text}</text>'
            )
    for k, c in enumerate(columns):
        label = "whole" if c.whole else f"{c.length}"
        parts.append(f'<text x="{left + cell * k + 20}" y="{top - 8}" text-anchor="middle">{label}</text>')
    wide, tall = left + cell * len(columns), top + cell * len(rows) + 8
    caption = (
        "Noise power recorded over simulated, by height (down) and width (across) of a block of pixels "
        f"weighed against its neighbour; 1: alike. {worst.where}, frame to frame."
    )
    svg = (
        f'<div class="wide"><svg viewBox="0 0 {wide} {tall}" width="{wide}" role="img" '
        f'aria-label="{caption}"><text x="{left}" y="14">columns</text>'
        f'<text x="4" y="{top + 26}">rows</text>{"".join(parts)}</svg></div>'
    )
    return Markup(f'<p class="small">{escape(caption)}</p>{svg}')
