"""bin/blind seal|run|score: hidden effects, the analysis that has to find them, and the score.

seal    writes capture sets, and what was injected into them to a file elsewhere.
run     diagnoses every set and commits to its claims; reads no truth.
score   checks both commitments, opens the truth, writes the tables and figures.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import json
import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

import cannoise_jax
from cannoise_jax.blind import claims, compose
from cannoise_jax.blind.score import score
from cannoise_jax.blind.seal import seal, write_atomically
from cannoise_jax.commands.parser import OneLineParser, count
from cannoise_jax.discovery import declare
from cannoise_jax.discovery.battery import prepare, split_frames
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.locate import Located, locate
from cannoise_jax.discovery.report import document, plain
from cannoise_jax.recordings.recording import BadInput, CaptureSet
from cannoise_jax.vocabulary import VOCABULARY

ALPHA = 0.01


def main(argv: list[str] | None = None) -> int:
    """Runs one step of a trial; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    try:
        arguments.step(arguments)
    except (BadInput, ValueError) as error:
        print(f"bin/blind: {error}", file=sys.stderr)
        return 2
    return 0


def _seal(arguments: argparse.Namespace) -> None:
    commitment = seal(
        arguments.out,
        arguments.truth,
        arguments.seed,
        arguments.sets,
        arguments.nulls,
        progress("sealed"),
        arguments.kinds,
        fingerprint(),
    )
    print(f"{arguments.out}: {arguments.sets} sets and {arguments.nulls} nulls; truth {commitment}")


def _run(arguments: argparse.Namespace) -> None:
    code = fingerprint()
    version = importlib.metadata.version("cannoise-jax")

    def analyse(capture: CaptureSet, without: tuple[str, ...], locate_only: bool) -> dict[str, Any]:
        started = time.monotonic()
        report = located(capture, without) if locate_only else diagnosed(capture, without, version)
        return {**report, "seconds": time.monotonic() - started, "code_sha256": code}

    commitment = claims.run(arguments.sets, arguments.out, analyse, arguments.shard, progress("diagnosed"))
    print(f"{arguments.out}: {commitment or 'not complete: other shards have still to run'}")


def _score(arguments: argparse.Namespace) -> None:
    manifest = claims.read_manifest(arguments.sets)
    said = claims.read_claims(arguments.claims, sorted(manifest["sets"]))
    truth = claims.read_truth(arguments.truth, manifest)
    result = score(truth, said)
    out = arguments.out or arguments.claims
    write_atomically(out / "blind.json", json.dumps(plain(result), indent=1, allow_nan=False) + "\n")
    print(out / "blind.json")


def diagnosed(capture: CaptureSet, without: tuple[str, ...], version: str) -> dict[str, Any]:
    """The report of a whole diagnosis, with the p-value of the battery's first pass."""
    found = diagnose(capture, "poisson-gaussian", jax.random.key(0), alpha=ALPHA, without=without)
    report = document(found, key=0, version=version)
    return {**report, "battery_p_value": smallest_p(found.fitted.first)}


def located(capture: CaptureSet, without: tuple[str, ...]) -> dict[str, Any]:
    """Declare, calibrate and locate alone: what the battery rejects, and its smallest family-wise p."""
    ids = declare.registered(without)
    prepared = prepare(capture, [split_frames(r.count)[0] for r in capture.recordings], False)
    first = locate(prepared.fields, prepared.probes)
    mechanism = {p.name: p.mechanism if p.mechanism in ids else "unknown" for p in prepared.probes}
    rejected = [(s, mechanism[s.probe]) for s in first.significant(math.log(ALPHA))]
    findings = [
        {
            "mechanism": name,
            "class": "sensor" if name == "unknown" else VOCABULARY[name].kind,
            "outcome": "UNKNOWN_STRUCTURE" if name == "unknown" else "FOUND",
            "candidates": [{"mechanism": name, "probability": 1.0}],
            "probe": s.probe,
            "p_value": math.exp(first.log_p[s.probe]),
        }
        for s, name in rejected
    ]
    return {"findings": findings, "battery_p_value": smallest_p(first)}


