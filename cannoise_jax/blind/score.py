"""Scores claims against the opened truth: every figure of the headline table, see `judge` for what counts."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cannoise_jax.blind import curves, measures
from cannoise_jax.blind.expected import EXPECTED
from cannoise_jax.blind.judge import (
    Entry,
    Report,
    Rows,
    alarm,
    count,
    findings,
    group,
    named,
    rank,
    seen,
    tally,
    told,
)


def score(truth: dict[str, Entry], claims: dict[str, Report], known: dict[str, dict] | None = None) -> dict:
    """All figures, as one JSON-able record.

    known: per set what only the truth allows to compute: `mde`, the tool's own minimum detectable effect of
    the injected mechanism, and `gain`, the held-out gain of the true model, nats.
    """
    by: dict[str, Rows] = {}
    for name, entry in truth.items():
        by.setdefault(entry["category"], []).append((entry, claims[name]))

    def get(*names: str) -> Rows:
        return [row for name in names for row in by.get(name, [])]

    nulls = get("null", "locate")
    strong, single = get("strong"), get("strong", "curve")
    adversarial = get("adversarial")
    diagnosed = get("null", "strong", "curve", "double", "unlisted", "concealed", "adversarial")
    families = sorted({EXPECTED[told(e)["mechanism"]].family for e, _ in single})
    each = sorted({told(e)["mechanism"] for e, _ in single})
    mild = [(e, r) for e, r in single if 1 <= told(e)["multiple"] <= 2 and seen(e, r)]
    return {
        "sets": {name: len(rows) for name, rows in sorted(by.items())},
        "errors": sum("error" in r for r in claims.values()),
        "false_alarms": {
            **count(alarm(r) for _, r in nulls),
            "diagnosed": count(alarm(r) for _, r in get("null")),
            "located": count(alarm(r) for _, r in get("locate")),
            "names": tally(f["mechanism"] for _, r in nulls for f in findings(r, ("sensor",))),
        },
        "null_p_uniform": curves.uniformity(
            [r["battery_p_value"] for _, r in nulls if r.get("battery_p_value") is not None]
        ),
        "naming": naming(strong),
        "detection": {
            "all": detection(single),
            "family": {
                f: detection([(e, r) for e, r in single if EXPECTED[told(e)["mechanism"]].family == f])
                for f in families
            },
            "mechanism": {
                m: detection(rows)
                for m in each
                if len(rows := [(e, r) for e, r in single if told(e)["mechanism"] == m]) >= curves.LEAST_SETS
            },
        },
        "confusion": confusion(strong),
        "localisation": measures.localisation(strong),
        "amplitude": measures.amplitude(strong),
        "amplitude_mild": measures.amplitude(mild),
        "gain": measures.gain(strong, known or {}),
        "mde": measures.mde_ratio(single, known or {}),
        "double": measures.double(get("double")),
        "unknown": {
            **measures.unknown(get("unlisted", "concealed")),
            "unlisted": measures.unknown(get("unlisted")),
            "concealed": measures.unknown(get("concealed")),
            "decoys": count(alarm(r) for e, r in get("null") if e["without"]),
        },
        "adversarial": {
            "sensor_false_alarms": count(alarm(r) for _, r in adversarial),
            "by_cause": {
                cause: count(alarm(r) for e, r in adversarial if e["adversary"] == cause)
                for cause in sorted({e["adversary"] for e, _ in adversarial})
            },
        },
        "abstention": measures.abstention(get("null", "curve")),
        "ablation": measures.ablation(nulls, strong, known or {}),
        "seconds": measures.seconds(diagnosed),
        "engines": {
            engine: {
                "top1": count(
                    bool(f := findings(r)) and named(f[0], told(e)["mechanism"])
                    for e, r in strong
                    if e.get("engine", "own") == engine
                ),
                "false_alarms": count(alarm(r) for e, r in nulls if e.get("engine", "own") == engine),
            }
            for engine in sorted({e.get("engine", "own") for e in truth.values()})
        },
    }


def naming(rows: Rows) -> dict[str, Any]:
    """First choice, first three, in the group, log score, findings beside the truth."""
    first, third, inside, outside, logs, sizes = [], [], [], [], [], []
    per: dict[str, list[bool]] = {}
    for entry, report in rows:
        mechanism, found = told(entry)["mechanism"], findings(report)
        lead = found[0] if found else None
        place = rank(lead, mechanism) if lead else None
        first.append(bool(lead and named(lead, mechanism)))
        third.append(place is not None and place <= 3)
        inside.append(bool(lead and (mechanism in group(lead) or lead["mechanism"] == mechanism)))
        outside.append(any(mechanism not in (f["mechanism"], *group(f)) for f in found))
        per.setdefault(mechanism, []).append(first[-1])
        candidates = lead["candidates"] if lead else []
        chance = sum(c["probability"] for c in candidates if c["mechanism"] == mechanism)
        logs.append(math.log(max(chance, 1e-6)))
        sizes += [max(len(group(lead)), 1)] if lead else []
    return {
        "top1": count(first),
        "top3": count(third),
        "in_group": count(inside),
        "log_score": float(np.mean(logs)) if logs else None,
        "mean_group": float(np.mean(sizes)) if sizes else None,
        "finding_outside_group": count(outside),
        "by_mechanism": {m: count(hits) for m, hits in sorted(per.items())},
    }


def detection(rows: Rows) -> dict[str, Any]:
    """Share of sets whose effect was seen, against the strength."""
    return curves.half_power([told(e)["multiple"] for e, _ in rows], [seen(e, r) for e, r in rows])


def confusion(rows: Rows) -> dict[str, dict[str, int]]:
    """Injected mechanism -> leading finding (or `nothing`) -> number of sets."""
    names = sorted({told(e)["mechanism"] for e, _ in rows})
    return {
        m: tally(
            (found[0]["mechanism"] if (found := findings(r)) else "nothing")
            for e, r in rows
            if told(e)["mechanism"] == m
        )
        for m in names
    }
