"""bin/blind seal|run|score|develop|real|size|plain: hidden effects, the search for them, the score.

seal    writes capture sets, and what was injected into them to a file elsewhere.
run     diagnoses every set and commits to its claims; reads no truth.
score   checks both commitments, opens the truth, writes the tables and figures.
develop scores fixed sets that are for development, and records their figures for the tests.
real    conceals in real recordings: injects effects, withholds what the sensor has, permutes frames.
size    draws capture sets without an effect and counts how often something is found in them.
plain   diagnoses cameras of another generator: unlisted effects, listed ones in other forms, and none.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.metadata
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cannoise_jax.blind.compose import PARTS, SHARES
from cannoise_jax.commands.blind_flags import kinds_of, parts_of, seeds_of, shard_of, size_of
from cannoise_jax.commands.entry import command
from cannoise_jax.commands.parser import OneLineParser, count, place, seed, whole
from cannoise_jax.recordings.recording import BadInput, CaptureSet


@command("blind")
def main(argv: list[str] | None = None) -> int:
    """Runs one step of a trial; returns 0, or 2 after one line on stderr when something cannot be used."""
    arguments = _parser().parse_args(argv)
    try:
        arguments.step(arguments)
    except (BadInput, ValueError, OSError) as error:
        print(f"bin/blind: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/blind: interrupted; what is done is kept", file=sys.stderr)
        return 130
    return 0


def _seal(arguments: argparse.Namespace) -> None:
    from cannoise_jax.blind.seal import seal
    from cannoise_jax.trials.analysis import fingerprint

    nulls = round(0.75 * arguments.sets) if arguments.nulls is None else arguments.nulls
    commitment = seal(
        arguments.out,
        arguments.truth,
        arguments.seed,
        arguments.sets,
        nulls,
        progress("sealed"),
        arguments.kinds,
        fingerprint(),
    )
    print(f"{arguments.out}: {arguments.sets} sets and {nulls} nulls; truth {commitment}")


def _run(arguments: argparse.Namespace) -> None:
    from cannoise_jax.blind import claims
    from cannoise_jax.trials.analysis import diagnosed, fingerprint, located

    code = fingerprint()
    version = importlib.metadata.version("cannoise-jax")

    def analyse(capture: CaptureSet, without: tuple[str, ...], locate_only: bool) -> dict[str, Any]:
        started = time.monotonic()
        report = located(capture, without) if locate_only else diagnosed(capture, without, version)
        return {**report, "seconds": time.monotonic() - started, "code_sha256": code}

    commitment = claims.run(arguments.sets, arguments.out, analyse, arguments.shard, progress("diagnosed"))
    print(f"{arguments.out}: {commitment or 'not complete: other shards have still to run'}")


def _score(arguments: argparse.Namespace) -> None:
    from cannoise_jax.blind import claims
    from cannoise_jax.blind.page import page
    from cannoise_jax.blind.score import score
    from cannoise_jax.blind.seal import write_atomically
    from cannoise_jax.blind.table import text
    from cannoise_jax.discovery.report.document import plain
    from cannoise_jax.trials.know import know

    manifest = claims.read_manifest(arguments.sets)
    said = claims.read_claims(arguments.claims, manifest)
    truth = claims.read_truth(arguments.truth, manifest)
    out = arguments.out or arguments.claims
    known = {}
    if not arguments.quick:
        tell = progress("compared with the true model:")
        known = know(arguments.sets, truth, out / "known.json", tell, arguments.jobs)
    result = score(truth, said, known)
    codes = {r.get("code_sha256") for r in said.values()}
    result["code"] = {
        "sealed": manifest.get("code_sha256"),
        "run": sorted(str(c) for c in codes),
        "unchanged_since_sealing": codes == {manifest.get("code_sha256")},
    }
    seed = json.loads(arguments.truth.read_text())["seed"]
    made_by = (
        f"{len(truth)} sets sealed with --seed {seed}; the analysis "
        + ("is" if result["code"]["unchanged_since_sealing"] else "is NOT")
        + f" the one that was there at sealing. Truth {manifest['truth_sha256'][:16]}."
    )
    write_atomically(out / "blind.json", json.dumps(plain(result), indent=1, allow_nan=False) + "\n")
    write_atomically(out / "blind.html", page(result, made_by))
    print(f"{made_by}\n{text(result)}\n{out / 'blind.html'}")


def _develop(arguments: argparse.Namespace) -> None:
    from cannoise_jax.blind.seal import write_atomically
    from cannoise_jax.trials.develop import develop

    name = "slow" if arguments.slow else "fast"
    with contextlib.ExitStack() as stack:
        folder = arguments.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        figures = develop(name, folder, progress("diagnosed"))
    path = arguments.figures
    recorded = json.loads(path.read_text()) if path.exists() else {}
    write_atomically(path, json.dumps({**recorded, name: figures}, indent=1, sort_keys=True) + "\n")
    print("\n".join(f"{k}: {v}" for k, v in figures.items()))


def _real(arguments: argparse.Namespace) -> None:
    from cannoise_jax.trials.analysis import ALPHA
    from cannoise_jax.trials.real import real_trial
    from cannoise_jax.trials.real import text as real_text

    result = real_trial(
        arguments.recordings,
        arguments.out,
        arguments.parts,
        arguments.size,
        arguments.permutations,
        ALPHA,
        progress,
    )
    print(f"{real_text(result)}\n{arguments.out / 'real.json'}")


def _true_size(arguments: argparse.Namespace) -> None:
    from cannoise_jax.discovery.report.document import plain
    from cannoise_jax.trials.size import true_size

    result = true_size(
        arguments.out,
        arguments.seed,
        arguments.replicates,
        arguments.size,
        arguments.shard,
        progress("located"),
    )
    print(json.dumps(plain(result), indent=1))


def _plain(arguments: argparse.Namespace) -> None:
    from cannoise_jax.commands.outputs import check_file
    from cannoise_jax.recordings.atomic import new_folder, texts_in_place
    from cannoise_jax.trials.plain import KINDS, plain_trial

    if arguments.table:
        check_file(arguments.table, ".json", arguments.force)
    result = plain_trial(arguments.out, arguments.seeds, arguments.kinds or KINDS, progress("diagnosed"))
    text = json.dumps(result, indent=1, ensure_ascii=False)
    if arguments.table:
        with new_folder(arguments.table.parent), texts_in_place({arguments.table: text}):
            pass
    print(text)


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


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/blind", description=__doc__.split("\n\n")[0])
    steps = parser.add_subparsers(required=True, metavar="seal|run|score|develop|real|size|plain")
    step = steps.add_parser("seal", prog="bin/blind seal", help="capture sets, and their truth elsewhere")
    step.add_argument("--out", type=place, required=True, help="folder for the sets")
    step.add_argument("--truth", type=place, required=True, help="file for the truth, outside of that folder")
    step.add_argument("--seed", type=seed, required=True, help="of everything that is drawn")
    step.add_argument("--sets", type=whole, default=400, help="sets to diagnose")
    step.add_argument("--nulls", type=whole, help="located only (default three for every four sets)")
    step.add_argument(
        "--kinds",
        type=kinds_of,
        default=(),
        metavar="KIND,...",
        help=f"only these: {', '.join(SHARES)}",
    )
    step.set_defaults(step=_seal)
    step = steps.add_parser("run", prog="bin/blind run", help="diagnose every set, commit to the claims")
    step.add_argument("--sets", type=place, required=True, help="folder that bin/blind seal wrote")
    step.add_argument("--out", type=place, required=True, help="folder for the claims")
    step.add_argument("--shard", type=shard_of, default="1/1", metavar="I/N", help="part I of N of the sets")
    step.set_defaults(step=_run)
    step = steps.add_parser("score", prog="bin/blind score", help="open the truth, score the claims")
    step.add_argument("--sets", type=place, required=True, help="folder that bin/blind seal wrote")
    step.add_argument("--claims", type=place, required=True, help="folder that bin/blind run wrote")
    step.add_argument("--truth", type=place, required=True, help="file that bin/blind seal wrote")
    step.add_argument("--out", type=place, help="folder for blind.html and blind.json (that of the claims)")
    step.add_argument("--quick", action="store_true", help="leave out the true model's gain and MDE")
    step.add_argument("--jobs", type=count, default=1, help="processes for those two")
    step.set_defaults(step=_score)
    step = steps.add_parser("develop", prog="bin/blind develop", help="figures of fixed development sets")
    step.add_argument("--figures", type=place, required=True, help="file of recorded figures, written anew")
    step.add_argument("--slow", action="store_true", help="the sixty sets, not the ten")
    step.add_argument(
        "--work", type=place, help="folder for sets and claims, to go on in later; else a temporary"
    )
    step.set_defaults(step=_develop)
    step = steps.add_parser(
        "real", prog="bin/blind real", help="concealment in real recordings of one camera"
    )
    step.add_argument("--recordings", type=place, required=True, help="folder of recordings of one camera")
    step.add_argument("--out", type=place, required=True, help="folder for real.json")
    step.add_argument(
        "--parts", type=parts_of, default=PARTS, metavar="PART,...", help=f"some of {', '.join(PARTS)}"
    )
    step.add_argument("--size", type=size_of, default="192x256", metavar="HxW", help="crop used")
    step.add_argument("--permutations", type=count, default=100, help="how often frames are permuted")
    step.set_defaults(step=_real)
    step = steps.add_parser("size", prog="bin/blind size", help="false alarms of the search, by simulation")
    step.add_argument("--out", type=place, required=True, help="folder for the lines of all replicates")
    step.add_argument("--seed", type=seed, required=True, help="of everything that is drawn")
    step.add_argument("--replicates", type=count, default=2000, help="capture sets")
    step.add_argument("--size", type=size_of, default="192x256", metavar="HxW", help="pixels")
    step.add_argument("--shard", type=shard_of, default="1/1", metavar="I/N", help="part I of N of them")
    step.set_defaults(step=_true_size)
    step = steps.add_parser(
        "plain", prog="bin/blind plain", help="effects of another generator, unlisted ones too"
    )
    step.add_argument("--out", type=place, required=True, metavar="FILE.jsonl", help="a line for every set")
    step.add_argument(
        "--seeds", type=seeds_of, required=True, metavar="N,N", help="each draws all families once"
    )
    step.add_argument("--kinds", nargs="+", choices=("unlisted", "listed", "null"), help="only these")
    step.add_argument("--table", type=place, metavar="FILE.json", help="the score for bin/bench docs")
    step.add_argument("--force", action="store_true", help="replace a table that exists")
    step.set_defaults(step=_plain)
    return parser


if __name__ == "__main__":
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    sys.exit(main())
