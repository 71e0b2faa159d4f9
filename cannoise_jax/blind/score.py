"""Scores claims against the opened truth. Every share comes with its interval and its number of sets.

A *finding* is an entry of a report's `findings`. Named right: the leading finding's first candidate is the
injected mechanism; an ambiguous finding counts only if its group holds the mechanism and has at most four
members. A false alarm is a finding of class `sensor`, or `unknown`, where there is nothing to find.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy import optimize, stats

Report = dict[str, Any]
Entry = dict[str, Any]


def share(hits: int, total: int, level: float = 0.95) -> dict[str, Any]:
    """A share with its Clopper-Pearson interval."""
    if total == 0:
        return {"value": None, "hits": 0, "sets": 0, "ci95": [None, None]}
    tail = (1 - level) / 2
    low = float(stats.beta.ppf(tail, hits, total - hits + 1)) if hits else 0.0
    high = float(stats.beta.ppf(1 - tail, hits + 1, total - hits)) if hits < total else 1.0
    return {"value": hits / total, "hits": hits, "sets": total, "ci95": [low, high]}


def findings(report: Report, classes: tuple[str, ...] = ("sensor", "capture", "bookkeeping")) -> list[dict]:
    """Findings of the given classes; what is unknown counts as sensor."""
    return [f for f in report.get("findings", []) if f["class"] in classes or f["mechanism"] == "unknown"]


def alarm(report: Report) -> bool:
    """Whether a report blames the sensor, or says that something unknown is there."""
    return bool(findings(report, ("sensor",)))


def named(finding: dict, mechanism: str) -> bool:
    """Whether a finding names the mechanism, see the module's text."""
    candidates = [c["mechanism"] for c in finding["candidates"] if c["mechanism"] != "unknown"]
    if finding["outcome"] == "AMBIGUOUS":
        return mechanism in candidates and len(candidates) <= 4
    return finding["mechanism"] == mechanism


def rank(finding: dict, mechanism: str) -> int | None:
    """Place of the mechanism among the candidates, from 1."""
    names = [c["mechanism"] for c in finding["candidates"]]
    return names.index(mechanism) + 1 if mechanism in names else None


def score(truth: dict[str, Entry], claims: dict[str, Report]) -> dict[str, Any]:
    """All figures of the headline table, as one JSON-able record."""
    by: dict[str, list[tuple[Entry, Report]]] = {}
    for name, entry in truth.items():
        by.setdefault(entry["category"], []).append((entry, claims[name]))
    nulls = by.get("null", []) + by.get("locate", [])
    single = [(e, r) for e, r in by.get("strong", []) + by.get("curve", [])]
    return {
        "errors": sum("error" in r for r in claims.values()),
        "false_alarms": share(sum(alarm(r) for _, r in nulls), len(nulls)),
        "null_p_uniform": null_uniformity([r for _, r in nulls]),
        "naming": naming(by.get("strong", [])),
        "detection": {
            name: detection([(e, r) for e, r in single if e["effects"][0]["mechanism"] == name])
            for name in sorted({e["effects"][0]["mechanism"] for e, _ in single})
        },
        "detection_all": detection(single),
        "confusion": confusion(by.get("strong", [])),
        "amplitude": amplitude(by.get("strong", [])),
        "double": double(by.get("double", [])),
        "unknown": unknown(by.get("unlisted", []), by.get("concealed", [])),
        "adversarial": {
            "sensor_false_alarms": share(
                sum(alarm(r) for _, r in by.get("adversarial", [])), len(by.get("adversarial", []))
            ),
            "by_cause": {
                cause: share(sum(alarm(r) for _, r in rows), len(rows))
                for cause in sorted({e["adversary"] for e, _ in by.get("adversarial", [])})
                if (rows := [(e, r) for e, r in by["adversarial"] if e["adversary"] == cause])
            },
        },
        "seconds": [r.get("seconds") for r in claims.values() if r.get("seconds") is not None],
    }


def null_uniformity(reports: list[Report]) -> dict[str, Any]:
    """Kolmogorov-Smirnov test of the battery's p-values against the uniform law."""
    p = [r["battery_p_value"] for r in reports if r.get("battery_p_value") is not None]
    if len(p) < 5:
        return {"sets": len(p), "ks_p": None}
    return {"sets": len(p), "ks_p": float(stats.kstest(p, "uniform").pvalue)}


