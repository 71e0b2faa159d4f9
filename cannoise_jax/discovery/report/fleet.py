"""Many diagnoses as one table: a row a camera, the one that its simulator fits worst first."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Any
from urllib.parse import quote

from cannoise_jax.discovery.compare.report import percent, value

SCHEMA = "cannoise/fleet/2"
_COLUMNS = {
    "set": "capture set",
    "camera": "camera",
    "verdict": "verdict",
    "nats_per_pixel": "mismatch, nats a pixel",
    "left": "of it left",
    "findings": "what the simulator lacks",
    "error": "error",
}
_STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 0 auto; padding: 1rem; }
div { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13px; }
th, td { padding: .25rem .6rem; text-align: left; border-bottom: 1px solid #8884; vertical-align: top; }
td { overflow-wrap: anywhere; }
@media screen and (max-width: 40rem) {
  table, tbody, tr, td { display: block; } thead, td:empty { display: none; }
  tr { border-bottom: 1px solid #8884; padding: .4rem 0; } td { border: 0; padding: .1rem 0; }
  td:first-child { font-weight: bold; font-size: 15px; }
  td:not(:first-child)::before { content: attr(data-of) ": "; opacity: .7; }
}
"""


def row(name: str, report: dict[str, Any]) -> dict[str, Any]:
    """What the report of one capture set says, of the simulator that was given.

    nats_per_pixel: of its mismatch, by the layer that knows no names; left: nats that the simulator with the
    findings leaves of them, as a share; both None where that was not measured. findings: mechanism and share
    of the gain on frames held back.
    """
    remains = report["remains"]
    seen = bool(remains) and remains["pixels"] > 0
    return {
        "set": name,
        "camera": report["camera"],
        "verdict": report["verdict"],
        "nats_per_pixel": sum(d["nats"] for d in remains["before"]) / remains["pixels"] if seen else None,
        "left": remains["left"] if remains else None,
        "findings": [{"mechanism": f["mechanism"], "share": f["share"]} for f in report["findings"]],
        "error": None,
    }


def failed(name: str, error: str) -> dict[str, Any]:
    """The row of a capture set that could not be diagnosed."""
    return {**dict.fromkeys(_COLUMNS), "set": name, "findings": [], "error": error}


def ranked(rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """By mismatch, the largest first; then what was not measured, then what failed, by name."""

    def place(r: dict[str, Any]) -> tuple[bool, bool, float, str]:
        nats = r["nats_per_pixel"]
        return r["error"] is not None, nats is None, -(nats or 0.0), r["set"]

    return sorted(rows, key=place)


def lines(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The rows as text."""
    shown = [[text for name, text in _shown(r).items() if name != "error"] for r in rows]
    heads = [head for name, head in _COLUMNS.items() if name != "error"]
    for cells, r in zip(shown, rows, strict=True):
        cells[-1] = r["error"] or cells[-1]
    widths = [max(map(len, column)) for column in zip(heads, *shown, strict=True)]
    return ["  ".join(c.ljust(w) for c, w in zip(r, widths, strict=True)).rstrip() for r in (heads, *shown)]


def texts(
    rows: Sequence[dict[str, Any]], version: str, flags: Sequence[str], sets: Mapping[str, Any]
) -> dict[str, str]:
    """The table as files: JSON, CSV, and a page with links to the reports. sets: by name what every
    report that is there was made of, also of sets that have no row."""
    document = {
        "schema": SCHEMA, "version": version, "flags": list(flags), "sets": dict(sets), "rows": list(rows),
    }  # fmt: skip
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows([r[name] if name != "findings" else _named(r) for name in _COLUMNS] for r in rows)
    return {
        "fleet.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
        "fleet.csv": table.getvalue(),
        "fleet.html": _page(rows),
    }


def _page(rows: Sequence[dict[str, Any]]) -> str:
    head = "".join(f"<th>{escape(name)}</th>" for name in _COLUMNS.values())
    body = "".join("<tr>" + "".join(map(_cell, [r] * len(_COLUMNS), _COLUMNS)) + "</tr>" for r in rows)
    return (
        "<!doctype html><html lang=en><meta charset=utf-8>"
        "<meta name=viewport content='width=device-width, initial-scale=1'>"
        f"<title>Fleet</title><style>{_STYLE}</style><h1>Cameras by what their simulator lacks</h1>"
        f"<div><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div></html>\n"
    )


def _cell(r: dict[str, Any], name: str) -> str:
    text = escape(_shown(r)[name])
    if name == "set" and r["error"] is None:
        text = f'<a href="{quote(r[name])}/report.html">{text}</a>'
    return f'<td data-of="{escape(_COLUMNS[name])}">{text}</td>'


def _shown(r: dict[str, Any]) -> dict[str, str]:
    nats, left = r["nats_per_pixel"], r["left"]
    return {name: r[name] or "" for name in ("set", "camera", "verdict")} | {
        "nats_per_pixel": "" if nats is None else value(nats),
        "left": "" if left is None else percent(left),
        "findings": _named(r),
        "error": r["error"] or "",
    }


def _named(r: dict[str, Any]) -> str:
    """Mechanisms with their shares."""
    parts = (
        f["mechanism"] + ("" if f["share"] is None else f" {percent(f['share'])}") for f in r["findings"]
    )
    return ", ".join(parts)
