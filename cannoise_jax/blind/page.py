"""blind.html: the headline table, the figures and the detail tables on one self-contained page."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from html import escape
from typing import Any

from cannoise_jax.blind import figures
from cannoise_jax.blind.table import lines, number, percent

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{padding:.15em .8em;text-align:left}
img{max-width:100%}.met{color:#167a3a}.missed{color:#b3261e;font-weight:600}"""


def table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """An HTML table of plain text."""
    top = "".join(f"<th>{escape(h)}</th>" for h in head)
    body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
    return f"<table><tr>{top}</tr>{body}</table>"


def picture(data: bytes, says: str) -> str:
    """An embedded PNG with its caption."""
    source = base64.b64encode(data).decode()
    return f'<p><img alt="{escape(says)}" src="data:image/png;base64,{source}"><br>{escape(says)}</p>'


def page(result: dict[str, Any], made_by: str) -> str:
    """The page. made_by: one paragraph on sets, seed and commands."""
    word = {True: '<span class="met">met</span>', False: '<span class="missed">missed</span>', None: ""}
    head = "".join(
        f"<tr><td>{escape(r.what)}</td><td>{escape(r.value)}</td><td>{escape(r.bar)}</td><td>{word[r.met]}</td></tr>"
        for r in lines(result)
    )
    named, sized = result["naming"]["by_mechanism"], result["amplitude"]["by_mechanism"]
    gains, mdes = result["gain"]["by_mechanism"], result["mde"]
    detail = [
        (
            m.replace("_", " "),
            percent(named[m]),
            f"{100 * sized[m]['median_error']:.1f} %" if m in sized else "-",
            percent(sized[m]["coverage90"]) if m in sized else "-",
            number(gains[m]["ratio"]) if m in gains else "-",
            number(mdes[m]["median"]) if m in mdes else "-",
        )
        for m in named
    ]
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>Blind trial</title><style>{_STYLE}</style>",
        f"<h1>Blind trial</h1><p>{escape(made_by)}</p>",
        f"<table><tr><th></th><th>measured (95 % interval)</th><th>bar</th><th></th></tr>{head}</table>",
        picture(
            figures.detection(result),
            "Detection against strength. Marks: sets; squares: shares of all sets; vertical line: the bar.",
        ),
        picture(figures.confusion(result), "What was injected, and what the leading finding called it."),
        picture(
            figures.gain(result), "Gain on frames held back, over that of the true model on the same frames."
        ),
        "<h2>Each mechanism at 4 x MDE</h2>",
        table(
            ("mechanism", "named", "amplitude error", "90 % coverage", "gain ratio", "tool's MDE over ours"),
            detail,
        ),
        "<h2>Adversarial sets</h2>",
        table(
            ("cause", "sensor blamed"),
            [(c.replace("_", " "), percent(v)) for c, v in result["adversarial"]["by_cause"].items()],
        ),
        "<h2>Lesser tools on the same sets</h2>",
        table(
            ("tool", "false alarms", "seen at 4 x MDE"),
            [
                (k.replace("_", " "), percent(v["false_alarms"]), percent(v["detected"]))
                for k, v in result["ablation"].items()
            ],
        ),
        "<h2>Sets by who made them</h2>",
        table(
            ("generator", "named at 4 x MDE", "false alarms"),
            [(k, percent(v["top1"]), percent(v["false_alarms"])) for k, v in result["engines"].items()],
        ),
    ]
    return "\n".join(parts) + "\n"
