"""bin/evaluate --suite noise|ablation|encoder|cameras|iso|all --workdir RUN [--model RUN[,RUN...]]

The experiments on the five virtual cameras; writes RUN/evaluation/SUITE.json and RUN/evaluation/results.html.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import shlex
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.entry import command, stages
from cannoise_jax.commands.outputs import check_folder
from cannoise_jax.commands.parser import OneLineParser, above_zero, count, folder, seed, whole
from cannoise_jax.recordings.atomic import new_folder, one_work, texts_in_place
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.evaluation.suites import Request

SUITES = ("noise", "ablation", "encoder", "cameras", "iso")
SCHEMA = "cannoise/evaluation/1"


@command("evaluate")
def main(argv: list[str] | None = None) -> int:
    """Runs suites; returns 0, 1 for draws that are not finite, or 2 after one line when something cannot be
    used."""
    arguments = sys.argv[1:] if argv is None else argv
    parsed = _parser().parse_args(arguments)
    try:
        _run(parsed, [str(a) for a in arguments])
    except (BadInput, FloatingPointError) as error:
        print(f"bin/evaluate: {error}", file=sys.stderr)
        return 2 if isinstance(error, BadInput) else 1
    return 0


def _run(arguments, argv: list[str]) -> None:
    out = arguments.workdir / "evaluation"
    chosen = SUITES if arguments.suite == "all" else (arguments.suite,)
    if math.isqrt(arguments.per_scene) ** 2 != arguments.per_scene:
        raise BadInput(f"--per-scene {arguments.per_scene}: give a square number, as 4 or 9")
    if not (arguments.workdir.exists() or arguments.model or arguments.also or arguments.sensors):
        # Rather a slip in the name of a trained model than a wish for baselines alone.
        raise BadInput(
            f"{arguments.workdir}: no such folder: name that of a trained model, or make one for baselines"
        )
    from cannoise_jax.discovery.proof.patch_area import two_sample_area
    from cannoise_jax.evaluation.beyond import beyond_bench
    from cannoise_jax.evaluation.noise_models import BASELINES, baselines, make_bench, sensors
    from cannoise_jax.evaluation.results_page import results_page
    from cannoise_jax.evaluation.suites import Request
    from cannoise_jax.model_file import MODEL_FILE, load_model
    from cannoise_jax.physics.synthetic.virtual import virtual_cameras

    tell = stages()
    paths = arguments.model or ([arguments.workdir] if (arguments.workdir / MODEL_FILE).is_file() else [])
    models = [load_model(path) for path in paths]
    also = {name: [load_model(p) for p in runs] for name, runs in arguments.also}
    ablations = {name: [load_model(p) for p in runs] for name, runs in arguments.ablation}
    fitted = {name: _sensor_files(path, virtual_cameras(arguments.ratio)) for name, path in arguments.sensors}
    known = [*BASELINES, *fitted, *(["noise_flow"] if "noise" in chosen and arguments.flow_steps else [])]
    unknown = sorted(set(arguments.noise) - set(known))
    if unknown:
        raise BadInput(f"--noise: {', '.join(unknown)}: use {', '.join(known)}")
    ending = "" if arguments.ratio is None else f"_ratio_{arguments.ratio:g}"
    check_folder(out, tuple(f"{name}{ending}.json" for name in chosen), arguments.force)
    if not models:
        tell(f"no {MODEL_FILE} in {arguments.workdir} and no --model: only what needs no trained model")
    tell("recording the virtual cameras")
    bench = make_bench(
        arguments.seed, arguments.scenes, arguments.per_scene, arguments.train_scenes, arguments.ratio
    )
    draws = baselines(bench)
    draws |= {name: sensors(bench, by_camera) for name, by_camera in fitted.items()}
    if "noise" in chosen and arguments.flow_steps:
        draws["noise_flow"] = _flow(bench, arguments, tell)
    needed = {"truth", "pg", "pg_estimated", "pg_recalibrated"}
    draws = {n: d for n, d in draws.items() if not arguments.noise or n in needed | set(arguments.noise)}
    beyond = beyond_bench(arguments.scenes, arguments.per_scene) if "iso" in chosen else None
    request = Request(
        bench, draws, models, arguments.seeds, arguments.references, ablations, two_sample_area, also,
        beyond, tell,
    )  # fmt: skip
    files = {name: out / f"{name}{ending}.json" for name in chosen}
    with new_folder(out), one_work([*files.values(), out / "results.html"]):
        for name, path in files.items():
            record = _record(name, request, paths, argv)
            with texts_in_place({path: json.dumps(record, indent=1, allow_nan=False) + "\n"}):
                pass
            for table in record["tables"]:
                print(_text(table), flush=True)
            for note in record["notes"]:
                print(f"not run: {note}")
        stored = {n: out / f"{n}.json" for n in SUITES}
        found = {n: _stored(path) for n, path in stored.items() if path.is_file()}
        with texts_in_place({out / "results.html": results_page(found)}):
            pass
    print(out / "results.html")


def _stored(path: Path) -> dict[str, Any]:
    """A suite as it was stored. Raises BadInput for a file that holds none."""
    try:
        found = json_of(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not valid JSON ({error}): remove it, or run its suite again") from error
    if not isinstance(found, dict):
        raise BadInput(f"{path}: holds no suite: remove it, or run its suite again")
    return found


def _record(name: str, request: Request, models: list[Path], argv: list[str]) -> dict[str, Any]:
    """Runs a suite; what is stored of it."""
    from cannoise_jax.evaluation.model_suites import SUITES as RUNS

    started = time.monotonic()
    request.tell(f"suite {name}")
    outcome = RUNS[name](request)
    title = " ".join((RUNS[name].__doc__ or name).split()).removesuffix(".")
    return {
        "schema": SCHEMA, "suite": name, "title": title,
        "command": f"bin/evaluate {shlex.join(argv)}",
        "version": importlib.metadata.version("cannoise-jax"),
        "seeds": request.seeds, "patches": request.bench.size, "references": request.references,
        "interval": "90 %, seeds and scenes drawn again",
        "models": [str(p) for p in models], "seconds": round(time.monotonic() - started, 1),
        "tables": [_plain(t) for t in outcome.tables], "figures": [_plain(f) for f in outcome.figures],
        "notes": outcome.notes,
    }  # fmt: skip


def _flow(bench, arguments, tell):
    """Noise Flow, trained once for every seed on training patches, which hold the test's cameras and ISOs."""
    import numpy as np

    from cannoise_jax.evaluation.kl import clipped_noise
    from cannoise_jax.training.flow import FlowRecipe, flow_noise, held_out_nats, train_flow

    flows: dict[int, Any] = {}
    test = bench.test

    def draw(key, references):
        seed = len(flows) % arguments.seeds
        if len(flows) < arguments.seeds:
            recipe = FlowRecipe(steps=arguments.flow_steps)
            started = time.monotonic()
            flows[seed] = train_flow(bench.train, len(bench.cameras), seed, recipe)
            tell(
                f"Noise Flow, seed {seed}: {held_out_nats(flows[seed], test):.3f} nats a value on the test, "
                f"{time.monotonic() - started:.0f} s"
            )
        noise = flow_noise(flows[seed], key, test.clean, test.camera, test.iso)
        return clipped_noise(np.asarray(noise), test.clean)

    return draw


