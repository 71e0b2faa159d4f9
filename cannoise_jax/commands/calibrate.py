"""bin/calibrate --recordings DIR --out sensor.json: photon transfer and mechanisms of one camera.

Prints the tables; writes a camera model that bin/simulate and bin/train take and, beside it, the EMVA 1288
sheet and the noise profiles.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import logging
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.entry import cache_folder, command, counted, progress, show_warnings
from cannoise_jax.commands.outputs import check_file
from cannoise_jax.commands.parser import (
    OneLineParser,
    add_mechanisms_flag,
    add_recording_flags,
    folder,
    options,
    place,
)
from cannoise_jax.commands.pulse import current, now_at
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.mechanisms.entry import Entry
    from cannoise_jax.physics.transfer.model import Finding
    from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer
    from cannoise_jax.recordings.recording import CaptureSet, Recording


@command("calibrate")
def main(argv: list[str] | None = None) -> int:
    """Calibrates; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    show_warnings("calibrate")
    try:
        return _run(arguments)
    except BadInput as error:
        print(f"bin/calibrate: {error}", file=sys.stderr)
        return 2


def _run(arguments: argparse.Namespace) -> int:
    now_at("loading libraries")
    check_file(arguments.out, ".json", arguments.force)
    own = _own(arguments.mechanisms)
    beside = _beside(arguments.out)
    for path in beside.values():
        check_file(path, path.suffix, arguments.force)
    from cannoise_jax.recordings.folders.aside import guessed_white_of, used_of
    from cannoise_jax.recordings.folders.store import capture_of
    from cannoise_jax.recordings.usable import usable

    chosen = options(arguments)
    capture, plan = capture_of(arguments.recordings, chosen, cache_folder(), progress("reading files"))
    if plan:
        print(plan, file=sys.stderr, flush=True)
    capture, left_out = usable(capture, tell=progress("looking over the frames: steps"))
    for line in left_out:
        print(f"bin/calibrate: {line}", file=sys.stderr, flush=True)

    now_at("loading what measures")
    from cannoise_jax.physics.core.sensor_json import check_place, write_sensor
    from cannoise_jax.physics.transfer.as_recorded import as_recorded
    from cannoise_jax.physics.transfer.model import format_findings, sensor_model
    from cannoise_jax.physics.transfer.photon_transfer import of_all_pixels
    from cannoise_jax.physics.transfer.table import format_transfer
    from cannoise_jax.recordings.atomic import new_folder, texts_in_place

    check_place(arguments.out)
    if own:
        from cannoise_jax.mechanisms.checked import check_draws

        check_draws(own, capture.recordings[0].size)
    transfers, said = _photon_transfers(capture)
    findings = _mechanisms_of(transfers, own)
    now_at("putting the camera model and the table together")
    model = sensor_model(transfers, findings)
    shown = tuple(map(of_all_pixels, transfers))
    for transfer in shown:
        print(format_transfer(transfer), end="\n\n")
    if findings:
        print(format_findings(findings), end="\n\n")
    notes = as_recorded(model, transfers, findings)
    for note in notes:
        print(note, end="\n\n")
    now_at("drawing the sheet")
    guessed = filter(None, [guessed_white_of(plan)])
    texts = _texts(beside, model.camera, shown, capture, (*notes, *said, *guessed))
    with (
        new_folder(arguments.out.parent),
        texts_in_place(texts, (arguments.out, arguments.out.with_suffix(".npz"))),
    ):
        write_sensor(arguments.out, model)
    names = ", ".join(f.mechanism for f in model.mechanisms) or "none"
    print(f"{arguments.out}: {model.camera}, {len(transfers)} setting(s), mechanisms: {names}")
    print(f"{beside['sheet']}: EMVA 1288 sheet, its numbers in {beside['data'].name}")
    print(f"{beside['csv']}, {beside['profile'].name}, {beside['darktable'].name}: noise profiles")
    if used := used_of(plan):
        print(used)
    return 0


def _beside(out: Path) -> dict[str, Path]:
    """What is written beside the camera model, by what it is."""
    names = {
        "sheet": "emva1288.html",
        "data": "emva1288.json",
        "csv": "profile.csv",
        "profile": "profile.json",
        "darktable": "darktable.json",
    }
    return {what: out.with_name(f"{out.stem}_{name}") for what, name in names.items()}


def _texts(
    beside: dict[str, Path], camera: str, transfers: tuple[PhotonTransfer, ...], capture: CaptureSet,
    notes: Sequence[str],
) -> dict[Path, str]:  # fmt: skip
    from cannoise_jax.evaluation.sheet import sheet_page
    from cannoise_jax.evaluation.sheet_data import sheet_data
    from cannoise_jax.physics.transfer.noise_profile import darktable_profiles, profile_csv, profile_rows

    settings, rows = sheet_data(transfers), profile_rows(transfers)
    frames = sum(r.count for r in capture.recordings)
    made_by = f"{frames} frames of {len(capture.recordings)} recordings; cannoise-jax {_version()}."
    return {
        beside["sheet"]: sheet_page(camera, settings, made_by, notes),
        beside["data"]: _json({"camera": camera, "notes": notes, "settings": settings}),
        beside["csv"]: profile_csv(rows),
        beside["profile"]: _json(
            {"camera": camera, "variance": "shot * x + read", "notes": notes, "profiles": rows}
        ),
        beside["darktable"]: _json(darktable_profiles(camera, rows)),
    }


