"""Published results: one JSON file each in docs/results, with the command, code, machine and date of it.

A result is a table, named values, or both. `code.sha256` is that of the source files below `code.paths` when
it was measured, so a result of older code can be told without a history of the repository.
"""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import platform
from pathlib import Path
from typing import Any, NamedTuple

from cannoise_jax.recordings.recording import BadInput

SCHEMA = "cannoise/published/1"
FOLDER = Path("docs/results")
SUFFIXES = (".py", ".json", ".jinja")
"""The files of a package whose content counts as its code."""


class Result(NamedTuple):
    """One published result.

    code: {"commits": [oldest, ..., newest] or [], "paths": [...], "sha256": "..."}. columns, rows: cells as
    they are shown, both empty where there is no table. values: numbers to cite in a sentence, by name.
    figures: {"file": path below docs, "sha256": "...", "caption": "..."}.
    """

    name: str
    title: str
    command: tuple[str, ...]
    code: dict[str, Any]
    machine: str
    date: str
    columns: tuple[str, ...] = ()
    rows: tuple[tuple[str, ...], ...] = ()
    values: dict[str, str] = {}
    notes: tuple[str, ...] = ()
    figures: tuple[dict[str, str], ...] = ()


def read_result(path: Path) -> Result:
    """One file of docs/results. Raises BadInput where it is not one."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content.pop("schema") != SCHEMA:
            raise ValueError(f"schema must be {SCHEMA!r}")
        lists = ("command", "columns", "notes", "figures")
        content |= {name: tuple(content[name]) for name in lists if name in content}
        if "rows" in content:
            content["rows"] = tuple(tuple(row) for row in content["rows"])
        result = Result(name=path.stem, **content)
        if not (result.code["paths"] and result.code["sha256"] and result.command and result.date):
            raise ValueError("command, date, code.paths and code.sha256 are needed")
        for row in result.rows:
            if len(row) != len(result.columns):
                raise ValueError(f"a row of {len(row)} cells, {len(result.columns)} columns")
        cells = [*result.columns, *(cell for row in result.rows for cell in row), *result.values.values()]
        if not all(isinstance(cell, str) for cell in cells):
            raise ValueError("cells and values are text")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise BadInput(f"{path}: no published result ({error}): write it with bin/bench docs") from error
    return result


def read_results(root: Path) -> dict[str, Result]:
    """All results of a checkout, by name."""
    return {path.stem: read_result(path) for path in sorted((root / FOLDER).glob("*.json"))}


def write_result(root: Path, result: Result) -> Path:
    """Writes a result where `read_results` finds it, complete or not at all. Raises BadInput."""
    path = root / FOLDER / f"{result.name}.json"
    content = {"schema": SCHEMA, **result._asdict()}
    del content["name"]
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        partial.write_text(
            json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8"
        )
        partial.replace(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        partial.unlink(missing_ok=True)
    return path


def source_sha256(root: Path, paths: list[str]) -> str:
    """SHA-256 over names and bytes of the source files below `paths`, which are relative to `root`."""
    files: set[Path] = set()
    for name in paths:
        path = root / name
        files |= {path} if path.is_file() else {p for p in path.rglob("*") if p.suffix in SUFFIXES}
    return digest({p.relative_to(root).as_posix(): p.read_bytes() for p in files if p.is_file()})


def digest(files: dict[str, bytes]) -> str:
    """SHA-256 over files by name."""
    whole = hashlib.sha256()
    for name in sorted(files):
        whole.update(name.encode() + b"\0" + files[name] + b"\0")
    return whole.hexdigest()


def is_older(root: Path, result: Result) -> bool:
    """Whether the code that the result was measured on is not the code of this checkout."""
    return source_sha256(root, result.code["paths"]) != result.code["sha256"]


def here() -> tuple[str, str]:
    """Machine and date, as a new result states them."""
    machine = f"{os.cpu_count()} cores, {platform.machine()}, Python {platform.python_version()}"
    return machine, datetime.date.today().isoformat()