def _sensor_files(path: Path, cameras) -> dict[str, Any]:
    """One sensor.json a camera, named after it. Raises BadInput where one is missing."""
    from cannoise_jax.physics.core.sensor import SensorModel
    from cannoise_jax.physics.core.sensor_json import MissingEntry

    try:
        return {camera.name: SensorModel.load(path / f"{camera.name}.json") for camera in cameras}
    except MissingEntry as error:
        raise error.not_taken("bin/evaluate") from error


def _plain(value: Any) -> Any:
    """As JSON holds it: cells by name, numbers that are not finite as null."""
    if hasattr(value, "_asdict"):
        return _plain(value._asdict())
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def _text(table: dict[str, Any]) -> str:
    """A table for a terminal: values with half the width of their intervals."""
    from cannoise_jax.evaluation.results_page import number
    from cannoise_jax.physics.transfer.table import aligned

    columns = [
        c for c in table["columns"] if not all(isinstance(r.get(c), str) for r in table["rows"].values())
    ]
    rows = [["", *columns]]
    for name, row in table["rows"].items():
        cells = []
        for c in columns:
            value = row.get(c)
            if not isinstance(value, dict):
                cells.append(str(value or "-"))
                continue
            about = f" [{number(value['low'])}, {number(value['high'])}]" if value["low"] is not None else ""
            cells.append(number(value["value"]) + about)
        rows.append([name, *cells])
    return "\n".join([table["title"], *aligned(rows), table["note"], ""])


def _paths(text: str) -> list[Path]:
    return [Path(part) for part in text.split(",") if part]


def _named(text: str) -> tuple[str, list[Path]]:
    name, _, paths = text.partition("=")
    if not name or not paths:
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME=RUN, or NAME=RUN,RUN of several seeds")
    return name, _paths(paths)


def _sensor_folder(text: str) -> tuple[str, Path]:
    name, _, path = text.partition("=")
    if not name or not path:
        raise argparse.ArgumentTypeError(f"{text!r}: give NAME=FOLDER, with one CAMERA.json for each camera")
    return name, Path(path)


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/evaluate",
        description="Sets noise models side by side on the five virtual cameras, and takes a trained one "
        "apart.",
    )
    add = parser.add_argument
    add("--suite", required=True, choices=(*SUITES, "all"), help="which experiment")
    add("--workdir", required=True, type=folder, metavar="RUN", help="results go to RUN/evaluation")
    add("--model", type=_paths, metavar="RUN,...", help="trained model, one for each seed; else that of RUN")
    add(
        "--ablation", type=_named, action="append", default=[], metavar="NAME=RUN,...", help="may be repeated"
    )
    add("--also", type=_named, action="append", default=[], metavar="NAME=RUN,...",
        help="more trained models among the noise models, as on a sensor; may be repeated")  # fmt: skip
    add("--sensors", type=_sensor_folder, action="append", default=[], metavar="NAME=FOLDER",
        help="camera models as calibrated=DIR or discovered=DIR, one CAMERA.json each")  # fmt: skip
    add("--noise", type=lambda t: t.split(","), default=[], metavar="NAME,...", help="only these baselines")
    add("--seeds", type=count, default=3, help="training runs of each noise model")
    add("--references", type=count, default=8, help="noisy patches that a model is shown")
    add("--scenes", type=count, default=20, help="test scenes, each taken by every camera")
    add("--per-scene", type=count, default=4, help="patches of a scene: a square number")
    add("--train-scenes", type=count, default=40, help="for what baselines are fitted to")
    add("--flow-steps", type=whole, default=1500, help="training steps of Noise Flow; 0: leave it out")
    add("--seed", type=seed, default=0, help="of the scenes")
    add("--ratio", type=above_zero, metavar="X", help="cameras whose noise is X times as strong as published")
    add("--force", action="store_true", help="replace results that exist")
    return parser


if __name__ == "__main__":
    sys.exit(main())
