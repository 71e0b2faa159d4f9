"""bin/diagnose: finds what a noise simulator leaves out of a camera's recordings, and proves it."""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from cannoise_jax.commands.entry import cache_folder, command, progress, show_warnings
from cannoise_jax.commands.outputs import check_folder
from cannoise_jax.commands.parser import (
    OneLineParser,
    add_mechanisms_flag,
    add_recording_flags,
    count,
    folder,
    options,
    seed,
)
from cannoise_jax.commands.stages import Stages
from cannoise_jax.recordings.atomic import REPORT_FILES
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.discovery.diagnose import Diagnosis
    from cannoise_jax.mechanisms.entry import Entry

_MOST_PIXELS = 160_000
"""Of a frame that are used unless told otherwise, of recordings as of a folder of single files."""
_BUILT_IN = ("poisson-gaussian", "nlf")


@command("diagnose")
def main(argv: list[str] | None = None) -> int:
    """Writes report.json, report.html and sensor.json; returns 0 whatever the verdict, 2 for bad input."""
    arguments = _parser().parse_args(argv)
    show_warnings("diagnose")
    started = time.monotonic()

    tell = Stages(started)
    try:
        check_folder(arguments.out, REPORT_FILES, arguments.force, "the report")
        _check(arguments)
        report, camera = _diagnosed(arguments, tell, started)
    except (BadInput, ValueError, OSError, OverflowError) as error:
        print(f"bin/diagnose: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/diagnose: interrupted; nothing was written", file=sys.stderr)
        return 130
    print(f"{camera}: {report['verdict']}")
    confirmed = [f for f in report["findings"] if f["confirmed"]]
    for finding in confirmed or report["findings"]:
        print(f"- {finding['mechanism']}: {finding['sentence']}")
    rest = [f["mechanism"] for f in report["findings"] if not f["confirmed"]] if confirmed else []
    if rest:
        each = ", ".join(f"{n} ({k} times)" if k > 1 else n for n, k in Counter(rest).items())
        print(f"- not confirmed on the frames held back: {each}")
    for much in report["too_much"]:
        print(f"- {much['sign']} {much['mechanism']}: {much['sentence']}")
    before, after = report["before"]["two_sample_auc"], report["after"]["two_sample_auc"]
    if before is not None:
        print(f"told from draws of the simulator with an area of {before:.3f} before, {after:.3f} after")
    left = (report["remains"] or {}).get("left")
    if left is not None and left > 1:
        print(f"the mismatch of what is handed back is {left:.3g} times that of what was judged, in nats")
    entered = [finding["in_simulator"] for finding in report["findings"]]
    if entered and all(e is False for e in entered):
        instead = report["remainder_share"] is not None
        why = "has the remainder in its place, which is nearer to the recordings"
        why = why if instead else "has none of it: it would be no nearer to the recordings"
        print(f"sensor.json {why}, see the report")
    print(f"{arguments.out / 'report.html'}")
    return 0


def check_flags(argv: list[str], asked: str) -> None:
    """Raises BadInput, or ends with status 2, for flags that `main` would refuse before it reads a recording;
    asked: the command that hands them on."""
    parser = _parser()
    parser.prog = asked
    arguments = parser.parse_args(argv)
    _check(arguments)
    try:
        _named(arguments)
    except ValueError as error:
        raise BadInput(str(error)) from error


def _check(arguments: argparse.Namespace) -> None:
    """Raises BadInput, before minutes are spent on the recordings, for what can be told from the flags."""
    if not 0 < arguments.alpha < 1:
        raise BadInput(f"--alpha: must lie between 0 and 1, got {arguments.alpha:g}")
    named = arguments.simulator in _BUILT_IN or _is_function(arguments.simulator)
    if not named and not Path(arguments.simulator).exists():
        raise BadInput(
            f"{arguments.simulator}: no such file or folder: name {', '.join(_BUILT_IN)}, a sensor.json, a "
            "training folder, or module:function"
        )


def _named(arguments: argparse.Namespace) -> tuple[tuple[str, ...], tuple[Entry, ...]]:
    """The mechanisms that count as not known, by name, and all that a run may look for. Raises ValueError,
    BadInput among it, for a name that is none of them."""
    from cannoise_jax.discovery.search.declare import registered
    from cannoise_jax.mechanisms import ENTRIES
    from cannoise_jax.mechanisms.outside import entries_of

    without = tuple(id.strip() for id in arguments.without.split(",") if id.strip())
    mechanisms = (*ENTRIES, *entries_of(arguments.mechanisms))
    registered(without, mechanisms)
    return without, mechanisms


