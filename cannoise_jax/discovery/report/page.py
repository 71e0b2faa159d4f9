"""The page of a report: one self-contained HTML file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from cannoise_jax.discovery.compare.report import percent
from cannoise_jax.discovery.compare.words import digits, ends, is_wide, pair, short
from cannoise_jax.discovery.proof.verdict import EXPLAINED, MATCH, NO_CAUSE, NOT_TESTABLE
from cannoise_jax.discovery.report.card import lines as card_lines
from cannoise_jax.discovery.report.document import listed_steps
from cannoise_jax.discovery.report.light import sentence_of
from cannoise_jax.discovery.report.pictures import quality_pictures, where_pictures
from cannoise_jax.discovery.report.wording import CERTAIN, amount, meaning_in, nats, placed
from cannoise_jax.discovery.result import Result
from cannoise_jax.discovery.search.declare import NOTHING_LOOKS
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.physics.core import places
from cannoise_jax.recordings.recording import Recording
from cannoise_jax.signatures.signature import Axes
from cannoise_jax.vocabulary import Term

_ABBREVIATIONS = frozenset(["DSNU", "PRNU", "FPN", "RTS"])
"""Parts of names that are read letter by letter."""
_NOTHING_LEFT = 1e-3
"""Share of the mismatch, in nats, below which what is left of it is not what still tells the draws apart."""
_MEASURES = (
    ("two_sample_auc", "a small network tells recordings from draws, area under the curve (0.5: it cannot)"),
    ("two_sample_auc_ci90", "its 90 % interval, frames resampled"),
    ("nll_nats_per_pixel", "surprise about new frames, nats per pixel (less is better)"),
    ("kl", "KL divergence of the noise histograms, nats (of the bins that both fill: may be negative)"),
    ("kl_floor", "what two equal samples of this size would show"),
)


def number(value: Any) -> str:
    """A number, or a pair of them, as the page prints it."""
    if value is None:
        return "not measured"
    if isinstance(value, (list, tuple)):
        each = [number(v) for v in value]
        return " to ".join(ends(*value) if is_wide(*value) and each[0] == each[1] else each)
    if isinstance(value, str):
        return value
    if isinstance(value, int) or 1e4 <= abs(value) < 1e9:
        return f"{value:,.0f}"
    return digits(value, 4) if abs(value) < 1e5 else f"{value:.3e}"


def gain_interval(ends90: list[float | None]) -> str:
    """What follows a gain on new frames in the page: its interval. Parts of the frames that gain alike to the
    last digit shown have no scatter to tell, as of a law of whole recordings, of which each has one value."""
    if None in ends90:
        return ", too few frames for an interval"
    low, high = (number(v) for v in ends90)
    return "" if low == high else f", 90 %: {low} to {high}"


def precise(value: Any) -> str:
    """A number with six decimals, for differences in the fourth."""
    return f"{value:.6f}" if isinstance(value, float) else number(value)


def place(where: dict[str, Any]) -> str:
    """`where` in words."""
    more = []
    for name, value in where.items():
        if name == "axis" or value in (None, [], ""):
            continue
        if where["axis"] == "signal" and name in ("range", "sign"):
            more += _of_signals(name, value)
            continue
        if name == "recordings":  # by their names: where they lie is in the table of recordings
            value = [Path(str(path)).name for path in value] if isinstance(value, list) else value
        more.append(f"{name.replace('_', ' ')}: {_listed(value)}")
    axis = places.place(where["axis"])
    spectrum = where["axis"] == "frequency" and not where.get("period_px")
    return (axis.over if spectrum else axis.at) + (f" ({'; '.join(more)})" if more else "")


def _of_signals(name: str, value: Any) -> list[str]:
    """Where among the signals: DN above black, or shares of the range, of which the whole is said already."""
    if name == "sign":
        return [f"{'more' if value > 0 else 'less'} noise there than a straight line has"] if value else []
    low, high = value
    if low == high:
        return [f"most at a signal of {short(low)} DN"] if low > 0 else []
    if low > 0:
        return [f"signals of {short(low)} to {short(high)} DN"]
    return [f"up to {100 * high:.0f} % of the range"] if high < 1 else []


def _listed(value: Any) -> str:
    """A value of `where`, numbers short, of long lists the first eight."""
    if isinstance(value, list):
        parts = [f"({', '.join(map(_listed, v))})" if isinstance(v, list) else _listed(v) for v in value[:8]]
        return ", ".join([*parts, "…"] if len(value) > 8 else parts)
    return digits(value, 4) if isinstance(value, float) else str(value)


def verdict(report: dict[str, Any]) -> str:
    """The page's first sentence."""
    said = report["verdict"]
    if said == NOT_TESTABLE:
        return "Nothing could be tested with these recordings: see below what to record."
    if said == MATCH:
        return "Match: nothing that was tested differs from the simulator."
    left = _excess(report) + _largest(report)
    if said == NO_CAUSE:
        named = [f for f in report["findings"] if f["mechanism"] != "unknown"]
        if named:
            return (
                "Differs, and no cause was confirmed. Found, but not confirmed on frames held back: "
                f"{_counted(named)}.{left}"
            )
        return f"Differs, and no cause was found.{left}"
    sure = [f for f in report["findings"] if f["confirmed"]]
    rest = [f for f in report["findings"] if not f["confirmed"]]
    start = "Explained" if said == EXPLAINED else "Partly explained"
    if not report["findings"]:
        return f"{start}.{left}"
    names = f"{start}: {_counted(sure or rest)}"
    if not sure:
        return f"{names}, not confirmed on frames held back.{left}"
    more = f" Found, but not confirmed on frames held back: {_counted(rest)}." if rest else ""
    return f"{names}.{more}{left}"