def naming(rows: list[tuple[Entry, Report]]) -> dict[str, Any]:
    """First choice, first three, log score, findings beside the truth, for single effects at 4 x MDE."""
    first = third = outside = 0
    logs, groups = [], []
    per: dict[str, list[int]] = {}
    for entry, report in rows:
        mechanism = entry["effects"][0]["mechanism"]
        found = findings(report)
        hit = bool(found) and named(found[0], mechanism)
        first += hit
        per.setdefault(mechanism, []).append(int(hit))
        place = rank(found[0], mechanism) if found else None
        third += place is not None and place <= 3
        chance = next(
            (c["probability"] for f in found[:1] for c in f["candidates"] if c["mechanism"] == mechanism), 0.0
        )
        logs.append(math.log(max(chance, 1e-6)))
        groups += [len([c for c in f["candidates"] if c["mechanism"] != "unknown"]) for f in found[:1]]
        outside += any(rank(f, mechanism) is None for f in found)
    return {
        "top1": share(first, len(rows)),
        "top3": share(third, len(rows)),
        "log_score": float(np.mean(logs)) if logs else None,
        "mean_group": float(np.mean(groups)) if groups else None,
        "finding_outside_group": share(outside, len(rows)),
        "by_mechanism": {m: share(sum(hits), len(hits)) for m, hits in sorted(per.items())},
    }


def detection(rows: list[tuple[Entry, Report]]) -> dict[str, Any]:
    """Logistic fit of detection in log strength: the multiple of the MDE detected in half of the sets."""
    multiple = np.array([e["effects"][0]["multiple"] for e, _ in rows])
    seen = np.array([bool(findings(r)) for _, r in rows], float)
    out: dict[str, Any] = {
        "sets": len(rows),
        "points": [[float(m), bool(s)] for m, s in zip(multiple, seen, strict=True)],
        "half_at": None,
    }
    if len(rows) < 5 or seen.min() == seen.max():
        return out
    x = np.log(multiple)

    def loss(
        parameters: np.ndarray,
    ) -> float:  # a weak ridge keeps the slope finite when the classes separate
        margin = np.exp(parameters[1]) * (x - parameters[0])
        return float(np.sum(np.logaddexp(0, np.where(seen > 0, -margin, margin))) + 0.05 * parameters[1] ** 2)

    fit = optimize.minimize(loss, (0.3, 1.0), method="Nelder-Mead")
    return {**out, "half_at": float(np.exp(fit.x[0])), "slope": float(np.exp(fit.x[1]))}


def confusion(rows: list[tuple[Entry, Report]]) -> dict[str, dict[str, int]]:
    """Injected mechanism -> leading finding (or `nothing`) -> number of sets."""
    table: dict[str, dict[str, int]] = {}
    for entry, report in rows:
        found = findings(report)
        row = table.setdefault(entry["effects"][0]["mechanism"], {})
        name = found[0]["mechanism"] if found else "nothing"
        row[name] = row.get(name, 0) + 1
    return table


def amplitude(rows: list[tuple[Entry, Report]]) -> dict[str, Any]:
    """Median relative error and coverage of the 90 % interval, where the mechanism was named right."""
    errors, covered = [], []
    for entry, report in rows:
        told = entry["effects"][0]
        for finding in findings(report):
            if (
                finding["mechanism"] == told["mechanism"]
                and (finding.get("amplitude") or {}).get("value") is not None
            ):
                errors.append(abs(finding["amplitude"]["value"] / told["amplitude"] - 1))
                low, high = finding["amplitude"]["ci90"]
                if low is not None and high is not None:
                    covered.append(low <= told["amplitude"] <= high)
                break
    return {
        "median_error": float(np.median(errors)) if errors else None,
        "coverage90": share(sum(covered), len(covered)),
    }


def double(rows: list[tuple[Entry, Report]]) -> dict[str, Any]:
    """Precision and recall of the set of names."""
    right = said = true = 0
    for entry, report in rows:
        names = {e["mechanism"] for e in entry["effects"]}
        claimed = {f["mechanism"] for f in findings(report)}
        right += len(names & claimed)
        said += len(claimed)
        true += len(names)
    return {"precision": share(right, said), "recall": share(right, true)}


def unknown(unlisted: list[tuple[Entry, Report]], concealed: list[tuple[Entry, Report]]) -> dict[str, Any]:
    """Effects that have no name for the tool: seen at all, called unknown, given a wrong name."""
    rows = unlisted + concealed
    seen = [found for _, r in rows if (found := findings(r))]
    flagged = sum(any(f["mechanism"] == "unknown" for f in found) for found in seen)
    misnamed = sum(any(f["mechanism"] != "unknown" for f in found) for found in seen)
    return {
        "detected": share(len(seen), len(rows)),
        "flagged": share(flagged, len(rows)),
        "misnamed": share(misnamed, len(rows)),
    }
