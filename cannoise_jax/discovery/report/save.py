"""The results of a diagnosis as files: report.json, report.html and the extended simulator, sensor.json."""

from __future__ import annotations

import importlib.metadata
import json
import resource
from pathlib import Path
from typing import Any

from cannoise_jax.discovery.report.document import document
from cannoise_jax.discovery.report.page import page
from cannoise_jax.discovery.result import Result
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import check_place, write_sensor
from cannoise_jax.recordings.atomic import REPORT_FILES, texts_in_place
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.recordings.unfinished import is_finished


def save(
    found: Result,
    folder: str | Path,
    *,
    seconds: float | None = None,
    force: bool = False,
    used: tuple[int, int] | None = None,
) -> dict[str, Any]:
    """Writes `REPORT_FILES` into a folder, made where it is missing, and returns the report.

    seconds: of the run, where more belongs to it than the search. used: rows and columns where frames were
    cut.
    Raises BadInput for no folder, where a file exists (without force) or cannot be written; then all that was
    there is kept.
    """
    if not isinstance(folder, str | Path) or not str(folder).strip():
        raise BadInput(f"folder is {folder!r}: name a folder for the report")
    folder = Path(folder)
    there = [name for name in REPORT_FILES if is_finished(folder / name)]
    if there and not force:
        raise BadInput(f"{folder / there[0]}: exists: name another folder, or replace it (force)")
    report = document(
        found,
        key=found.key,
        version=importlib.metadata.version("cannoise-jax"),
        seconds=found.seconds if seconds is None else seconds,
        peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )
    if used is not None:
        report["cut_to"] = list(used)
    texts = {
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "report.html": page(found, report),
    }
    write(folder, texts, found.model)
    return report


def write(folder: Path, texts: dict[str, str], model: SensorModel) -> None:
    """Puts all results in place once all of them are on the disk, so that a full one keeps what was there."""
    fresh = not folder.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{folder}: no folder can be made here ({error.strerror})") from error
    try:
        check_place(folder / "sensor.json")
        model_files = (folder / "sensor.json", folder / "sensor.npz")
        with texts_in_place({folder / name: text for name, text in texts.items()}, model_files):
            write_sensor(folder / "sensor.json", model)
    except BaseException:
        if fresh and not any(folder.iterdir()):
            folder.rmdir()
        raise
