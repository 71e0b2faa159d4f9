"""Results of suites as one page that needs nothing else: tables, and figures drawn as SVG."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from html import escape
from typing import Any

_SHADES = (
    *(("#1f6feb", "#6ea3f2"), ("#d1242f", "#ff8a80"), ("#1a7f37", "#6cc47e"), ("#9a6700", "#e0b040")),
    *(("#8250df", "#b79bf5"), ("#57606a", "#b5bec9"), ("#bf3989", "#f08cc4")),
)
"""On light pages and on dark ones."""
_COLOURS = tuple(f"var(--c{n})" for n in range(len(_SHADES)))
_WIDE = 10
"""Columns from which a table is set tighter, so that a page of usual width holds it."""
_STYLE = (
    ":root { "
    + " ".join(f"--c{n}: light-dark({light}, {dark});" for n, (light, dark) in enumerate(_SHADES))
    + """ }
:root { color-scheme: light dark; --dim: light-dark(#57606a, #a3adba); }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; } h3 { font-size: 1rem; }
.wide { overflow-x: auto; } .note, .cost { color: var(--dim); max-width: 48rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: .25rem .6rem; text-align: right; border-bottom: 1px solid #8884; vertical-align: top; }
th:first-child, th.text, td.text { text-align: left; } td.text { min-width: 9rem; max-width: 16rem; }
small { color: var(--dim); display: block; white-space: nowrap; }
.many th, .many td { padding: .25rem .3rem; font-size: 12px; } .many small { white-space: normal; }
img { max-width: 100%; }
svg { width: 100%; min-width: 36rem; max-width: 44rem; height: auto; }
svg text { font: 12px system-ui, sans-serif; fill: currentColor; }
code { overflow-wrap: anywhere; }
@media (max-width: 40rem) { body { font-size: 14px; padding: .6rem; } th, td { padding: .2rem .4rem; }
  svg { min-width: 0; } svg text { font-size: 18px; }
  table, tbody, tbody th { display: block; } thead { display: none; }
  tbody th { text-align: left; border: 0; }
  tr { display: grid; grid-template-columns: repeat(2, minmax(0, 1fr)); border-bottom: 1px solid #8884; }
  tr > :first-child { grid-column: 1 / -1; } td, td.text { text-align: left; border: 0; min-width: 0; }
  [data-of]::before { content: attr(data-of) ": "; color: var(--dim); } }
"""
)


def results_page(records: Mapping[str, Mapping[str, Any]]) -> str:
    """A page of all suites' records, as `bin/evaluate` writes them."""
    parts = [_suite(name, record) for name, record in records.items()]
    return (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>Results</title><style>{_STYLE}</style>"
        "<h1>Noise models, measured</h1><p class=note>Small print: 90 % intervals over seeds and scenes, "
        "both drawn again. Divergences in nats.</p>" + "".join(parts) + "</html>\n"
    )


def _suite(name: str, record: Mapping[str, Any]) -> str:
    parts = [f"<h2 id={escape(name)}>{escape(record.get('title', name))}</h2>"]
    parts += [_table(table) for table in record["tables"]]
    parts += [_figure(figure) for figure in record["figures"]]
    parts += [f"<p class=note>Not run: {escape(note)}</p>" for note in record["notes"]]
    parts.append(
        f"<p class=cost><code>{escape(record['command'])}</code><br>version {escape(record['version'])}, "
        f"{record['seeds']} seeds, {record['patches']} patches, {record['seconds']:.0f} s</p>"
    )
    return "".join(parts)


def _table(table: Mapping[str, Any]) -> str:
    head = "<th></th>" + "".join(
        f"<th{' class=text' if _is_text(table, c) else ''}>{escape(c)}</th>" for c in table["columns"]
    )
    body = "".join(
        f"<tr><th>{escape(name)}</th>" + "".join(_cell(row.get(c), c) for c in table["columns"]) + "</tr>"
        for name, row in table["rows"].items()
    )
    note = f"<p class=note>{escape(table['note'])}</p>" if table["note"] else ""
    kind = " class=many" if len(table["columns"]) > _WIDE else ""
    return (
        f"<h3>{escape(table['title'])}</h3>{note}<div class=wide><table{kind}><thead><tr>{head}</tr></thead>"
        f"<tbody>{body}</tbody></table></div>"
    )


def _is_text(table: Mapping[str, Any], column: str) -> bool:
    """Whether a column holds words, which stand at its left."""
    found = [row.get(column) for row in table["rows"].values() if row.get(column) is not None]
    return bool(found) and all(isinstance(value, str) for value in found)


def _cell(value: Any, column: str) -> str:
    """A cell, which on narrow screens says of which column it is."""
    of = f'data-of="{escape(column)}"'
    if value is None:
        return f"<td {of}>–</td>"
    if isinstance(value, str):
        return f"<td class=text {of}>{escape(value)}</td>"
    small = ""
    if value["low"] is not None:
        small = f"<small>{number(value['low'])} … {number(value['high'])}</small>"
    title = f"{value['seeds']} seeds, {value['patches']} patches"
    return f'<td {of} title="{title}">{number(value["value"])}{small}</td>'


def number(value: float | None) -> str:
    """Three significant digits, without an exponent where a reader would not want one."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    digits = max(0, 2 - math.floor(math.log10(abs(value))))
    return f"{value:.{min(digits, 5)}f}"


def _figure(figure: Mapping[str, Any]) -> str:
    kinds: dict[str, Callable[[Any], str]] = {
        "bars": _bars, "points": _points, "lines": _lines, "image": _image,
    }  # fmt: skip
    drawn = kinds[figure["kind"]](figure["data"])
    return f"<h3>{escape(figure['title'])}</h3><div class=wide>{drawn}</div>"


def _image(data: str) -> str:
    """A PNG that the page itself holds."""
    return f"<img alt='' src='data:image/png;base64,{escape(data)}'>"


def _bars(data: Mapping[str, Mapping[str, Any]]) -> str:
    """Values of positive size on a logarithmic axis, with their intervals; shorter is nearer."""
    least = min((d["value"] for d in data.values() if d["value"] > 0), default=1e-4) / 3
    most = max((d["high"] or d["value"] for d in data.values()), default=1.0)
    span = math.log(max(most / least, 2))

    def x(value: float) -> float:
        return 170 + 430 * max(math.log(max(value, least) / least), 0) / span

    rows = []
    for i, (name, d) in enumerate(sorted(data.items(), key=lambda item: item[1]["value"])):
        y = 8 + 26 * i
        whisker = ""
        if d["low"] is not None:
            line = f"M{x(d['low']):.1f} {y + 9}H{x(d['high']):.1f}"
            whisker = f"<path d='{line}' stroke=currentColor stroke-width=2 />"
        rows.append(
            f"<text x=162 y={y + 13} text-anchor=end>{escape(name)}</text>"
            f"<rect x=170 y={y} width={x(d['value']) - 170:.1f} height=18 fill='{_COLOURS[0]}' opacity=.55 />"
            f"{whisker}<text x=612 y={y + 13}>{number(d['value'])}</text>"
        )
    return f"<svg viewBox='0 0 700 {16 + 26 * len(data)}' role=img>{''.join(rows)}</svg>"


def _frame(points: list[tuple[float, float]]):
    """A function to the picture's coordinates, 60..560 by 300..20."""
    xs, ys = zip(*points, strict=True)
    (x0, x1), (y0, y1) = (min(xs), max(xs)), (min(ys), max(ys))

    def place(x: float, y: float) -> tuple[float, float]:
        return 60 + 440 * (x - x0) / ((x1 - x0) or 1), 300 - 280 * (y - y0) / ((y1 - y0) or 1)

    return place, (x0, x1, y0, y1)


def _legend(names) -> str:
    return "".join(
        f"<circle cx=530 cy={20 + 20 * i} r=5 fill='{_COLOURS[i % 7]}' />"
        f"<text x=542 y={24 + 20 * i}>{escape(n)}</text>"
        for i, n in enumerate(names)
    )


def _points(data: Mapping[str, list]) -> str:
    place, _ = _frame([tuple(p) for points in data.values() for p in points])
    dots = []
    for i, points in enumerate(data.values()):
        for p in points:
            x, y = place(*p)
            dots.append(f"<circle cx={x:.1f} cy={y:.1f} r=4 fill='{_COLOURS[i % 7]}' opacity=.6 />")
    return f"<svg viewBox='0 0 700 320' role=img>{''.join(dots)}{_legend(data)}</svg>"


def _lines(data: Mapping[str, list]) -> str:
    """Lines over a logarithmic axis."""
    logged = {n: [(math.log2(x), y) for x, y in points] for n, points in data.items()}
    place, (x0, x1, y0, y1) = _frame([p for points in logged.values() for p in points])
    parts = []
    for i, points in enumerate(logged.values()):
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in (place(*p) for p in points))
        parts.append(f"<path d='M{path}' fill=none stroke='{_COLOURS[i % 7]}' stroke-width=2 />")
    for x in sorted({p[0] for points in logged.values() for p in points}):
        parts.append(f"<text x={place(x, y0)[0]:.1f} y=322 text-anchor=middle>{2**x:.0f}</text>")
    for y in (y0, (y0 + y1) / 2, y1):
        parts.append(f"<text x=52 y={place(x0, y)[1] + 4:.1f} text-anchor=end>{y:.2f}</text>")
    return f"<svg viewBox='0 0 700 330' role=img>{''.join(parts)}{_legend(data)}</svg>"
