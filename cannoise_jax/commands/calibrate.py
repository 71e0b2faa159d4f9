"""bin/calibrate --recordings DIR --out sensor.json: photon transfer and mechanisms of one camera.

Prints the tables; writes a camera model that bin/simulate and bin/train take.
"""

from __future__ import annotations

import argparse
import logging
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cannoise_jax.commands.entry import cache_folder, command, progress
from cannoise_jax.commands.outputs import check_file
from cannoise_jax.commands.parser import OneLineParser, add_recording_flags, folder, options
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.physics.transfer.model import Finding
    from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer
    from cannoise_jax.recordings.recording import CaptureSet


@command("calibrate")
def main(argv: list[str] | None = None) -> int:
    """Calibrates; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    logging.basicConfig(format="bin/calibrate: %(message)s", level=logging.WARNING)
    try:
        return _run(arguments)
    except BadInput as error:
        print(f"bin/calibrate: {error}", file=sys.stderr)
        return 2


def _run(arguments: argparse.Namespace) -> int:
    check_file(arguments.out, ".json", arguments.force)
    from cannoise_jax.recordings.folders.store import capture_of
    from cannoise_jax.recordings.usable import check_usable

    chosen = options(arguments)
    capture, plan = capture_of(arguments.recordings, chosen, cache_folder(), progress("reading files"))
    if plan:
        print(plan, file=sys.stderr, flush=True)
    check_usable(capture)

    from cannoise_jax.physics.core.sensor_json import check_place, write_sensor
    from cannoise_jax.physics.transfer.model import format_findings, sensor_model
    from cannoise_jax.physics.transfer.table import format_transfer

    check_place(arguments.out)
    transfers, findings = calibrate(capture)
    for transfer in transfers:
        print(format_transfer(transfer), end="\n\n")
    if findings:
        print(format_findings(findings), end="\n\n")
    model = sensor_model(transfers, findings)
    write_sensor(arguments.out, model)
    names = ", ".join(f.mechanism for f in model.mechanisms) or "none"
    print(f"{arguments.out}: {model.camera}, {len(transfers)} setting(s), mechanisms: {names}")
    return 0


def calibrate(capture: CaptureSet) -> tuple[tuple[PhotonTransfer, ...], tuple[Finding, ...]]:
    """Photon transfer at every ISO, and the mechanisms at the first ISO that has a baseline.

    Raises BadInput when the recordings cannot be used together.
    """
    from cannoise_jax.mechanisms import LISTED
    from cannoise_jax.physics.transfer.baseline import Baseline
    from cannoise_jax.physics.transfer.model import find_mechanisms
    from cannoise_jax.physics.transfer.photon_transfer import photon_transfer

    transfers = photon_transfer(capture)
    for transfer in transfers:
        if isinstance(transfer.baseline, Baseline):
            return transfers, find_mechanisms(transfer.statistics, transfer.baseline, LISTED)
    return transfers, ()


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/calibrate",
        description="Measures the noise of a camera from a folder of its recordings: flats and darks, or "
        "scenes with repeated frames. Prints photon transfer (EMVA 1288 definitions) and the mechanisms "
        "beyond it, each with a 90 %% interval, and writes a camera model.",
        epilog="A folder of single files (FITS, camera raw, TIFF ...) is sorted as bin/convert does; its "
        "--dry-run shows how.",
    )
    add = parser.add_argument
    add("--recordings", required=True, type=folder, metavar="DIR", help="recordings of one camera")
    add("--out", required=True, type=Path, metavar="FILE", help="the sensor.json to write")
    add_recording_flags(parser)
    add("--force", action="store_true", help="replace results that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