def _excess(report: dict[str, Any]) -> str:
    """What the simulator has at another strength, as a sentence; nothing where there is nothing."""
    of = {"too much": "too much", "too little": "too little of"}
    much = [f"{of[e['sign']]} {_name(e['mechanism'])}" for e in report.get("too_much", ())]
    return f" The simulator has {' and '.join(much)}." if much else ""


def _largest(report: dict[str, Any]) -> str:
    """What differs most once all is in the simulator, as a sentence; nothing where nothing does."""
    remains = report.get("remains")
    if not remains or not remains["after"]:
        return ""
    if remains["left"] is not None and remains["left"] < _NOTHING_LEFT:
        return _told_apart(report)
    most = remains["after"][0]
    recorded, simulated = sizes(most)
    both = f"{recorded} {most['unit']} recorded, {simulated} {most['unit']} simulated"
    has = f"of which the simulator has {most['simulator_has']} ({both})"
    return f" What still differs most: {most['what']}, {has}."


def nearer_with_rest(report: dict[str, Any]) -> bool:
    """Whether a remainder that is left out makes the draws surely nearer by composite score and area."""
    gate = report.get("gate") or {"tried": (), "remainder": False}
    tried = [t for t in gate["tried"] if t["what"] == "remainder" and not t["entered"]]
    both = [(t["score_nats_per_pixel"], t["area_distance_change"]) for t in tried]
    return not gate["remainder"] and any(s and a and s["ci90"][0] > 0 > a["ci90"][1] for s, a in both)


def _told_apart(report: dict[str, Any]) -> str:
    """That a network still tells the recordings from draws, as a sentence; nothing where it does not."""
    after = report.get("after") or {}
    area, interval = after.get("two_sample_auc"), after.get("two_sample_auc_ci90")
    if area is None or not interval or not interval[0] > 0.5:
        return ""
    return (
        f" Next to nothing of the mismatch is left, but a small network still sees it: an area of {area:.3f}."
    )


def sizes(difference: dict[str, Any]) -> tuple[str, str]:
    """What was recorded and what was simulated, in digits that tell them apart."""
    recorded, simulated = difference["recorded"], difference["simulated"]
    if recorded is None or simulated is None:
        return number(recorded), number(simulated)
    return pair(recorded, simulated)


def sites(values: list[float]) -> str:
    """A number of every mosaic site, once where all are alike."""
    said = [f"{v:,.0f}" if 1000 <= abs(v) < 1e5 else short(v) for v in values]
    return said[0] if len(set(said)) == 1 else ", ".join(said)


def strength(terms: dict[str, Term], mechanism: str, values: Any, of: str | None) -> str:
    """A strength of a mechanism, or an interval of it, with its unit; fractions in percent."""
    return amount(values, of, terms[mechanism].amplitude)


def strength_of(terms: dict[str, Term], finding: dict[str, Any], values: Any) -> str:
    """The strength of a finding, or an interval of it, as `strength` has it."""
    term = terms.get(finding["mechanism"])
    return amount(values, finding["amplitude"]["unit"], meaning_in(finding, term))


