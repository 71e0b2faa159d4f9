"""Cameras of `blind.plain_camera` diagnosed: whether what has no name is left without one, and what has one
gets it."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cannoise_jax.blind.judge import count
from cannoise_jax.blind.plain_camera import SIZE, Make, capture_set
from cannoise_jax.blind.plain_listed import BESIDE, LISTED, NULLS
from cannoise_jax.blind.plain_unlisted import ARGUABLE, UNLISTED
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.proof.verdict import MATCH
from cannoise_jax.discovery.search.fit import part_of
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.trials.analysis import fingerprint

KINDS = ("unlisted", "listed", "null")
_CODE = (
    *("vocabulary.py", "recordings", "physics", "mechanisms", "signatures", "evaluation", "discovery"),
    *("blind/plain_camera.py", "blind/plain_listed.py", "blind/plain_unlisted.py"),
)


def families(kinds: Iterable[str] = KINDS) -> list[tuple[str, str]]:
    """Kind and name of every family."""
    names: dict[str, Iterable[str]] = {"unlisted": UNLISTED, "listed": LISTED, "null": NULLS}
    return [(kind, name) for kind in kinds for name in names[kind]]


def plain_set(kind: str, name: str, seed: int, size: tuple[int, int] = SIZE):
    """The capture set of a family and seed."""
    make: Make = {"unlisted": UNLISTED, "null": NULLS}[kind][name] if kind != "listed" else LISTED[name][0]
    return capture_set(make, np.random.default_rng([seed, *name.encode()]), size)


def said(kind: str, name: str, seed: int, size: tuple[int, int] = SIZE) -> dict[str, Any]:
    """What a diagnosis says of one set: its verdict, and every finding with whether it is confirmed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = diagnose(plain_set(kind, name, seed, size), key=jax.random.key(seed))
    aside = part_of(found.fitted.steps)
    return {
        "kind": kind,
        "family": name,
        "seed": seed,
        "verdict": str(found.verdict),
        "findings": [
            [step.named.mechanism, bool(proof.confirmed)]
            for n, (step, proof) in enumerate(zip(found.fitted.steps, found.proofs, strict=True))
            if n not in aside
        ],
    }


def plain_trial(
    out: Path, seeds: Sequence[int], kinds: Sequence[str], tell: Callable[[int, int], None]
) -> dict[str, Any]:
    """All families at every seed, a line each in `out`; those that are there already are not run again.
    Raises BadInput where it holds those of another analysis."""
    head = json.dumps({"code_sha256": fingerprint()})
    lines = out.read_text(encoding="utf-8").split("\n") if out.exists() else [head]
    if lines[0] != head:
        raise BadInput(f"{out}: of another analysis: choose a new file")
    done = [json.loads(line) for line in lines[1:] if line.endswith("}")]
    asked = [(kind, name, seed) for seed in seeds for kind, name in families(kinds)]
    known = {(d["kind"], d["family"], d["seed"]): d for d in done}
    out.parent.mkdir(parents=True, exist_ok=True)
    with open(out, "a", encoding="utf-8") as file:
        if not out.stat().st_size:
            file.write(head + "\n")
        elif lines[-1]:
            file.write("\n")  # a line that was cut off
        for n, one in enumerate(asked):
            if one not in known:
                known[one] = said(*one)
                file.write(json.dumps(known[one]) + "\n")
                file.flush()
            tell(n + 1, len(asked))
    return scored([known[one] for one in asked])


def wrong(one: dict[str, Any], confirmed: bool) -> list[str]:
    """Names of a set that are not true of it, of the findings that are (not) confirmed."""
    family = one["family"]
    true = {UNKNOWN, *ARGUABLE.get(family, ()), *BESIDE.get(family, ())}
    if one["kind"] == "listed":
        true |= set(LISTED[family][1])
    return [name for name, sure in one["findings"] if name not in true and sure == confirmed]


def named(one: dict[str, Any]) -> bool:
    """Whether a listed effect has its name."""
    return any(name in LISTED[one["family"]][1] for name, _ in one["findings"])


def scored(sets: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A table for `bin/bench docs`: shares of sets with Clopper-Pearson intervals, and the wrong names."""
    by_kind = {kind: [s for s in sets if s["kind"] == kind] for kind in KINDS}
    rows: list[list[str]] = []

    def row(what: str, flags: Iterable[bool]) -> None:
        flags = list(flags)
        if flags:
            found = count(flags)
            low, high = (100 * v for v in found["ci95"])
            rows.append([what, f"{found['hits']} of {len(flags)} ({low:.0f}–{high:.0f} %)"])

    unlisted, listed, null = (by_kind[kind] for kind in KINDS)
    row("no name for it: told from the simulator", (s["verdict"] != MATCH for s in unlisted))
    row("no name for it: a confirmed finding with a wrong name", (bool(wrong(s, True)) for s in unlisted))
    row("no name for it: another finding with a wrong name", (bool(wrong(s, False)) for s in unlisted))
    row("a name, in another form: found and named", (named(s) for s in listed))
    row(
        "a name, in another form: a confirmed finding with a wrong name",
        (bool(wrong(s, True)) for s in listed),
    )
    row("a name, in another form: another finding with a wrong name", (bool(wrong(s, False)) for s in listed))
    row("nothing, or flats with dark corners: told from the simulator", (s["verdict"] != MATCH for s in null))
    shown = [f"{s['family']} {s['seed']}: {', '.join(names)}" for s in sets if (names := wrong(s, True))]
    missed = [f"{s['family']} {s['seed']}" for s in listed if not named(s)]
    return {
        "columns": ["sets", "of all (95 %)"],
        "rows": rows,
        "values": {"wrong_names": "; ".join(shown) or "none", "not_named": "; ".join(missed) or "none"},
        "code": [f"cannoise_jax/{part}" for part in _CODE],
    }
