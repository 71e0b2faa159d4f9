"""Single figures of the score: place, amplitude, gain, unknowns, abstentions, lesser tools, time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cannoise_jax.blind.expected import EXPECTED, card_right, place_right
from cannoise_jax.blind.judge import Report, Rows, alarm, count, findings, matching, seen, share, told
from cannoise_jax.blind.listed import NAMES


def localisation(rows: Rows) -> dict[str, Any]:
    """Shares of right axes, periods and places among sets whose effect was named."""
    parts: dict[str, list[bool]] = {"axis": []}
    for entry, report in rows:
        if (f := matching(entry, report)) is not None:
            right = place_right(f.get("where") or {}, f["mechanism"], told(entry).get("where") or {})
            for part, value in right.items():
                parts.setdefault(part, []).append(value)
    return {part: count(values) for part, values in parts.items()}


def amplitude(rows: Rows) -> dict[str, Any]:
    """Median relative error and coverage of the 90 % interval, where the mechanism was named."""
    errors: dict[str, list[float]] = {}
    covered: dict[str, list[bool]] = {}
    for entry, report in rows:
        f, true = matching(entry, report), told(entry)["amplitude"]
        value = (f.get("amplitude") or {}) if f else {}
        if f is None or value.get("value") is None:
            continue
        errors.setdefault(f["mechanism"], []).append(value["value"] / true - 1)
        low, high = value["ci90"]
        if low is not None and high is not None:
            covered.setdefault(f["mechanism"], []).append(low <= true <= high)
    every = [abs(e) for values in errors.values() for e in values]
    return {
        "median_error": float(np.median(every)) if every else None,
        "coverage90": count(c for values in covered.values() for c in values),
        "by_mechanism": {
            m: {
                "median_error": float(np.median(np.abs(values))),
                "median_bias": float(np.median(values)),
                "coverage90": count(covered.get(m, [])),
            }
            for m, values in sorted(errors.items())
        },
    }


def gain(rows: Rows, known: dict[str, dict]) -> dict[str, Any]:
    """Held-out gain of everything found, summed over sets, over that of the true model."""
    ours: dict[str, float] = {}
    best: dict[str, float] = {}
    unjudged = 0
    for entry, report in rows:
        limit = (known.get(entry["set"]) or {}).get("gain")
        if limit is None:
            unjudged += 1
            continue
        mechanism = told(entry)["mechanism"]
        got = sum(f.get("heldout_gain_nats") or 0.0 for f in findings(report))
        ours[mechanism] = ours.get(mechanism, 0.0) + got
        best[mechanism] = best.get(mechanism, 0.0) + limit
    total = sum(best.values())
    return {
        "ratio": sum(ours.values()) / total if total > 0 else None,
        "nats": sum(ours.values()),
        "true_model_nats": total,
        "sets_without_a_true_model": unjudged,
        "by_mechanism": {
            m: {"ratio": ours[m] / best[m] if best[m] > 0 else None, "nats": ours[m], "true_nats": best[m]}
            for m in sorted(best)
        },
    }


def mde_ratio(rows: Rows, known: dict[str, dict]) -> dict[str, Any]:
    """The tool's minimum detectable effect over the injector's, by mechanism: median and range."""
    ratios: dict[str, list[float]] = {}
    for entry, _ in rows:
        value, mine = (known.get(entry["set"]) or {}).get("mde"), told(entry)["mde"]
        if value and mine:
            ratios.setdefault(told(entry)["mechanism"], []).append(value / mine)
    return {
        m: {"median": float(np.median(v)), "range": [min(v), max(v)], "sets": len(v)}
        for m, v in sorted(ratios.items())
    }


def double(rows: Rows) -> dict[str, Any]:
    """Precision and recall of the set of names."""
    right = said = true = 0
    for entry, report in rows:
        names = {e["mechanism"] for e in entry["effects"]}
        claimed = {f["mechanism"] for f in findings(report)}
        right += len(names & claimed)
        said += len(claimed)
        true += len(names)
    return {"precision": share(right, said), "recall": share(right, true)}


def unknown(rows: Rows) -> dict[str, Any]:
    """Effects without a name: seen, called unknown and nothing else, given a wrong name, card right, gain."""
    found = [(e, fs) for e, r in rows if (fs := findings(r))]
    lead = [(e, next(f for f in fs if f["mechanism"] == "unknown")) for e, fs in found if any(
        f["mechanism"] == "unknown" for f in fs)]  # fmt: skip
    cards = [card_right(told(e)["mechanism"], f.get("card") or {}) for e, f in lead]
    gains = [(f.get("heldout_gain_nats") or 0.0) > 0 for _, f in lead]
    return {
        "detected": share(len(found), len(rows)),
        "flagged": share(len(lead), len(rows)),
        "misnamed": count(any(f["mechanism"] != "unknown" for f in findings(r)) for _, r in rows),
        "card": {part: count(c[part] for c in cards) for part in ("axis", "time", "scaling")},
        "card_all": count(all(c.values()) for c in cards),
        "fit_improves": count(gains),
    }


def abstention(rows: Rows) -> dict[str, Any]:
    """Where nothing could show: did the tool say not testable? Where something could: did it abstain?"""
    right = wrong = blind = able = 0
    for entry, report in rows:
        if entry.get("nothing_shows") is None or "not_testable" not in report:
            continue
        said = {n["mechanism"] for n in report["not_testable"]}
        hidden = set(entry["nothing_shows"]) - set(entry["without"])
        open_ = {m for m in EXPECTED if m in NAMES} - hidden - set(entry["without"])
        right, blind = right + len(said & hidden), blind + len(hidden)
        wrong, able = wrong + len(said & open_), able + len(open_)
    return {"justified": share(right, blind), "needless": share(wrong, able)}


def excess(report: Report) -> float:
    """KL of the residuals' histogram to the baseline's, over its floor."""
    return (report["before"]["kl"] or 0) / max(report["before"]["kl_floor"] or 1, 1e-12)


def ablation(nulls: Rows, strong: Rows, known: dict[str, dict]) -> dict[str, Any]:
    """What lesser tools would have said of the same sets: false alarms on nulls, detections at 4 x MDE."""
    full = [r for _, r in nulls if (r.get("before") or {}).get("kl") is not None]
    hit = [r for _, r in strong if (r.get("before") or {}).get("kl") is not None]
    worst = max(map(excess, full), default=math.inf)

    def above(r: Report) -> bool:
        return (r["before"].get("two_sample_auc_ci90") or [0])[0] > 0.5

    def raw(r: Report) -> bool:
        return (1.0 if r.get("battery_raw_p") is None else r["battery_raw_p"]) < 0.01

    def without(what: str, rows: Rows) -> list[float]:
        found = [(known.get(e["set"]) or {}).get(what) for e, _ in rows]
        return [p for p in found if p is not None]

    judged = [r for _, r in nulls if r.get("battery_raw_p") is not None]
    return {
        "whole_tool": {
            "false_alarms": count(alarm(r) for _, r in nulls),
            "detected": count(seen(e, r) for e, r in strong),
        },
        "kl_only": {
            "rule": "KL over its floor above that of every effect-free set",
            "false_alarms": share(0, len(full)),
            "detected": count(excess(r) > worst for r in hit),
            "median_kl_over_floor_nulls": float(np.median([excess(r) for r in full])) if full else None,
            "median_kl_over_floor_strong": float(np.median([excess(r) for r in hit])) if hit else None,
        },
        "two_sample_only": {
            "rule": "90 % interval of the area under the curve above 0.5",
            "false_alarms": count(above(r) for r in full),
            "detected": count(above(r) for r in hit),
        },
        "unweighted": {
            "rule": "smallest family-wise p of the battery below 0.01, every pixel weighing alike",
            "false_alarms": count(p < 0.01 for p in without("unweighted_p", nulls)),
            "detected": count(p < 0.01 for p in without("unweighted_p", strong)),
        },
        "no_refit": {
            "rule": "smallest family-wise p of the battery below 0.01, noise as the files state it",
            "false_alarms": count(p < 0.01 for p in without("unrefitted_p", nulls)),
            "detected": count(p < 0.01 for p in without("unrefitted_p", strong)),
        },
        "no_multiplicity_control": {
            "rule": "smallest p of the battery below 0.01, uncorrected",
            "false_alarms": count(raw(r) for r in judged),
            "detected": count(raw(r) for _, r in strong),
        },
    }


def seconds(rows: Rows) -> dict[str, Any]:
    """Time of a diagnosis: median, 95 % quantile, longest."""
    values = [r["seconds"] for _, r in rows if r.get("seconds") is not None]
    if not values:
        return {"median": None, "q95": None, "longest": None}
    return {
        "median": float(np.median(values)),
        "q95": float(np.quantile(values, 0.95)),
        "longest": float(max(values)),
    }