def smallest_p(first: Located) -> float | None:
    """The smallest family-wise p-value of a pass of the battery."""
    return math.exp(min(first.log_p.values())) if first.log_p else None


def fingerprint() -> str:
    """SHA-256 over the source of everything that an analysis runs."""
    root = Path(cannoise_jax.__file__).parent
    digest = hashlib.sha256()
    for part in ("vocabulary.py", "recordings", "physics", "evaluation", "discovery"):
        for path in sorted((root / part).rglob("*.py")) or [root / part]:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def progress(done: str) -> Callable[[int, int], None]:
    """Prints how many sets are done and the time left; sets that were there already do not count."""
    started = last = time.monotonic()
    fresh = 0

    def tell(number: int, total: int) -> None:
        nonlocal last, fresh
        now = time.monotonic()
        fresh += now - last > 0.05
        last = now
        left = (now - started) / max(fresh, 1) * (total - number)
        print(f"\r{done} {number} of {total}, {left / 60:.0f} min left ", end="", file=sys.stderr, flush=True)
        if number == total:
            print(file=sys.stderr)

    return tell


def _shard(text: str) -> tuple[int, int]:
    try:
        number, total = (int(part) for part in text.split("/"))
    except ValueError:
        number, total = 0, 0
    if not 1 <= number <= total:
        raise argparse.ArgumentTypeError(f"{text!r}: give i/n, such as 1/2")
    return number, total


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(part for part in text.split(",") if part)
    for kind in kinds:
        if kind not in compose.SHARES:
            raise argparse.ArgumentTypeError(f"{kind!r}: give some of {', '.join(compose.SHARES)}")
    return kinds


def _whole(text: str) -> int:
    try:
        return int(text) if int(text) >= 0 else count(text)
    except ValueError:
        return count(text)


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/blind", description=__doc__.split("\n\n")[0])
    steps = parser.add_subparsers(required=True, metavar="seal|run|score")
    step = steps.add_parser("seal", prog="bin/blind seal", help="capture sets, and their truth elsewhere")
    step.add_argument("--out", type=Path, required=True, help="folder for the sets")
    step.add_argument("--truth", type=Path, required=True, help="file for the truth, outside of that folder")
    step.add_argument("--seed", type=int, required=True, help="of everything that is drawn")
    step.add_argument("--sets", type=_whole, default=400, help="sets to diagnose (400)")
    step.add_argument(
        "--nulls", type=_whole, default=300, help="further sets without an effect, located only"
    )
    step.add_argument(
        "--kinds",
        type=_kinds,
        default=(),
        metavar="KIND,...",
        help=f"only these: {', '.join(compose.SHARES)}",
    )
    step.set_defaults(step=_seal)
    step = steps.add_parser("run", prog="bin/blind run", help="diagnose every set, commit to the claims")
    step.add_argument("--sets", type=Path, required=True, help="folder that bin/blind seal wrote")
    step.add_argument("--out", type=Path, required=True, help="folder for the claims")
    step.add_argument("--shard", type=_shard, default=(1, 1), metavar="I/N", help="part I of N of the sets")
    step.set_defaults(step=_run)
    step = steps.add_parser("score", prog="bin/blind score", help="open the truth, score the claims")
    step.add_argument("--sets", type=Path, required=True, help="folder that bin/blind seal wrote")
    step.add_argument("--claims", type=Path, required=True, help="folder that bin/blind run wrote")
    step.add_argument("--truth", type=Path, required=True, help="file that bin/blind seal wrote")
    step.add_argument("--out", type=Path, help="folder for blind.html and blind.json (that of the claims)")
    step.set_defaults(step=_score)
    return parser


if __name__ == "__main__":
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    sys.exit(main())
