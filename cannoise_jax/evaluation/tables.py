"""Results as a table to read and as `results.json` to parse."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

SCHEMA = "cannoise/results/1"
HEADINGS = {
    "gaussian": "Gaussian",
    "poisson_gaussian": "PG published",
    "poisson_gaussian_estimated": "PG estimated",
    "poisson_gaussian_recalibrated": "PG re-calib.",
    "model": "model",
    "model_given": "model, level",
    "model_one_reference": "model, 1 ref.",
    "model_wrong_reference": "wrong refs.",
}
_WIDTH = 17
_ONE = "model_one_reference"

Row = Mapping[str, Mapping[str, float]]


def results_table(results: Mapping[str, Any]) -> str:
    """Rows of cameras and pooled, columns of models: KL with its floor, then what KL cannot see.

    results: as `compare.evaluate_model` gives them. Structure is shown as generated (real).
    """
    rows = {**results["cameras"], "pooled": results["pooled"]}
    blocks = [
        _block(rows, "KL(real || model), nats, mean over patches (finite-sample floor)", _kl_cell),
        _block(rows, "KL with one count added to every bin", lambda n: f"{n['kl_smoothed']:.4f}"),
        _block(rows, "standard deviation, model / real", lambda n: f"{n['std_ratio']:.3f}"),
        _block(rows, "row spectrum at low frequencies, white about 1 (real)", _pair("row_spectrum", 2)),
        _block(rows, "lag-1 correlation along rows (real)", _pair("lag1_horizontal", 3)),
        _block(rows, "lag-1 correlation across rows (real)", _pair("lag1_vertical", 3)),
        _block(rows, "excess kurtosis of the standardised noise (real)", _pair("excess_kurtosis", 2)),
    ]
    return "\n\n".join(block for block in blocks if block)


def write_results(path: Path, results: Mapping[str, Any], seconds: float, **extra: Any) -> None:
    """Write `results.json` atomically: schema, cameras, pooled, settings, seconds, and any `extra` keys.

    What the model does with one reference, where it was given several, has a key of its own, `one_reference`.
    A structure that noise does not have, being zero, is null. Raises ValueError for a KL that is not finite,
    which JSON cannot hold; then nothing is written.
    """
    rows = {**results["cameras"], "pooled": results["pooled"]}
    kept = {name: {m: _numbers(row[m]) for m in row if m != _ONE} for name, row in rows.items()}
    one = {name: _numbers(row[_ONE]) for name, row in rows.items() if _ONE in row}
    settings = {
        name: {iso: {m: _numbers(n) for m, n in row.items()} for iso, row in by_iso.items()}
        for name, by_iso in results.get("settings", {}).items()
    }
    record = {
        "schema": SCHEMA,
        "cameras": {name: kept[name] for name in results["cameras"]},
        "pooled": kept["pooled"],
        **({"one_reference": one} if one else {}),
        "settings": settings,
        "seconds": seconds,
        **extra,
    }
    text = json.dumps(record, indent=1, allow_nan=False)
    unfinished = path.with_name(f".{path.name}.partial")
    try:
        unfinished.write_text(text + "\n")
        unfinished.replace(path)
    except BaseException:
        unfinished.unlink(missing_ok=True)
        raise


def _numbers(row: Mapping[str, float]) -> dict[str, float | None]:
    """Numbers as JSON holds them; those of a KL are left as they are."""
    return {n: v if math.isfinite(v) or n.startswith("kl") else None for n, v in row.items()}


def _block(rows: Mapping[str, Row], title: str, cell: Callable[[Mapping[str, float]], str]) -> str:
    """One table; empty where the numbers were not computed."""
    models = [name for name in HEADINGS if any(name in row for row in rows.values())]
    try:
        body = [
            f"{camera:<10}" + "".join(f"{cell(row[m]) if m in row else '-':>{_WIDTH}}" for m in models)
            for camera, row in rows.items()
        ]
    except KeyError:
        return ""
    head = f"{'camera':<10}" + "".join(f"{HEADINGS[m]:>{_WIDTH}}" for m in models)
    return "\n".join([title, head, *body])


def _kl_cell(numbers: Mapping[str, float]) -> str:
    return f"{numbers['kl']:.4f} ({numbers['kl_floor']:.4f})"


def _pair(name: str, digits: int):
    return lambda numbers: f"{numbers[name]:.{digits}f} ({numbers[name + '_real']:.{digits}f})"
