"""The headline table: each figure with its interval, the bar it has to reach, and whether it does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from scipy import stats


class Line(NamedTuple):
    """One row: what, value with its interval as text, bar as text, met (None: not measured, or no bar)."""

    what: str
    value: str
    bar: str
    met: bool | None


def percent(part: dict[str, Any]) -> str:
    """A share with counts and its 95 % interval."""
    if part["value"] is None:
        return "no sets"
    low, high = part["ci95"]
    return f"{100 * part['value']:.1f} % ({part['hits']}/{part['sets']}; {100 * low:.1f}-{100 * high:.1f})"


def number(value: float | None, digits: int = 3) -> str:
    """A number, or a dash."""
    return "-" if value is None else f"{value:.{digits}g}"


def _bar(value: float | None, rule: Callable[[float], bool]) -> bool | None:
    return None if value is None else bool(rule(value))


def lines(result: dict[str, Any], alpha: float = 0.01) -> list[Line]:
    """The table's rows, in the order of the bars of the proof."""
    alarms, ks = result["false_alarms"], result["null_p_uniform"]
    name, half = result["naming"], result["detection"]["all"]
    size, mild, nats = result["amplitude"], result["amplitude_mild"], result["gain"]
    odd, wrong = result["unknown"], result["adversarial"]["sensor_false_alarms"]
    lesser = result["ablation"]
    level = stats.binomtest(alarms["hits"], alarms["sets"], alpha, "greater") if alarms["sets"] else None
    out = [
        Line(
            "false alarms, effect-free sets",
            percent(alarms),
            "<= 1 %",
            None if level is None else bool(level.pvalue > 0.05),
        ),
        Line("- diagnosed whole", percent(alarms["diagnosed"]), "", None),
        Line("- located only", percent(alarms["located"]), "", None),
        Line("null p uniform (KS)", number(ks["ks_p"]), "> 0.05", _bar(ks["ks_p"], lambda v: v > 0.05)),
        Line("null p too small (KS, one side)", number(ks["too_small_p"]), "", None),
        Line(
            "half of the effects seen at",
            f"{number(half['half_at'])} x MDE ({_range(half['ci95'])}; {half['sets']} sets)",
            "<= 2",
            _bar(half["half_at"], lambda v: v <= 2),
        ),
        *(
            Line(
                f"- {family}",
                f"{number(f['half_at'])} x MDE ({_range(f['ci95'])}; {f['sets']} sets)",
                "",
                None,
            )
            for family, f in result["detection"]["family"].items()
        ),
        Line("named at 4 x MDE", percent(name["top1"]), ">= 90 %", _share(name["top1"], _atleast(0.9))),
        Line("- among the first three", percent(name["top3"]), "", None),
        Line("- in the group", percent(name["in_group"]), "", None),
        Line("- mean size of the group", number(name["mean_group"]), "", None),
        Line("- log score, nats", number(name["log_score"]), "", None),
        Line(
            "finding beside the truth, 4 x MDE",
            percent(name["finding_outside_group"]),
            "<= 5 %",
            _bar(name["finding_outside_group"]["value"], lambda v: v <= 0.05),
        ),
        Line("axis right, 4 x MDE", percent(result["localisation"]["axis"]), "", None),
        Line(
            "amplitude, median error, 4 x MDE",
            "-" if size["median_error"] is None else f"{100 * size['median_error']:.1f} %",
            "<= 10 %",
            _bar(size["median_error"], lambda v: v <= 0.1),
        ),
        Line(
            "90 % intervals hold it, 4 x MDE",
            percent(size["coverage90"]),
            "85-95 %",
            _bar(size["coverage90"]["value"], lambda v: 0.85 <= v <= 0.95),
        ),
        Line("90 % intervals hold it, 1-2 x, if seen", percent(mild["coverage90"]), "", None),
        Line(
            "held-out gain over the true model's",
            f"{number(nats['ratio'])} ({number(nats['nats'])} of {number(nats['true_model_nats'])} nats)",
            ">= 0.8",
            _bar(nats["ratio"], _atleast(0.8)),
        ),
        Line("two effects: precision of names", percent(result["double"]["precision"]), "", None),
        Line("two effects: recall of names", percent(result["double"]["recall"]), "", None),
        Line("unknown: flagged", percent(odd["flagged"]), ">= 80 %", _share(odd["flagged"], _atleast(0.8))),
        Line(
            "unknown: misnamed",
            percent(odd["misnamed"]),
            "<= 20 %",
            _bar(odd["misnamed"]["value"], lambda v: v <= 0.2),
        ),
        Line("unknown: card right (axis, time, scaling)", percent(odd["card_all"]), "", None),
        Line("unknown: the fit improves", percent(odd["fit_improves"]), "", None),
        Line(
            "adversarial: the sensor blamed",
            percent(wrong),
            "<= 5 %",
            _bar(wrong["value"], lambda v: v <= 0.05),
        ),
        Line("nothing can show: said not testable", percent(result["abstention"]["justified"]), "", None),
        Line("something can show: said not testable", percent(result["abstention"]["needless"]), "", None),
        Line("KL alone sees, 4 x MDE", percent(lesser["kl_only"]["detected"]), "", None),
        Line("two-sample test alone sees, 4 x MDE", percent(lesser["two_sample_only"]["detected"]), "", None),
        Line("- its false alarms", percent(lesser["two_sample_only"]["false_alarms"]), "", None),
        Line("unweighted battery: false alarms", percent(lesser["unweighted"]["false_alarms"]), "", None),
        Line("- sees, 4 x MDE", percent(lesser["unweighted"]["detected"]), "", None),
        Line("no refit of the noise: false alarms", percent(lesser["no_refit"]["false_alarms"]), "", None),
        Line("- sees, 4 x MDE", percent(lesser["no_refit"]["detected"]), "", None),
        Line(
            "no multiplicity control: false alarms",
            percent(lesser["no_multiplicity_control"]["false_alarms"]),
            "",
            None,
        ),
        Line("seconds a set, median", number(result["seconds"]["median"]), "<= 60", _bar(
            result["seconds"]["median"], lambda v: v <= 60)),
        Line("- longest", number(result["seconds"]["longest"]), "", None),
        Line("sets that failed", str(result["errors"]), "0", result["errors"] == 0),
    ]  # fmt: skip
    return out


def _share(part: dict[str, Any], rule: Callable[[float], bool]) -> bool | None:
    return _bar(part["value"], rule)


def _range(bounds: list[float | None]) -> str:
    return f"{number(bounds[0])}-{number(bounds[1])}"


def _atleast(bar: float) -> Callable[[float], bool]:
    return lambda value: value >= bar


def text(result: dict[str, Any]) -> str:
    """The table for the screen."""
    rows = lines(result)
    wide = max(len(r.what) for r in rows)
    body = max(len(r.value) for r in rows)
    word = {True: "met", False: "MISSED", None: ""}
    return "\n".join(
        f"{r.what:<{wide}}  {r.value:<{body}}  {r.bar:<10}  {word[r.met]}".rstrip() for r in rows
    )
