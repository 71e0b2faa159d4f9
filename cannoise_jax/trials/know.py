"""What takes the truth to compute, set by set: the true model's gain, the tool's MDE, and lesser analyses."""

from __future__ import annotations

import contextlib
import json
import multiprocessing
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

from cannoise_jax.blind.claims import check_set, read_manifest
from cannoise_jax.blind.seal import write_atomically
from cannoise_jax.discovery.report.document import plain
from cannoise_jax.discovery.search.limits import mde
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.trials.analysis import fingerprint, true_gain, unrefitted_p, unweighted_p


def know(
    sets: Path, truth: dict[str, Any], path: Path, tell: Callable[[int, int], None], jobs: int = 1
) -> dict[str, dict[str, Any]]:
    """What takes the truth to compute: of single effects `mde`, the tool's, and `gain`, see
    `true_gain`; for strong and effect-free sets `unweighted_p` and `unrefitted_p`. Kept in `path`;
    computed by so many processes."""
    code = fingerprint()
    try:
        kept = json.loads(path.read_text())
    except (OSError, json.JSONDecodeError):
        kept = {}
    manifest = read_manifest(sets)
    of = {"code_sha256": code, "truth_sha256": manifest["truth_sha256"]}
    known = kept["sets"] if {k: kept.get(k) for k in of} == of else {}
    asked = [e for e in truth.values() if e["category"] in ("strong", "curve", "null")]
    missing = [e for e in asked if e["set"] not in known]
    for entry in missing:
        check_set(sets, entry["set"], manifest)
    with contextlib.ExitStack() as stack:
        each: Iterable[dict[str, Any]] = map(_facts, [sets] * len(missing), missing)
        if jobs > 1:  # processes started afresh: JAX does not survive a fork
            start = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(jobs, mp_context=start)
            stack.callback(pool.shutdown, cancel_futures=True)  # what is asked for is not waited for
            each = pool.map(_facts, [sets] * len(missing), missing)
        for n, (entry, facts) in enumerate(zip(missing, each, strict=True)):
            known[entry["set"]] = facts
            write_atomically(path, json.dumps(plain({**of, "sets": known})))
            tell(n + 1, len(missing))
    return known


def _facts(sets: Path, entry: dict[str, Any]) -> dict[str, Any]:
    """What `know` computes for one set."""
    capture = load_capture_set(sets / entry["set"])
    facts: dict[str, Any] = {}
    if entry["category"] != "curve":
        facts["unweighted_p"] = unweighted_p(capture)
        facts["unrefitted_p"] = unrefitted_p(capture)
    for effect in entry["effects"]:
        facts["mde"] = mde(effect["mechanism"], capture)
        facts["gain"] = true_gain(capture, effect["mechanism"], effect["amplitude"])
    return facts