def rows(report: dict[str, Any], of_finding: Callable[..., str]) -> list[dict[str, Any]]:
    """The table at the top: what was found, the largest share first, and the remainder. of_finding:
    `strength_of` by the terms of the run."""
    out = [
        {
            "name": _name(f["mechanism"]),
            "what": _place(f),
            "anchor": f"finding-{n + 1}",
            "size": of_finding(f, f["amplitude"]["value"]),
            "sign": f["sign"],
            "share": percent(f["share"]),
            "part": f["share"] or 0.0,
            "confirmed": bool(f["confirmed"]),
            "in_simulator": f["in_simulator"],
        }
        for n, f in enumerate(report["findings"])
    ]
    rest = report["remainder_share"]
    if rest is not None:
        name = "remainder: no name explains it"
        kept = {"name": name, "anchor": "remains", "size": "", "sign": "too little", "part": rest}
        out.append({**kept, "share": percent(rest), "confirmed": True, "in_simulator": True})
    return sorted(out, key=lambda r: -r["part"])


def _counted(findings: list[dict[str, Any]]) -> str:
    """Names of findings, each once with how often it is there."""
    names = [_name(f["mechanism"]) for f in findings]
    each = [n if names.count(n) == 1 else f"{n} ({names.count(n)} times)" for n in dict.fromkeys(names)]
    return each[0] if len(each) == 1 else f"{', '.join(each[:-1])} and {each[-1]}"


def _name(id: str) -> str:
    if id == UNKNOWN:
        return "a structure without a name"
    return " ".join(w.upper() if w.upper() in _ABBREVIATIONS else w for w in id.split("_"))


def _place(finding: dict[str, Any]) -> str:
    """Of a structure without a name, where it lives and what comes nearest; of others their name says it."""
    if finding["mechanism"] != UNKNOWN:
        return ""
    place, nearest = placed(Axes(**finding["card"]["axes"])), finding["card"]["nearest"]
    return f"{place}; nearest: {_name(nearest)}" if nearest else place


def advice(report: dict[str, Any]) -> list[tuple[str, str]]:
    """What to record next, and the mechanisms it would decide, the most decisive first."""
    needs: dict[str, list[str]] = {}
    for entry in report["not_testable"]:
        if not entry["needs"].startswith(NOTHING_LOOKS):
            needs.setdefault(entry["needs"], []).append(_name(entry["mechanism"]))
    return sorted(((n, ", ".join(m)) for n, m in needs.items()), key=lambda e: -e[1].count(","))


def not_looked_for(report: dict[str, Any]) -> str:
    """The mechanisms that no recording lets this version test."""
    unseen = (e for e in report["not_testable"] if e["needs"].startswith(NOTHING_LOOKS))
    return ", ".join(_name(e["mechanism"]) for e in unseen)


def page(diagnosis: Result, report: dict[str, Any]) -> str:
    """The report as HTML with its pictures inside."""
    steps = diagnosis.fitted.steps
    pictures = []
    for n in listed_steps(diagnosis):
        after = steps[n + 1].before if n + 1 < len(steps) else diagnosis.fitted.fields
        axis = steps[n].named.score.where["axis"]
        redrawn = steps[n].named.signature.axes.time in ("redrawn", "modulated")
        of_light = steps[n].named.signature.axes.scales == "signal"
        pictures.append(where_pictures(steps[n].before, after, axis, redrawn, of_light))
    size, of_finding = (partial(f, diagnosis.terms) for f in (strength, strength_of))
    template = resources.files("cannoise_jax.discovery").joinpath("page.html.jinja").read_text("utf-8")
    return jinja2.Template(template, autoescape=True).render(
        card_lines=card_lines,
        not_looked_for=not_looked_for(report),
        camera="Recordings" if diagnosis.capture.camera == Recording.camera else diagnosis.capture.camera,
        r=report,
        verdict=verdict(report),
        nearer_with_rest=nearer_with_rest(report),
        rows=rows(report, of_finding),
        of_finding=of_finding,
        percent=percent,
        sites=sites,
        size=size,
        amount=amount,
        nats=nats,
        certain=CERTAIN,
        pictures=pictures,
        measures=_MEASURES,
        number=number,
        gain_interval=gain_interval,
        is_wide=is_wide,
        shadows_of=sentence_of,
        sizes=sizes,
        precise=precise,
        place=place,
        name=_name,
        advice=advice(report),
        definitions={id: term.definition for id, term in diagnosis.terms.items()},
        quality=[] if diagnosis.quality is None else quality_pictures(diagnosis.quality),
    )
