"""What a folder holds and what will become of it: every contradiction and everything missing at once."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cannoise_jax.recordings.folders.exposures import exposed, judged_exposures, other_settings
from cannoise_jax.recordings.folders.full import with_full_codes
from cannoise_jax.recordings.folders.groups import Group, differing, grouped, word_of
from cannoise_jax.recordings.folders.kinds import TAKEN_AS_LIGHTS, kinds_of, of_other_kinds
from cannoise_jax.recordings.folders.lacks import NO_LIGHT, contradictions, lacks
from cannoise_jax.recordings.folders.levels import Levels, levels
from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.readouts import told_apart
from cannoise_jax.recordings.folders.shots import Scan, Shot, Tell, matches, scan, unmatched
from cannoise_jax.recordings.load import UNREAD
from cannoise_jax.recordings.metadata import folder_name
from cannoise_jax.recordings.recording import DARK, LIT, BadInput

_LEFT_OUT = ": left out"
_AVERAGES = "an average or sum, no frame", "averages or sums, no frames"


@dataclass(frozen=True)
class CaptureGroups:
    """One set: the recordings of one sensor mode. folder: below the output, '' for the main one.
    reason: why it is not part of the main one."""

    folder: str
    groups: tuple[Group, ...]
    levels: Levels
    reason: str = ""


@dataclass(frozen=True)
class Plan:
    """sets: the first is the capture set, the others are kept apart. notes: what was decided and why.
    problems: what keeps the plan from being carried out, each with its remedy."""

    folder: Path
    sets: tuple[CaptureGroups, ...]
    notes: tuple[str, ...]
    problems: tuple[str, ...]
    overrides: dict[str, Any]

    @property
    def shots(self) -> tuple[Shot, ...]:
        """All files that are used."""
        return tuple(s for one in self.sets for g in one.groups for s in g.shots)


def plan_folder(
    folder: Path,
    overrides: dict[str, Any] | None = None,
    *,
    assign: Sequence[tuple[str, str]] = (),
    leave_out: Iterable[str] = (),
    tell: Tell = lambda n, total: None,
) -> Plan:
    """The plan for a folder of recordings. assign: (pattern of names, kind), the first that fits decides.

    Raises BadInput where the folder holds nothing that can be read.
    """
    overrides = {k: v for k, v in (overrides or {}).items() if v is not None}
    leave_out = tuple(leave_out)
    found = scan(folder, leave_out, tell, overrides)
    notes, problems = _notes(found), _failures(found)
    apart, said = told_apart((*found.shots, *found.full))
    found = found._replace(shots=tuple(apart[: len(found.shots)]), full=tuple(apart[len(found.shots) :]))
    notes += said
    notes += [f"--leave-out {p}: no file of such a name" for p in unmatched(folder, leave_out)]
    stated: set[str] = set()
    for pattern, kind in assign:
        fitting = {s.name for s in found.shots if matches(s.name, pattern)}
        notes += [] if fitting else [f"--assign {pattern}={kind}: {_why_none(found, folder, pattern)}"]
        stated |= fitting
    kinds, more_notes, more_problems = kinds_of(found.shots, assign, overrides.get("kind"))
    notes, problems = notes + more_notes, problems + more_problems
    usable, silent = _one_pattern([s for s in found.shots if s.name in kinds])
    notes += silent
    notes += other_settings(usable)
    if "exposure_s" not in overrides:
        usable, doubtful = judged_exposures(usable, kinds)
        notes += doubtful
    elif overrides["exposure_s"] == 0:
        problems += exposed(kinds)
    named = Counter(s.known["camera"] for s in usable if "camera" in s.known)
    camera = next(iter(named)) if len(named) == 1 else folder_name(Path(folder))
    if usable and not named and "camera" not in overrides:
        notes.append(
            f"no file names its camera: all are called {camera}, after the folder; --camera NAME does"
        )
    full_kinds, _, _ = kinds_of(found.full, assign, overrides.get("kind"))
    groups = with_full_codes(grouped(usable, kinds, camera, overrides), found.full, full_kinds)
    sets = _sets(groups, overrides)
    problems += of_other_kinds([g for one in sets for g in one.groups], stated)
    for one in sets[:1]:
        notes += one.levels.said
        notes += lacks(one.groups)
        problems += [*one.levels.missing, *contradictions(one.groups)]
        problems += _apart(sets) if one.levels.missing else []
    notes += [words for one in sets[1:] for words in _borrowed(one, sets[0])]
    problems += [words for one in sets[1:] for words in _of_another_camera(one, sets[0])]
    cameras = dict.fromkeys(one.groups[0].mode[0] for one in sets)
    if len(cameras) > 1:
        notes.append(f"{len(cameras)} cameras ({', '.join(cameras)}): if they are one, name it with --camera")
    if not usable and not problems:
        problems.append("no file is a raw frame: " + "; ".join(notes))
    return Plan(folder, tuple(sets), tuple(dict.fromkeys(notes)), tuple(problems), overrides)


def _why_none(found: Scan, folder: Path, pattern: str) -> str:
    """Why a pattern fits none of the files that are used."""
    if unmatched(folder, [pattern]):
        return "no file of such a name"
    averages = [name for name, _ in found.averages if matches(name, pattern)]
    why = f"; {listed(averages)} as averages, by header or name: rename what is none" if averages else ""
    return f"no file of such a name is used{why}"


def check(plan: Plan) -> None:
    """Raises BadInput, in one line that lists everything, where the plan has problems."""
    if plan.problems:
        why = [n for n in plan.notes if _may_be_why(n) and not any(n in words for words in plan.problems)]
        raise BadInput(f"{plan.folder}: " + "; ".join((*plan.problems, *why)))


def _may_be_why(note: str) -> bool:
    """Whether a note may be the reason of a problem, or names what else is missing."""
    return note.endswith(_LEFT_OUT) or TAKEN_AS_LIGHTS in note or note == NO_LIGHT


def _one_pattern(shots: list[Shot]) -> tuple[list[Shot], list[str]]:
    """The shots of which some state a colour order with it stated by all: darks are often written without.
    Where files state several, or a camera that states none is named, nothing is said for the silent ones."""
    said = {s.known["cfa"] for s in shots if "cfa" in s.known}
    cameras = {s.known.get("camera") for s in shots}
    silent = [s for s in shots if "cfa" not in s.known and not s.whole]
    if len(said) != 1 or len(cameras) > 1 or not silent:
        return shots, []
    cfa = said.pop()
    names = {s.name for s in silent}
    filled = [s._replace(known={**s.known, "cfa": cfa}) if s.name in names else s for s in shots]
    return filled, [f"{listed(sorted(names))}: no colour order stated: {cfa}, as the others"]


def _notes(found: Scan) -> list[str]:
    by_why: dict[str, list[str]] = {}
    for name, why in found.averages:
        by_why.setdefault(why, []).append(name)
    notes = [
        f"{listed(names)}: {_AVERAGES[len(names) > 1]} ({why}){_LEFT_OUT}" for why, names in by_why.items()
    ]
    by_fault: dict[str, list[str]] = {}
    for name, fault in found.duds:
        by_fault.setdefault(fault, []).append(name)
    notes += [f"{listed(names)}: {fault}{_LEFT_OUT}" for fault, names in by_fault.items()]
    notes += [f"{name}: the same pixels as {first}: used once" for name, first in found.copies]
    by_doubt: dict[str, list[str]] = {}
    for shot in found.shots:
        for doubt in (shot.about.get("doubt", ""), *shot.about.get("named_doubts", ())):
            by_doubt.setdefault(doubt, []).append(shot.name)
    by_doubt.pop("", None)
    notes += [f"{listed(names)}: {doubt}" for doubt, names in by_doubt.items()]
    if found.links:
        notes.append(f"{listed(found.links)}: not read, links to folders are not followed")
    if found.lost:
        notes.append(f"{listed(found.lost)}: not read, a link to nothing")
    if found.pictures:
        notes.append(f"{listed(found.pictures)}: not read, developed pictures in colours")
    for suffixes, why in UNREAD:
        counts = [f"{n} {suffix}" for suffix, n in sorted(found.unread.items()) if suffix in suffixes]
        notes += [f"not read: {', '.join(counts)} ({why})"] if counts else []
    return notes


def _failures(found: Scan) -> list[str]:
    alike: dict[str, list[tuple[str, str]]] = {}
    for name, reason in found.failures:  # reasons that differ by their numbers are one
        alike.setdefault(re.sub(r"[-+]?\d[\d.]*", "#", reason), []).append((name, reason))
    out = []
    for failed in alike.values():
        names, reasons = zip(*failed, strict=True)
        first = "" if len(set(reasons)) == 1 else "the first: "
        them = "them" if len(names) > 1 else "it"
        out.append(f"{listed(names)}: {first}{reasons[0]}; or leave {them} out with --leave-out")
    return out


def _sets(groups: list[Group], overrides: dict[str, Any]) -> list[CaptureGroups]:
    by_mode: dict[tuple, list[Group]] = {}
    for group in groups:
        by_mode.setdefault(group.mode, []).append(group)
    if not by_mode:
        return []

    def rank(mode: tuple) -> tuple:
        own = by_mode[mode]
        lit, dark = (any(g.kind in k and g.frames > 1 for g in own) for k in (LIT, DARK))
        height, width = own[0].size
        return lit and dark, lit, sum(g.frames for g in own), height * width

    order = sorted(by_mode, key=rank, reverse=True)
    main = by_mode[order[0]]
    scenes = [g for g in main if g.kind == "scene" and not all(s.whole for s in g.shots)]
    out = []
    if scenes and any(g.kind == "flat" for g in main):
        main = [g for g in main if g not in scenes]
        reason = "flats serve, and what lights show moves from frame to frame"
        out.append(("lights", scenes, reason))
    for mode in order[1:]:
        differs = list(differing(mode, order[0]))
        reason = ", ".join(_unlike(*one) for one in differs)
        name = "_".join(f"{n}_{a}".replace(" ", "_") for n, a, _ in differs[:2])
        out.append((name, by_mode[mode], reason))
    first = CaptureGroups("", _labelled(main), levels(main, overrides))
    rest = []
    for name, own, reason in out:
        known = levels(own, overrides)
        if own[0].mode == order[0] or (known.missing and own[0].mode[0] == order[0][0]):
            known = known._replace(values={**first.levels.values, **known.values})
        rest.append(CaptureGroups(_as_folder(name), _labelled(own), known, reason))
    return [first, *rest]


def _labelled(groups: Sequence[Group]) -> tuple[Group, ...]:
    """Groups whose labels tell them apart, numbered where their settings do not."""
    counts = Counter(g.label for g in groups)
    seen: Counter = Counter()
    out = []
    for group in groups:
        seen[group.label] += 1
        more = f"_{seen[group.label]}" if counts[group.label] > 1 else ""
        out.append(
            Group(group.kind, group.shots, group.settings, group.mode, group.filter, group.label + more)
        )
    return tuple(out)


def _apart(sets: Sequence[CaptureGroups]) -> list[str]:
    """Darks that the black level would be taken from, were they of the main set."""
    main, *others = sets
    if any(g.kind in DARK for g in main.groups):
        return []
    return [
        f"{one.groups[0].shots[0].name}: of no use to {main.groups[0].shots[0].name}, for {one.reason}"
        for one in others
        if any(g.kind in DARK for g in one.groups)
    ]


_LEVELS = {"cfa": "colour order", "black_level": "black level", "white_level": "white level"}


def _borrowed(one: CaptureGroups, main: CaptureGroups) -> list[str]:
    """Levels that nothing in a set of its own shows, so that they are those of the main one."""
    if one.groups[0].mode[0] != main.groups[0].mode[0] or one.groups[0].mode == main.groups[0].mode:
        return []
    found = "\n".join(one.levels.missing)
    names = [what for field, what in _LEVELS.items() if f"the {what}" in found and field in one.levels.values]
    return [f"{one.folder}/: {', '.join(names)} as in the first set"] if names else []


def _of_another_camera(one: CaptureGroups, main: CaptureGroups) -> list[str]:
    """What a set of another camera lacks: levels of one camera are none of another."""
    camera = one.groups[0].mode[0]
    if camera == main.groups[0].mode[0] or not one.levels.missing:
        return []
    names = listed([s.name for g in one.groups for s in g.shots])
    return [f"{names}, of {camera}: {words}; or leave out with --leave-out" for words in one.levels.missing]


def _as_folder(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "-" for c in name)[:60]


def _unlike(name: str, here: str, there: str) -> str:
    """What a set differs in from the first, in words."""
    silent = word_of(None, "gain")
    if there == silent:
        return f"{name} is {here}, where the others state none"
    return (
        f"{name} is {silent}, {there} in the others" if here == silent else f"{name} is {here}, not {there}"
    )
