"""When a claim counts as right, and shares with their intervals.

A *finding* is an entry of a report's `findings`; the leading one comes first. Named right: the leading
finding is the injected mechanism; an ambiguous one counts only if its group holds the mechanism, has at most
four members, and each member's best fit lies within 3 nats of the truth's. The group of a finding: candidates
within 3 nats of its first. A false alarm: a finding of class `sensor`, or `unknown`, where there is nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from scipy import stats

from cannoise_jax.blind.expected import EXPECTED

Report = dict[str, Any]
Entry = dict[str, Any]
Rows = list[tuple[Entry, Report]]
TIE_NATS = 3.0
LARGEST_GROUP = 4


def share(hits: int, total: int, level: float = 0.95) -> dict[str, Any]:
    """A share with its Clopper-Pearson interval."""
    if total == 0:
        return {"value": None, "hits": 0, "sets": 0, "ci95": [None, None]}
    tail = (1 - level) / 2
    low = float(stats.beta.ppf(tail, hits, total - hits + 1)) if hits else 0.0
    high = float(stats.beta.ppf(1 - tail, hits + 1, total - hits)) if hits < total else 1.0
    return {"value": hits / total, "hits": int(hits), "sets": int(total), "ci95": [low, high]}


def count(flags: Iterable[bool]) -> dict[str, Any]:
    """Share of the true ones."""
    values = list(flags)
    return share(sum(map(bool, values)), len(values))


def findings(report: Report, classes: tuple[str, ...] = ("sensor", "capture", "bookkeeping")) -> list[dict]:
    """Findings of the given classes; what is unknown counts as sensor."""
    return [f for f in report.get("findings", []) if f["class"] in classes or f["mechanism"] == "unknown"]


def alarm(report: Report) -> bool:
    """Whether a report blames the sensor, or says that something unknown is there."""
    return bool(findings(report, ("sensor",)))


def group(finding: dict) -> list[str]:
    """Candidates that a finding does not tell apart from its first, by name."""
    chances = {c["mechanism"]: c["probability"] for c in finding["candidates"] if c["mechanism"] != "unknown"}
    best = max(chances.values(), default=0.0)
    return [m for m, p in chances.items() if p > 0 and p >= best * math.exp(-TIE_NATS)]


def named(finding: dict, mechanism: str) -> bool:
    """Whether a finding names the mechanism, see the module's text."""
    if finding["outcome"] != "AMBIGUOUS":
        return finding["mechanism"] == mechanism
    members = group(finding)
    if mechanism not in members or len(members) > LARGEST_GROUP:
        return False
    chances = {c["mechanism"]: c["probability"] for c in finding["candidates"]}
    return all(abs(math.log(chances[m] / chances[mechanism])) <= TIE_NATS for m in members)


def seen(entry: Entry, report: Report) -> bool:
    """Whether a report shows the one effect of a set: by name, in a group, as unknown, or by another name of
    its signature family. A finding of another family has seen something else."""
    mechanism = told(entry)["mechanism"]
    family = EXPECTED[mechanism].family
    return any(
        f["mechanism"] in (mechanism, "unknown")
        or mechanism in group(f)
        or (f["mechanism"] in EXPECTED and EXPECTED[f["mechanism"]].family == family)
        for f in findings(report)
    )


def rank(finding: dict, mechanism: str) -> int | None:
    """Place of the mechanism among the candidates, from 1."""
    names = [c["mechanism"] for c in finding["candidates"]]
    return names.index(mechanism) + 1 if mechanism in names else None


def told(entry: Entry) -> dict[str, Any]:
    """The one effect of a set."""
    return entry["effects"][0]


def matching(entry: Entry, report: Report) -> dict | None:
    """The finding that carries the injected mechanism's name."""
    return next((f for f in findings(report) if f["mechanism"] == told(entry)["mechanism"]), None)


def tally(names: Iterable[str]) -> dict[str, int]:
    """How often each name occurs."""
    out: dict[str, int] = {}
    for name in names:
        out[name] = out.get(name, 0) + 1
    return dict(sorted(out.items()))
