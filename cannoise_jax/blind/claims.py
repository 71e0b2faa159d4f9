"""Running the tool over sealed sets: one report per set, committed to before any truth is read.

Claims are plain report files. A run that was cut off goes on where it stopped, and shards may run side by
side: each writes only its own sets. The commitment is the SHA-256 over the reports of all sets, in order.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cannoise_jax.blind.seal import SCHEMA, set_hash, write_atomically
from cannoise_jax.recordings.load import load_capture_set
from cannoise_jax.recordings.opened import json_of, plainly
from cannoise_jax.recordings.recording import BadInput, CaptureSet

Analyse = Callable[[CaptureSet, tuple[str, ...], bool], dict[str, Any]]
"""(capture set, mechanisms to forget, locate only) -> report."""


def read_manifest(sets: Path) -> dict[str, Any]:
    """The public description of sealed sets. Raises BadInput when `sets` holds none."""
    path = sets / "manifest.json"
    try:
        manifest = json_of(path.read_text())
        if manifest["schema"] != SCHEMA:
            raise BadInput(f"{path}: schema {manifest['schema']!r}, this version reads {SCHEMA!r}")
        return {**manifest, "sets": dict(manifest["sets"]), "truth_sha256": manifest["truth_sha256"]}
    except BadInput:
        raise
    except (OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise BadInput(
            f"{path}: no manifest of sealed sets ({plainly(error)}): make them with bin/blind seal"
        ) from error


def run(
    sets: Path, out: Path, analyse: Analyse, shard: tuple[int, int], progress: Callable[[int, int], None]
) -> str | None:
    """Analyses the sets of a shard (i of n, counted from 1); returns the commitment once every set is there.

    A set whose analysis fails gets a report that holds the error, so that a failure is scored as one. Raises
    BadInput for sets that are not as they were sealed, and for claims that were made about others.
    """
    manifest = read_manifest(sets)
    names = sorted(manifest["sets"])
    mine = names[shard[0] - 1 :: shard[1]]
    out.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(mine):
        path = out / f"{name}.json"
        if path.exists():
            _read_claim(path, manifest["sets"][name])
        else:
            check_set(sets, name, manifest)
            asked = manifest["sets"][name]
            try:
                capture_set = load_capture_set(sets / name)
                report = analyse(capture_set, tuple(asked["without"]), bool(asked["locate_only"]))
            except Exception as error:  # a crash on one set must not hide the others, and must count
                report = {"error": f"{type(error).__name__}: {error}"}
            write_atomically(path, json.dumps({**report, "set_sha256": asked.get("sha256")}))
        progress(i + 1, len(mine))
    if not all((out / f"{name}.json").exists() for name in names):
        return None
    commitment = hash_of(out, names)
    committed = out / "claims.sha256"
    if committed.exists() and committed.read_text().strip() != commitment:
        raise BadInput(f"{out}: the claims differ from their commitment: run bin/blind run into a new folder")
    write_atomically(out / "claims.sha256", commitment + "\n")
    return commitment


def check_set(sets: Path, name: str, manifest: dict[str, Any]) -> None:
    """Raises BadInput where the files of a set are not those that were sealed."""
    sealed = manifest["sets"][name].get("sha256")
    if sealed is not None and set_hash(sets / name) != sealed:
        raise BadInput(f"{sets / name}: not the files that were sealed (SHA-256 differs): bring them back")


def _read_claim(path: Path, sealed: dict[str, Any]) -> dict[str, Any]:
    """One report. Raises BadInput for one about another set than the one that was sealed."""
    try:
        report = json_of(path.read_text())
        about = report.get("set_sha256")
    except (ValueError, AttributeError, RecursionError) as error:
        raise BadInput(
            f"{path}: not a report ({plainly(error)}): remove it, and run bin/blind run again"
        ) from error
    if about != sealed.get("sha256"):
        raise BadInput(f"{path}: a claim about another set of this name: run bin/blind run into a new folder")
    return report


def hash_of(out: Path, names: list[str]) -> str:
    """SHA-256 over names and reports."""
    digest = hashlib.sha256()
    for name in names:
        digest.update(name.encode() + b"\0" + (out / f"{name}.json").read_bytes() + b"\0")
    return digest.hexdigest()


def read_claims(out: Path, manifest: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The committed reports by set. Raises BadInput when they are incomplete, not what was committed to, or
    about other sets."""
    names = sorted(manifest["sets"])
    missing = [name for name in names if not (out / f"{name}.json").exists()]
    if missing:
        raise BadInput(
            f"{out}: no claim for {missing[0]} ({len(missing)} missing): let bin/blind run finish first"
        )
    try:
        committed = (out / "claims.sha256").read_text().strip()
    except OSError as error:
        raise BadInput(f"{out}: not committed yet: let bin/blind run finish first") from error
    if hash_of(out, names) != committed:
        raise BadInput(f"{out}: the claims differ from their commitment: run bin/blind run into a new folder")
    return {name: _read_claim(out / f"{name}.json", manifest["sets"][name]) for name in names}


def read_truth(truth: Path, manifest: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Opens the seal: the truth by set. Raises BadInput when it is not the one that was committed to."""
    try:
        content = truth.read_bytes()
    except OSError as error:
        raise BadInput(f"{truth}: cannot read the truth: {error.strerror}") from error
    if hashlib.sha256(content).hexdigest() != manifest["truth_sha256"]:
        raise BadInput(f"{truth}: not the truth these sets were sealed with (its SHA-256 differs)")
    entries = {entry["set"]: entry for entry in json.loads(content)["sets"]}
    if set(entries) != set(manifest["sets"]):
        odd = sorted(set(entries) ^ set(manifest["sets"]))[0]
        raise BadInput(f"{truth}: {odd} is in the truth or in the manifest only: sets were added or removed")
    for name, entry in entries.items():
        if entry.get("sha256") != manifest["sets"][name].get("sha256"):
            raise BadInput(f"{truth}: {name} in the manifest is not the set that was sealed")
    return entries
