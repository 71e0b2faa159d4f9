"""bin/diagnose: finds what a noise simulator leaves out of a camera's recordings, and proves it."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import resource
import sys
import tempfile
import time
from pathlib import Path

import jax

from cannoise_jax.commands.parser import OneLineParser
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.page import page
from cannoise_jax.discovery.report import document
from cannoise_jax.mechanisms import ENTRIES
from cannoise_jax.mechanisms.outside import entries_at
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.sensor_json import check_place, write_sensor
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.recording import BadInput


def main(argv: list[str] | None = None) -> int:
    """Writes report.json, report.html and sensor.json; returns 0 whatever the verdict, 2 for bad input."""
    arguments = _parser().parse_args(argv)
    started = time.monotonic()

    def tell(text: str) -> None:
        print(f"[{time.monotonic() - started:6.1f} s] {text}", file=sys.stderr, flush=True)

    try:
        capture = load_capture_set(arguments.recordings)
        _check_output(arguments.out)
        found = diagnose(
            capture,
            arguments.simulator,
            jax.random.key(arguments.key),
            alpha=arguments.alpha,
            without=tuple(id.strip() for id in arguments.without.split(",") if id.strip()),
            mechanisms=(*ENTRIES, *(entry for place in arguments.mechanisms for entry in entries_at(place))),
            tell=tell,
        )
        report = document(
            found,
            key=arguments.key,
            version=importlib.metadata.version("cannoise-jax"),
            seconds=time.monotonic() - started,
            peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        )
        texts = {
            "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
            "report.html": page(found, report),
        }
        _write(arguments.out, texts, found.model)
    except (BadInput, ValueError, OSError, OverflowError) as error:
        print(f"bin/diagnose: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/diagnose: interrupted; nothing was written", file=sys.stderr)
        return 130
    print(f"{capture.camera}: {report['verdict']}")
    for finding in report["findings"]:
        print(f"- {finding['mechanism']}: {finding['sentence']}")
    before, after = report["before"]["two_sample_auc"], report["after"]["two_sample_auc"]
    if before is not None:
        print(f"told from draws of the simulator with an area of {before:.3f} before, {after:.3f} after")
    print(f"{arguments.out / 'report.html'}")
    return 0


def _check_output(out: Path) -> None:
    """Makes the folder. Raises BadInput, before minutes are spent, where the results could not be written."""
    if out.exists() and not out.is_dir():
        raise BadInput(f"{out}: is a file: name a folder for the report")
    if not out.parent.is_dir() and not out.parent.parent.exists():
        raise BadInput(f"{out}: no such folder {out.parent}")
    for name in ("report.json", "report.html", "sensor.json"):
        if (out / name).is_dir():
            raise BadInput(f"{out / name}: is a folder: name another one for the report")
    check_place(out / "sensor.json")
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise BadInput(f"{out}: cannot be written ({error.strerror}): name another folder") from error


def _write(out: Path, texts: dict[str, str], model: SensorModel) -> None:
    """Puts all results in place once all of them are on the disk, so that a full one keeps what was there."""
    beside = {out / name: out / f".{name}.{os.getpid()}" for name in texts}
    try:
        for (path, temporary), text in zip(beside.items(), texts.values(), strict=True):
            try:
                temporary.write_text(text, encoding="utf-8")
            except OSError as error:
                raise BadInput(f"{path}: cannot be written ({error.strerror}): make room for it") from error
        write_sensor(out / "sensor.json", model)
        for path, temporary in beside.items():
            os.replace(temporary, path)
    finally:
        for temporary in beside.values():
            temporary.unlink(missing_ok=True)


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/diagnose", description=__doc__)
    parser.add_argument("--recordings", type=Path, required=True, help="folder of recordings of one camera")
    parser.add_argument(
        "--simulator",
        default="poisson-gaussian",
        help="poisson-gaussian (calibrated from the recordings), nlf (shot and read of the files), a "
        "sensor.json, or a training folder",
    )
    parser.add_argument(
        "--out", type=Path, required=True, help="folder for report.html, report.json, sensor.json"
    )
    parser.add_argument("--alpha", type=float, default=0.01, help="false-alarm rate of the whole run (0.01)")
    parser.add_argument("--key", type=int, default=0, help="seed of everything random (0)")
    parser.add_argument(
        "--without", default="", metavar="ID,...", help="run as if these mechanisms were not known"
    )
    parser.add_argument(
        "--mechanisms",
        metavar="MODULE:NAME",
        action="append",
        default=[],
        help="entries of your own to look for too (docs/adding_a_mechanism.md); may be repeated",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
