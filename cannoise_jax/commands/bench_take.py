"""What a command wrote (results.json, an evaluation's SUITE.json, a test of denoisers, blind.json,
report.json, or a table) as a published result."""

from __future__ import annotations

import hashlib
import re
import subprocess
from pathlib import Path
from typing import Any

from cannoise_jax.commands.denoise_sources import said_of
from cannoise_jax.commands.published import Result, here, source_sha256
from cannoise_jax.recordings.opened import json_of, plainly
from cannoise_jax.recordings.recording import BadInput

_PACKAGE = "cannoise_jax/"
_SIMULATION = ("recordings", "physics", "mechanisms", "evaluation")
_SEARCH = (*_SIMULATION, "vocabulary.py", "signatures", "discovery")
_TRAINING = (*_SIMULATION, "networks", "training", "sampling.py", "model_file.py")
_STRUCTURE = (
    "std_ratio", "row_spectrum", "row_spectrum_real", "lag1_horizontal", "lag1_horizontal_real",
    "excess_kurtosis", "excess_kurtosis_real",
)  # fmt: skip
_WIDE = 8
"""Columns of a suite that fit a page."""
_Parts = dict[str, Any]


def take(root: Path, file: Path, name: str, title: str | None, command: list[str]) -> Result:
    """The result that a file holds, measured on the code of this checkout as it is now.

    The file's own kind decides what of it is shown and which code it depends on. A table is
    {"columns": [...], "rows": [[...]], "values": {...}, "code": [paths]}, and may name its machine and have
    notes. Raises BadInput.
    """
    try:
        content = json_of(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(
            f"{file}: not readable as JSON ({plainly(error)}): name what a command wrote"
        ) from error
    if not name.isidentifier() or name != name.lower():
        raise BadInput(f"--name {name}: small letters, digits and underscores")
    try:
        paths, parts = _parts(root, name, content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise BadInput(
            f"{file}: neither results.json, a suite, denoisers tested, blind.json, report.json nor a table "
            f"({plainly(error)})"
        ) from error
    code = {"commits": _commit(root, paths), "paths": paths, "sha256": source_sha256(root, paths)}
    machine, date = here()
    machine = str(content.get("machine", machine))
    return Result(name, title or name.replace("_", " "), tuple(command), code, machine, date, **parts)


def _parts(root: Path, name: str, content: Any) -> tuple[list[str], _Parts]:
    schema = content.get("schema")
    if schema == "cannoise/results/1":
        return [*_below(_TRAINING), "configs/default.py"], _comparison(content)
    if schema == "cannoise/evaluation/1":
        return [*_below(_TRAINING), "configs/default.py"], _suite(content)
    if schema == "cannoise/denoising/1":
        return _below(_TRAINING), _denoising(content)
    if str(schema).startswith("cannoise/diagnosis/"):
        return _below(_SEARCH), _diagnosis(content)
    if "false_alarms" in content:
        return _below((*_SEARCH, "blind")), _trial(root, name, content)
    rows = tuple(tuple(str(cell) for cell in row) for row in content.get("rows", ()))
    values = {key: str(value) for key, value in content.get("values", {}).items()}
    if not rows and not values:
        raise ValueError("no rows and no values")
    return list(content["code"]), {
        "columns": tuple(content.get("columns", ())),
        "rows": rows,
        "values": values,
        "notes": tuple(str(note) for note in content.get("notes", ())),
    }


def _suite(content: dict[str, Any]) -> _Parts:
    """The first table of a suite; its values are named ROW_COLUMN, in small letters and digits. A table too
    wide for a page is shown with rows and columns changed about."""
    from cannoise_jax.evaluation.results_page import number

    table = content["tables"][0]
    columns = [c for c in table["columns"] if any(isinstance(r.get(c), dict) for r in table["rows"].values())]
    cells, values = {}, {}
    for name, row in table["rows"].items():
        for column in columns:
            found = row.get(column)
            cells[name, column] = str(found or "–")
            if isinstance(found, dict):
                cells[name, column] = values[_identifier(f"{name} {column}")] = number(found["value"])
                if found["low"] is not None:
                    cells[name, column] += f" ({number(found['low'])} to {number(found['high'])})"
    if len(columns) > max(_WIDE, len(table["rows"])):
        rows = [(c, *(cells[name, c] for name in table["rows"])) for c in columns]
        columns = list(table["rows"])
    else:
        rows = [(name, *(cells[name, c] for c in columns)) for name in table["rows"]]
    note = f"{content['patches']} patches, {content['seeds']} seeds; intervals: {content['interval']}."
    notes = (table["note"], note) if table["note"] else (note,)
    return {"columns": ("", *columns), "rows": tuple(rows), "values": values, "notes": notes}


def _denoising(content: dict[str, Any]) -> _Parts:
    """A row for every exposure and noise model, the worst first; its values are named
    EXPOSURE_s_NOISE_psnr, _gain (over Poisson-Gaussian noise), _ssim, _gap (the share of the way to real
    darks), _over_OTHER (the one before in the expected order) and _learned_part (its gain on frames held
    back)."""
    rows, notes = [], []
    values: dict[str, str] = {}
    for exposure, result in content["exposures_s"].items():
        by_psnr = sorted(result["psnr_db"].items(), key=lambda item: item[1]["mean"]["value"])
        for noise, row in by_psnr:
            shown = {
                "psnr": _between(row["mean"], 2),
                "gain": _between(row.get("over_pg"), 2, "+"),
                "ssim": _between(result["ssim"][noise]["mean"], 4),
            }
            rows.append((f"{exposure} s", noise.replace("_", " "), *shown.values()))
            values |= {_identifier(f"{exposure} s {noise} {name}"): text for name, text in shown.items()}
            if "gap_closed" in row:
                values[_identifier(f"{exposure} s {noise} gap")] = f"{row['gap_closed']:.0%}"
        for step in result.get("psnr_db_order", ()):
            found = _between(step["difference"], 2, "+")
            values[_identifier(f"{exposure} s {step['upper']} over {step['lower']}")] = found
        notes.append(
            f"{exposure} s: {result['seeds']} seeds, {result['steps']} steps, {result['scenes']} test scenes "
            f"on {result['test_frames']} dark frames held back; noisy {result['noisy']['psnr_db']:.2f} dB."
        )
        for noise, verdict in result.get("learned_part", {}).items():
            gain = _between(verdict.get("gain_db"), 2, "+")
            values[_identifier(f"{exposure} s {noise} learned part")] = gain
            notes.append(f"{exposure} s, {noise.replace('_', ' ')}: {said_of(verdict)}.")
    notes.append(f"{content['camera']}. Intervals: {content['interval']}.")
    columns = ("darks", "trained on", "PSNR, dB", "over pg, dB", "SSIM")
    return {"columns": columns, "rows": tuple(rows), "values": values, "notes": tuple(notes)}


def _between(found: dict[str, float] | None, digits: int, sign: str = "") -> str:
    """A number with its interval; a dash where there is none."""
    if found is None:
        return "–"
    value, low, high = (f"{found[k]:{sign}.{digits}f}" for k in ("value", "low", "high"))
    return f"{value} ({low} to {high})"


def figure(root: Path, file: Path, caption: str) -> dict[str, str]:
    """A picture that a command wrote, as docs/images holds it from now on. Raises BadInput."""
    place = f"images/{file.name}"
    try:
        data = file.read_bytes()
        if not data.startswith(b"\x89PNG"):
            raise BadInput(f"{file}: no PNG: name a picture that a command wrote")
        (root / "docs" / place).write_bytes(data)
    except OSError as error:
        raise BadInput(f"{file}: cannot be taken ({error.strerror})") from error
    return {"file": place, "sha256": hashlib.sha256(data).hexdigest(), "caption": caption}


def _identifier(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")


def _below(parts: tuple[str, ...]) -> list[str]:
    return [_PACKAGE + part for part in parts]


def _comparison(content: dict[str, Any]) -> _Parts:
    """KL of every noise model, a row a camera."""
    from cannoise_jax.evaluation.tables import HEADINGS

    rows = {**content["cameras"], "pooled": content["pooled"]}
    one = "model_one_reference"
    for camera, row in content.get("one_reference", {}).items():
        rows[camera] = {**rows[camera], one: row}
    models = [m for m in HEADINGS if m in rows["pooled"]]
    cells = tuple(
        (camera, *(f"{row[m]['kl']:.4f}" for m in models), f"{row['model']['kl_floor']:.4f}")
        for camera, row in rows.items()
    )
    pooled = {m: f"{rows['pooled'][m]['kl']:.4f}" for m in models}
    names = {"poisson_gaussian": "published", "poisson_gaussian_recalibrated": "recalibrated"}
    values = {names.get(m, m): kl for m, kl in pooled.items()} | {"floor": cells[-1][-1]}
    values["duration"] = f"{content['seconds'] / 60:.0f} min"
    right, wrong = "model_given" if "model_given" in models else "model", "model_wrong_reference"
    if wrong in models:
        own = content["cameras"].values()
        values["right_better"] = f"{sum(r[right]['kl'] < r[wrong]['kl'] for r in own)} of {len(own)}"
    for camera, row in content["cameras"].items():
        for quantity in _STRUCTURE:
            if row["model"].get(quantity) is not None:
                values[f"{_identifier(camera)}_{quantity}"] = f"{row['model'][quantity]:.2f}"
        if "std_ratio" in row.get(one, {}):
            values[f"{_identifier(camera)}_std_ratio_one_reference"] = f"{row[one]['std_ratio']:.2f}"
    return {"columns": ("camera", *(HEADINGS[m] for m in models), "floor"), "rows": cells, "values": values}


def _trial(root: Path, name: str, content: dict[str, Any]) -> _Parts:
    """The table of a blind trial, and its figures, which are drawn anew."""
    from cannoise_jax.blind import figures, table

    word = {True: "met", False: "missed", None: ""}
    rows = tuple((line.what, line.value, line.bar, word[line.met]) for line in table.lines(content))
    drawn = {
        "detection": (figures.detection, "Share of effects seen against their strength, beside the limit."),
        "confusion": (figures.confusion, "What was injected, and what the leading finding called it."),
        "gain": (figures.gain, "Held-out gain of the findings over that of the true model."),
    }
    pictures = []
    for kind, (draw, caption) in drawn.items():
        place = f"images/{kind}.png" if name == "proof" else f"images/{name}_{kind}.png"
        data = draw(content)
        (root / "docs" / place).write_bytes(data)
        pictures.append({"file": place, "sha256": hashlib.sha256(data).hexdigest(), "caption": caption})
    shares = {"false_alarms": content["false_alarms"], "named": content["naming"]["top1"]}
    values = {key: table.percent(part) for key, part in shares.items()}
    values["half"] = table.number(content["detection"]["all"]["half_at"])
    values["coverage"] = table.percent(content["amplitude"]["coverage90"])
    return {
        "columns": ("quantity", "measured (95 % interval)", "bar", ""),
        "rows": rows,
        "values": values,
        "figures": tuple(pictures),
    }


def _diagnosis(content: dict[str, Any]) -> _Parts:
    """The findings of a diagnosis, a row each."""
    from cannoise_jax.discovery.report.wording import amount, between, meaning_in, nats
    from cannoise_jax.mechanisms import VOCABULARY

    rows = []
    for finding in content["findings"]:
        size, gain = finding["amplitude"], finding["heldout_gain_nats"]
        meaning = meaning_in(finding, VOCABULARY.get(finding["mechanism"]))
        value, interval = (amount(size[part], size["unit"], meaning) for part in ("value", "ci90"))
        strength = f"{value} ({interval})" if size["ci90"][0] < size["ci90"][1] else value
        shown = "not measured" if gain is None else nats(gain, finding["heldout_pixels"] or 0)
        sure, each = "yes" if finding.get("confirmed") else "no", finding["heldout_gain_nats_per_pixel"]
        if sure == "no" and each and gain > 0 and None not in each["ci90"]:
            shown += f" ({between(*(v * finding['heldout_pixels'] for v in each['ci90']))})"
        near = (finding.get("card") or {}).get("nearest")
        name = finding["mechanism"] + (f", nearest to {near}" if near else "")
        rows.append((name.replace("_", " "), strength, shown, sure))
    values = {"findings": str(len(rows)), "verdict": str(content.get("verdict"))}
    values["confirmed"] = str(sum(row[-1] == "yes" for row in rows))
    values["minutes"] = f"{content['seconds'] / 60:.1f}"
    if (content.get("remains") or {}).get("left") is not None:
        values["left"] = f"{content['remains']['left']:.1%}"
    for side in ("before", "after"):
        if content[side]["two_sample_auc"] is not None:
            values[f"auc_{side}"] = f"{content[side]['two_sample_auc']:.3f}"
    columns = ("finding", "strength (90 % interval)", "gain on held-back frames", "confirmed")
    return {"columns": columns, "rows": tuple(rows), "values": values}


def _commit(root: Path, paths: list[str]) -> list[str]:
    """The commit of this checkout, nothing where the sources differ from it or there is no history."""
    try:
        changed = subprocess.run(
            ["git", "status", "--porcelain", "--", *paths],
            cwd=root,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        head = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return []
    return [] if changed else [head]
