"""A plan as lines for a screen: each set with its recordings in columns, then notes and problems."""

from __future__ import annotations

from cannoise_jax.recordings.folders.groups import Group, seconds
from cannoise_jax.recordings.folders.plan import CaptureGroups, Plan
from cannoise_jax.recordings.recording import printable


def text(plan: Plan) -> str:
    """The plan as lines for a screen."""
    lines = []
    for one in plan.sets:
        first = one.groups[0]
        where = f"{one.folder}/ " if one.folder else ""
        size = "{} x {}".format(*first.size)
        lines.append(
            f"{where}{first.mode[0]}, {size}, {_cfa(one)}{f': apart, {one.reason}' if one.reason else ''}"
        )
        rows = [_row(group) for group in one.groups]
        wide = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines += [
            "  ".join(["", *(w.ljust(n) for w, n in zip(row, wide, strict=True))]).rstrip() for row in rows
        ]
    lines += [f"note: {note}" for note in plan.notes]
    lines += [f"missing or contradictory: {problem}" for problem in plan.problems]
    return "\n".join(map(printable, lines))


def _row(group: Group) -> tuple[str, str, str, str]:
    names = [s.title for s in group.shots]
    frames = f"{group.frames} frame{'s' * (group.frames > 1)}"
    return (
        f"{group.label}.h5", frames, _settings(group),
        names[0] + (f" to {names[-1]}" if len(names) > 1 else ""),
    )  # fmt: skip


def _cfa(one: CaptureGroups) -> str:
    return one.levels.values.get("cfa") or one.groups[0].mode[7] or "colour order unknown"


def _settings(group: Group) -> str:
    s = group.settings
    parts = [seconds(s["exposure_s"])] if s["exposure_s"] is not None else []
    if s["gain_db"] is not None:
        parts.append(f"gain {s['gain_db']:g} dB")
    elif s["iso"] is not None:
        parts.append(f"ISO {s['iso']:g}")
    parts += [f"{s['temperature_c']:.1f} C"] if s["temperature_c"] is not None else []
    return ", ".join([*parts, *([group.filter] if group.filter else [])])