def _is_function(simulator: str) -> bool:
    return ":" in simulator and not Path(simulator).exists()


def _diagnosed(arguments: argparse.Namespace, tell: Stages, started: float) -> tuple[dict, str]:
    from cannoise_jax.discovery.frames.simulate import check_file
    from cannoise_jax.mechanisms.outside import function_at
    from cannoise_jax.physics.core.sensor_json import check_place
    from cannoise_jax.recordings.crop import central
    from cannoise_jax.recordings.folders.store import capture_of

    check_place(arguments.out / "sensor.json")
    if arguments.out.resolve() == arguments.recordings.resolve():
        raise BadInput(f"{arguments.out}: holds the recordings: name another folder for the report")
    # What flags name is looked up before minutes are spent on the recordings.
    simulator = arguments.simulator
    if _is_function(simulator):
        simulator = function_at(simulator)
    without, mechanisms = _named(arguments)
    if isinstance(simulator, str) and simulator not in _BUILT_IN:
        check_file(simulator, mechanisms)
    chosen = options(arguments)
    capture, plan = capture_of(arguments.recordings, chosen, cache_folder(), progress("reading files"))
    if plan:
        print(plan, end="", file=sys.stderr, flush=True)
    capture, size = central(capture, arguments.most_pixels)
    if size is not None:
        tell("frames cut to their middle, {} x {}: --most-pixels sets how much is used".format(*size))

    import jax

    from cannoise_jax.discovery.diagnose import diagnose
    from cannoise_jax.discovery.report.light import sentence_of
    from cannoise_jax.discovery.report.outcome import not_measured
    from cannoise_jax.discovery.report.save import save

    found = diagnose(
        capture,
        simulator,
        jax.random.key(arguments.key),
        alpha=arguments.alpha,
        without=without,
        mechanisms=mechanisms,
        tell=tell,
    )
    for words in (*not_measured(found), *_stated_gains(found)):
        print(f"bin/diagnose: {words}", file=sys.stderr, flush=True)
    tell("report: pictures, pages and the camera model")
    report = save(
        found,
        arguments.out,
        seconds=time.monotonic() - started,
        force=arguments.force,
        used=size,
    )
    if report["shadows"]:
        print(f"bin/diagnose: {sentence_of(report['shadows'])}", file=sys.stderr, flush=True)
    return report, capture.camera


def _stated_gains(found: Diagnosis) -> list[str]:
    """The gain of the files against the measured one, at every setting."""
    from cannoise_jax.physics.transfer.stated_gain import gain_note

    notes = []
    for baseline in found.first.baselines:
        own = [r for r in found.capture.recordings if r.iso == baseline.iso]
        known = (baseline.gain > 0) & (baseline.gain_stderr > 0)
        notes.append(gain_note(own, baseline.gain[known].tolist(), baseline.gain_stderr[known].tolist()))
    return [note for note in notes if note]


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/diagnose",
        description=__doc__,
        epilog="A folder of single files (FITS, camera raw, TIFF ...) is sorted as bin/convert does; its "
        "--dry-run shows how. Minutes for a few megapixels: what is being done is said as it goes.",
    )
    add = parser.add_argument
    add("--recordings", type=folder, required=True, metavar="DIR", help="recordings of one camera")
    add(
        "--simulator",
        default="poisson-gaussian",
        help="poisson-gaussian (calibrated from the recordings), nlf (shot and read of the files), a "
        "sensor.json, a training folder, or module:function",
    )
    add("--out", type=folder, required=True, metavar="DIR", help="for report.html, report.json, sensor.json")
    add("--alpha", type=float, default=0.01, help="false-alarm rate of the whole run")
    add(
        "--most-pixels",
        type=count,
        default=_MOST_PIXELS,
        metavar="N",
        help="use no more of each frame, about its middle: a megapixel takes many minutes",
    )
    add("--key", type=seed, default=0, help="seed of everything random")
    add("--without", default="", metavar="ID,...", help="run as if these mechanisms were not known")
    add_mechanisms_flag(parser, "entries of your own to look for too")
    add_recording_flags(parser)
    add("--force", action="store_true", help="replace results that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
