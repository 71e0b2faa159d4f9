"""Cameras of `blind.plain_camera` diagnosed: whether what has no name is left without one, and what has one
gets it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from cannoise_jax.blind.judge import count
from cannoise_jax.blind.plain_camera import SIZE, Make, capture_set
from cannoise_jax.blind.plain_listed import LISTED, NULLS
from cannoise_jax.blind.plain_names import ARGUABLE, BESIDE
from cannoise_jax.blind.plain_unlisted import LATER, UNLISTED
from cannoise_jax.discovery.diagnose import diagnose
from cannoise_jax.discovery.proof.verdict import MATCH, NO_CAUSE, PARTLY
from cannoise_jax.discovery.report.light import shadowed
from cannoise_jax.discovery.search.name import UNKNOWN
from cannoise_jax.discovery.search.steps import part_of
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.trials.analysis import fingerprint
from cannoise_jax.trials.lines import adding, read

_OTHER = "of another analysis or other cameras: choose a new file"
_REFUSED = "refused"
KINDS = ("unlisted", "listed", "null")
_GENERATOR = ("blind/plain_camera.py", "blind/plain_listed.py", "blind/plain_unlisted.py")
_CODE = (
    *("vocabulary.py", "recordings", "physics", "mechanisms", "signatures", "evaluation", "discovery"),
    *(*_GENERATOR, "blind/plain_names.py"),
)


def families(kinds: Iterable[str] = KINDS) -> list[tuple[str, str]]:
    """Kind and name of every family."""
    names: dict[str, Iterable[str]] = {"unlisted": UNLISTED, "listed": LISTED, "null": NULLS}
    return [(kind, name) for kind in kinds for name in names[kind]]


def plain_set(kind: str, name: str, seed: int, size: tuple[int, int] = SIZE):
    """The capture set of a family and seed."""
    make: Make = {"unlisted": UNLISTED, "null": NULLS}[kind][name] if kind != "listed" else LISTED[name][0]
    return capture_set(make, np.random.default_rng([seed, *name.encode()]), size)


def said(
    kind: str, name: str, seed: int, size: tuple[int, int] = SIZE, compare: bool = True
) -> dict[str, Any]:
    """What a diagnosis says of one set: its verdict, every finding with whether it is confirmed, and whether
    it takes spots in the flats for light. compare: also what draws of the simulator say, without which no
    name is withdrawn. One that is refused has the reason, and no finding."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = diagnose(plain_set(kind, name, seed, size), key=jax.random.key(seed), compare=compare)
    except BadInput as error:
        one = {"kind": kind, "family": name, "seed": seed, "verdict": _REFUSED, "shadows": False}
        return {**one, "findings": [], "why": str(error)}
    aside = part_of(found.fitted.steps)
    return {
        "kind": kind,
        "family": name,
        "seed": seed,
        "verdict": str(found.verdict),
        "shadows": bool(shadowed(found)),
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
    Raises BadInput where it holds those of another analysis or of other cameras."""
    of = {"code_sha256": fingerprint(*_GENERATOR)}
    done = read(out, of, _OTHER) if out.exists() else []
    asked = [(kind, name, seed) for seed in seeds for kind, name in families(kinds)]
    known = {(d["kind"], d["family"], d["seed"]): d for d in done}
    out.parent.mkdir(parents=True, exist_ok=True)
    with adding(out, of) as add:
        for n, one in enumerate(asked):
            if one not in known:
                known[one] = said(*one)
                add(known[one])
            tell(n + 1, len(asked))
    return scored([known[one] for one in asked])


def wrong(one: dict[str, Any], confirmed: bool) -> list[str]:
    """Names of a set that are not true of it, of the findings that are (not) confirmed."""
    family = one["family"]
    true = {UNKNOWN, *ARGUABLE.get(family, ()), *BESIDE.get(family, ())}
    if one["kind"] == "listed":
        true |= set(LISTED[family][1])
    return [name for name, sure in one["findings"] if name not in true and sure == confirmed]


def flagged(one: dict[str, Any]) -> bool:
    """Whether a set is told from the simulator at all, or spots in its flats are told of."""
    return one["verdict"] != MATCH or one["shadows"]


def refused(one: dict[str, Any]) -> bool:
    """Whether a set was not diagnosed at all."""
    return one["verdict"] == _REFUSED


def unknown(one: dict[str, Any]) -> bool:
    """Whether it is said that something in a set has no name; of spots, that they may be the light's or the
    pixels'."""
    unnamed = any(name == UNKNOWN for name, _ in one["findings"]) or one["verdict"] in (NO_CAUSE, PARTLY)
    return unnamed or one["shadows"]


def named(one: dict[str, Any]) -> bool:
    """Whether a listed effect has its name; one that was withdrawn does not count."""
    return any(name in LISTED[one["family"]][1] for name, _ in one["findings"])


def surely_wrong(one: dict[str, Any]) -> bool:
    """Whether a confirmed finding has a wrong name."""
    return bool(wrong(one, True))


def perhaps_wrong(one: dict[str, Any]) -> bool:
    """Whether a finding that is not confirmed has a wrong name."""
    return bool(wrong(one, False))


_WRONG = (
    ("a confirmed finding with a wrong name", surely_wrong),
    ("a finding, not confirmed, with a wrong name", perhaps_wrong),
)
_UNLISTED = (("told from the simulator", flagged), ("said to be unknown, all or in part", unknown), *_WRONG)
_MEASURES = {
    "unlisted": ("no name for it", _UNLISTED),
    "later": ("of these, the later families", _UNLISTED),
    "listed": ("a name, in another form", (("found and named", named), *_WRONG)),
    "null": ("nothing, or flats with dark corners", (("told from the simulator", flagged),)),
}


def scored(sets: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """A table for `bin/bench docs`: shares of sets, of every seed and of all with Clopper-Pearson intervals,
    and the wrong names."""
    later = {make.__name__ for make in LATER}
    groups = {kind: [s for s in sets if s["kind"] == kind] for kind in KINDS}
    groups["later"] = [s for s in groups["unlisted"] if s["family"] in later]
    seeds = sorted({s["seed"] for s in sets})
    rows = [
        [f"{title}: {what}", *_shares(groups[kind], seeds, holds)]
        for kind, (title, measures) in _MEASURES.items()
        for what, holds in measures
        if groups[kind]
    ]

    def shown(sure: bool) -> str:
        found = [f"{s['family']} {s['seed']}: {', '.join(names)}" for s in sets if (names := wrong(s, sure))]
        return "; ".join(found) or "none"

    def those(kind: str, holds: Callable[[dict[str, Any]], bool]) -> str:
        return ", ".join(f"{s['family']} {s['seed']}" for s in groups[kind] if holds(s)) or "none"

    return {
        "columns": ["sets", *(f"seed {seed}" for seed in seeds), "all (95 %)"],
        "rows": rows,
        "values": {
            "wrong_names": shown(True),
            "wrong_not_confirmed": shown(False),
            "not_named": those("listed", lambda s: not named(s)),
            "not_told": those("unlisted", lambda s: not flagged(s)),
            "false_alarms": those("null", flagged),
            "refused": ", ".join(f"{s['family']} {s['seed']}" for s in sets if refused(s)) or "none",
        },
        "code": [f"cannoise_jax/{part}" for part in _CODE],
    }


def _shares(
    sets: Sequence[dict[str, Any]], seeds: Sequence[int], holds: Callable[[dict[str, Any]], bool]
) -> list[str]:
    """How many of the sets of every seed, and of all."""
    each = [[holds(s) for s in sets if s["seed"] == seed] for seed in seeds]
    found = count(holds(s) for s in sets)
    low, high = (100 * v for v in found["ci95"])
    alone = [f"{sum(flags)} of {len(flags)}" for flags in each]
    return [*alone, f"{found['hits']} of {found['sets']} ({low:.0f}–{high:.0f} %)"]
