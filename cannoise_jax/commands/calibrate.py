"""bin/calibrate --recordings DIR --out sensor.json: photon transfer and mechanisms of one camera.

Prints the tables; writes a camera model that bin/simulate and bin/train take.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path

from cannoise_jax.commands.parser import OneLineParser, numbers
from cannoise_jax.mechanisms import LISTED
from cannoise_jax.physics.core.sensor_json import write_sensor
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.model import Finding, find_mechanisms, format_findings, sensor_model
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer, photon_transfer
from cannoise_jax.physics.transfer.table import format_transfer
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.recording import CFA_PATTERNS, BadInput


def main(argv: list[str] | None = None) -> int:
    """Calibrates; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(format="bin/calibrate: %(message)s", level=logging.WARNING)
    overrides = {
        name: getattr(arguments, name)
        for name in ("cfa", "black_level", "white_level")
        if getattr(arguments, name) is not None
    }
    try:
        _check_output(arguments.out)
        transfers, findings = calibrate(arguments.recordings, overrides)
        for transfer in transfers:
            print(format_transfer(transfer), end="\n\n")
        if findings:
            print(format_findings(findings), end="\n\n")
        model = sensor_model(transfers, findings)
        write_sensor(arguments.out, model)
    except BadInput as error:
        print(f"bin/calibrate: {error}", file=sys.stderr)
        return 2
    names = ", ".join(f.mechanism for f in model.mechanisms) or "none"
    print(f"{arguments.out}: {model.camera}, {len(transfers)} setting(s), mechanisms: {names}")
    return 0


def calibrate(folder: Path, overrides: dict) -> tuple[tuple[PhotonTransfer, ...], tuple[Finding, ...]]:
    """Photon transfer at every ISO, and the mechanisms at the first ISO that has a baseline.

    Raises BadInput when the folder, or a recording in it, cannot be used.
    """
    transfers = photon_transfer(load_capture_set(folder, **overrides))
    for transfer in transfers:
        if isinstance(transfer.baseline, Baseline):
            return transfers, find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    return transfers, ()


def _check_output(path: Path) -> None:
    if path.suffix.lower() != ".json":
        raise BadInput(f"{path}: --out names a .json file")
    if not path.parent.is_dir():
        raise BadInput(f"{path}: no such folder {path.parent}")


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/calibrate",
        description="Measures the noise of a camera from a folder of its recordings: flats and darks, or "
        "scenes with repeated frames. Prints photon transfer (EMVA 1288 definitions) and the mechanisms "
        "beyond it, each with a 90 % interval, and writes a camera model.",
    )
    parser.add_argument(
        "--recordings", required=True, type=Path, metavar="DIR", help="one camera's recordings"
    )
    parser.add_argument("--out", required=True, type=Path, metavar="FILE", help="the sensor.json to write")
    parser.add_argument(
        "--cfa", choices=CFA_PATTERNS, help="colour order, where the files are wrong or silent"
    )
    parser.add_argument(
        "--black-level", type=numbers, metavar="DN", help="one value, or a,b,c,d in mosaic order"
    )
    parser.add_argument("--white-level", type=float, metavar="DN", help="highest code")
    return parser


if __name__ == "__main__":
    sys.exit(main())