def _json(document: dict) -> str:
    return json.dumps(_plain(document), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    """Values as JSON has them: what is not finite is null."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value


def _version() -> str:
    return importlib.metadata.version("cannoise-jax")


def _own(places: Sequence[str]) -> tuple[Entry, ...]:
    """The user's own entries. Raises BadInput where one has no estimator: nothing would measure it."""
    if not places:
        return ()
    from cannoise_jax.mechanisms.checked import measurable
    from cannoise_jax.mechanisms.outside import entries_of

    try:
        return measurable(entries_of(places))
    except (ValueError, TypeError) as error:
        raise BadInput(str(error)) from error


def calibrate(
    capture: CaptureSet, own: Sequence[Entry] = ()
) -> tuple[tuple[PhotonTransfer, ...], tuple[Finding, ...]]:
    """Photon transfer at every ISO, and the mechanisms at the first ISO that has a baseline. own: mechanisms
    of the caller's that are measured too, each with an estimator.

    Raises BadInput when the recordings cannot be used together or a function of `own` fails, ValueError and
    TypeError for entries that are none.
    """
    from cannoise_jax.mechanisms.checked import check_draws, measurable

    own = measurable(own)
    check_draws(own, capture.recordings[0].size)
    with current().stages():
        transfers, _ = _photon_transfers(capture)
        return transfers, _mechanisms_of(transfers, own)


def _photon_transfers(capture: CaptureSet) -> tuple[tuple[PhotonTransfer, ...], tuple[str, ...]]:
    """Photon transfer at every ISO, and of what was warned of on the way that which bears on all numbers of a
    sheet: flats that no dark is as warm as, what is stated and contradicted by the recordings, and gains that
    are not to be trusted. Raises BadInput as `calibrate`."""
    from cannoise_jax.physics.transfer.defects import WITHOUT
    from cannoise_jax.physics.transfer.doubts import doubts
    from cannoise_jax.physics.transfer.estimators.particles import told
    from cannoise_jax.physics.transfer.faults import faults
    from cannoise_jax.physics.transfer.frames import FrameStatistics, frame_statistics
    from cannoise_jax.physics.transfer.one_temperature import of_one_temperature
    from cannoise_jax.physics.transfer.photon_transfer import transfer_at

    now_at("photon transfer")
    # As `photon_transfer`, which does not say how far it is.
    every: dict[float | None, list[FrameStatistics]] = {}
    alike: dict[float | None, list[FrameStatistics]] = {}
    for recording in counted(capture.recordings, "photon transfer: recordings"):
        every.setdefault(recording.iso, []).append(frame_statistics(recording))
    order = sorted(every, key=lambda iso: (iso is not None, iso))
    said: list[str] = []
    for iso in order:
        alike[iso], others = of_one_temperature(every[iso])
        with current().doing(lambda: "looking for faults of the recordings"):
            wrong = faults(alike[iso])  # of the gain the table says it
        if refused := wrong.cut_off or wrong.above or wrong.unlike:
            raise BadInput(refused)
        said += (others, *wrong.stated)
        for line in (
            others,
            *wrong.stated,
            wrong.unlit,
            wrong.defects,
            wrong.lines and f"{wrong.lines}: {WITHOUT}",
            wrong.shadows,
            wrong.spots,
            wrong.lamp,
            wrong.longer,
            wrong.uneven,
            wrong.halves,
        ):
            _warn(_named(capture.camera, alike[iso][0].recording if len(order) > 1 else None), line)
    _warn(capture.camera, told([s for iso in order for s in alike[iso]]))
    channels = partial(counted, doing="photon transfer: channels")
    transfers = tuple(transfer_at(every[iso], channels) for iso in order)
    for transfer in transfers:
        for line in doubts(transfer):
            said.append(line)
            _warn(_named(capture.camera, transfer.statistics[0].recording), line)
    return transfers, tuple(dict.fromkeys(filter(None, said)))


def _named(camera: str, recording: Recording | None) -> str:
    """The camera, with the gain setting of a recording where it has one."""
    from cannoise_jax.physics.transfer.table import gain_words

    return ", ".join(filter(None, (camera, gain_words(recording) if recording else "")))


def _warn(of: str, line: str) -> None:
    """Warns of what a camera's recordings have, where there is something."""
    if line:
        logging.getLogger(__name__).warning("%s: %s", of, line)


def _mechanisms_of(transfers: Sequence[PhotonTransfer], own: Sequence[Entry]) -> tuple[Finding, ...]:
    """The mechanisms at the first ISO that has a baseline."""
    from cannoise_jax.mechanisms import LISTED
    from cannoise_jax.physics.transfer.baseline import Baseline
    from cannoise_jax.physics.transfer.model import find_mechanisms

    for transfer in transfers:
        if isinstance(transfer.baseline, Baseline):
            now_at("mechanisms: which of them explain the others")
            each = partial(counted, doing="mechanisms: estimators", named=lambda entry: entry.record.id)
            return find_mechanisms(transfer.statistics, transfer.baseline, (*LISTED, *own), each)
    return ()


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/calibrate",
        description="Measures the noise of a camera from a folder of its recordings: flats and darks, or "
        "scenes with repeated frames. Prints photon transfer (EMVA 1288 definitions) and the mechanisms "
        "beyond it, each with a 90 % interval; writes a camera model, an EMVA 1288 sheet that prints, "
        "and noise profiles (CSV, JSON, and darktable's).",
        epilog="A folder of single files (FITS, camera raw, TIFF ...) is sorted as bin/convert does; its "
        "--dry-run shows how.",
    )
    add = parser.add_argument
    add("--recordings", required=True, type=folder, metavar="DIR", help="recordings of one camera")
    add(
        "--out",
        required=True,
        type=place,
        metavar="FILE",
        help="the sensor.json to write; STEM_emva1288.html and others beside it",
    )
    add_mechanisms_flag(parser, "entries of your own, with estimators, to measure too")
    add_recording_flags(parser)
    add("--force", action="store_true", help="replace results that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
