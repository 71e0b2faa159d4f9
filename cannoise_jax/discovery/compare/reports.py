"""Two reports of `bin/diagnose` side by side: is the second simulator nearer to the recordings than the
first?"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from cannoise_jax.discovery.compare.report import value
from cannoise_jax.discovery.compare.words import pair
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput

SCHEMA = "cannoise/comparison-of-reports/1"
DIAGNOSIS = "cannoise/diagnosis/2"
"""The schema of report.json. Its number rises where a reader of the one before would misread it."""
_ANY_VERSION = "cannoise/diagnosis/"
_NAME = "report.json"


def read_report(path: str | Path) -> dict[str, Any]:
    """The report.json of a diagnosis, or that in a folder. Raises BadInput for what is none."""
    path = _file(path)
    try:
        report = json_of(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise BadInput(
            f"{path}: cannot be read ({error.strerror}): name a report.json or its folder"
        ) from error
    except (ValueError, RecursionError) as error:
        raise BadInput(f"{path}: is no JSON file: name a report.json or its folder") from error
    schema = report.get("schema") if isinstance(report, dict) else None
    if not str(schema).startswith(_ANY_VERSION):
        raise BadInput(
            f"{path}: is no report of bin/diagnose: name a report.json, or the folder of a diagnosis"
        )
    if schema != DIAGNOSIS:
        other = " ".join(str(schema).split())[:40]
        raise BadInput(
            f"{path}: is a report of another version ({other}, not {DIAGNOSIS}): diagnose the recordings "
            "again"
        )
    return report


def _file(path: str | Path) -> Path:
    path = Path(path)
    return path / _NAME if path.is_dir() else path


def read_compared(path: str | Path) -> dict[str, Any]:
    """As `read_report`, of one that says what still differs. Raises BadInput for others."""
    report = read_report(path)
    if report.get("remains") is None:
        raise BadInput(f"{_file(path)}: says nothing of what still differs: diagnose the recordings again")
    if not _whole(report):
        raise BadInput(f"{_file(path)}: is no whole report of bin/diagnose: diagnose the recordings again")
    return report


def _whole(report: dict[str, Any]) -> bool:
    """Whether a report holds all that is compared, as `report.json` has it."""
    try:
        after, inputs, remains = report["after"], report["inputs"], report["remains"]["after"]
        interval = after["two_sample_auc_ci90"]
        shares = [after["two_sample_auc"], *(interval or ())]
        return (
            isinstance(report["verdict"], str)
            and report["verdict"].isprintable()
            and (interval is None or len(interval) == 2)
            and all(v is None or (_is_number(v) and 0 <= v <= 1) for v in shares)
            and all(isinstance(i["kind"], str) and _is_number(i["frames"]) for i in inputs)
            and all(isinstance(i["sha256"] or i["file"], str) for i in inputs)
            and all(isinstance(d[name], str) for d in remains for name in ("what", "time", "simulator_has"))
            and all(_is_number(d["nats"]) and d["nats"] >= 0 for d in remains)
            and all(d[n] is None or _is_number(d[n]) for d in remains for n in ("recorded", "simulated"))
            and all(d["unit"] is None or isinstance(d["unit"], str) for d in remains)
            and all(isinstance(line, str) and line.isprintable() for line in report.get("faults", []))
        )
    except (KeyError, TypeError, IndexError):
        return False


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def side_by_side(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Both reports as plain data: measures of the simulator that each hands back, and every line that
    differs in one of them; nearer: A, B or neither; faults of the recordings. A measure counts where both
    90 % intervals lie apart.

    Raises BadInput for reports of other recordings: their measures are not alike.
    """
    if _files(a) != _files(b):
        raise BadInput("the reports are of other recordings: diagnose the same ones with both simulators")
    area = _apart(*(r["after"]["two_sample_auc_ci90"] for r in (a, b)))
    left = [sum(d["nats"] for d in r["remains"]["after"]) for r in (a, b)]
    votes = [area, _far_fewer(*left)]
    nearer = (
        "B"
        if max(votes) > 0 and min(votes) >= 0
        else "A"
        if min(votes) < 0 and max(votes) <= 0
        else "neither"
    )
    return {
        "schema": SCHEMA,
        "nearer": nearer,
        "verdicts": [a["verdict"], b["verdict"]],
        "two_sample_auc": [a["after"]["two_sample_auc"], b["after"]["two_sample_auc"]],
        "nats_of_mismatch": left,
        "differences": _lines(a, b),
        "faults": list(dict.fromkeys([*a.get("faults", []), *b.get("faults", [])])),
    }


def _files(report: dict[str, Any]) -> list[tuple]:
    return sorted((str(i["sha256"] or i["file"]), i["kind"], i["frames"]) for i in report["inputs"])


def _apart(first: list[float] | None, second: list[float] | None) -> int:
    """1: the second area is nearer to one half, -1: the first; 0: the intervals overlap."""
    if first is None or second is None or None in (*first, *second):
        return 0
    return int(second[1] < first[0]) - int(first[1] < second[0])


def _far_fewer(first: float, second: float) -> int:
    """Whether one has less than half of the mismatch of the other."""
    return int(second < 0.5 * first) - int(first < 0.5 * second)


def _lines(a: dict[str, Any], b: dict[str, Any]) -> list[dict[str, Any]]:
    """One line for each difference of either, the largest first; None where a report has none."""
    found: dict[tuple, dict[str, Any]] = {}
    for side, report in (("a", a), ("b", b)):
        for d in report["remains"]["after"]:
            kept = {k: d[k] for k in ("recorded", "simulated", "unit", "nats", "simulator_has")}
            line = found.setdefault(
                (d["what"], d["time"]), {"what": d["what"], "time": d["time"], "a": None, "b": None}
            )
            line[side] = max(line[side] or kept, kept, key=lambda e: e["nats"])
    return sorted(found.values(), key=lambda e: -max(s["nats"] for s in (e["a"], e["b"]) if s is not None))


def lines(result: dict[str, Any], most: int = 14) -> list[str]:
    """The comparison as text."""
    said = {
        "A": "the first is nearer",
        "B": "the second is nearer",
        "neither": "nothing says which is nearer",
    }
    out = [f"{said[result['nearer']]} to the recordings"]
    for name, key in (
        ("verdict", "verdicts"),
        ("two-sample area", "two_sample_auc"),
        ("nats", "nats_of_mismatch"),
    ):
        out.append(f"  {name}: " + " | ".join(_said(v) for v in result[key]))
    for d in result["differences"][:most]:
        out.append(f"  {d['what']} ({d['time']}): {_side(d['a'])} | {_side(d['b'])}")
    if len(result["differences"]) > most:
        out.append(f"  and {len(result['differences']) - most} more")
    out += [f"  of the recordings: {line}" for line in result["faults"]]
    return out


def _said(v: Any) -> str:
    return "not measured" if v is None else v if isinstance(v, str) else value(v)


def _side(d: dict[str, Any] | None) -> str:
    if d is None:
        return "no difference"
    both = d["recorded"], d["simulated"]
    recorded, simulated = map(_said, both) if None in both else pair(*both)
    sizes = f"{recorded} recorded, {simulated} simulated"
    return f"{d['simulator_has']}, {sizes} {d['unit']}"
