"""What a command that takes one set of a folder uses of it, what it does not use, and how to get at that."""

from __future__ import annotations

import shlex

from cannoise_jax.recordings.folders.groups import differing
from cannoise_jax.recordings.folders.levels import GUESSED
from cannoise_jax.recordings.folders.names import listed
from cannoise_jax.recordings.folders.plan import CaptureGroups, Plan

_USED = "used: "


def used_line(plan: Plan) -> str:
    """A line that names the set that is used and the files that are not; empty where all are."""
    main, *others = plan.sets
    if not others:
        return ""
    first = main.groups[0].mode
    apart = (pair for one in others for pair in differing(first, one.groups[0].mode))
    differ = dict.fromkeys(f"{name.replace('_', ' ')} {own}" for name, own, _ in apart)
    files, rest = _files(main), [(one.folder, _files(one)) for one in others]
    lost = {name for _, names in rest for name in names} - set(files)
    if not lost:
        return ""
    parts = ", ".join(f"{len(names)} as {place}/ ({listed(names)})" for place, names in rest)
    which = f" ({', '.join(differ)})" if differ else ""
    folder = shlex.quote(str(plan.folder))
    return (
        f"{_USED}{len(files)} of {len(files) + len(lost)} files{which}; not used: {parts}: bin/convert "
        f"{folder} OUT writes every set, these into OUT/{others[0].folder} and so on, each to be used "
        "by itself"
    )


def used_of(said: str) -> str:
    """The line of `used_line` in what was said of a folder; empty where there is none."""
    return next((line for line in said.splitlines() if line.startswith(_USED)), "")


def guessed_white_of(said: str) -> str:
    """That the white level was guessed, from what was said of a folder; empty where it was not."""
    line = next((line for line in said.splitlines() if "white level" in line and GUESSED in line), "")
    return f"Guessed, and with it what is normalised: {line.removeprefix('note: ')}" if line else ""


def _files(one: CaptureGroups) -> list[str]:
    return list(dict.fromkeys(s.name for g in one.groups for s in g.shots))
