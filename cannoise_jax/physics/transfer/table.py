"""Photon transfer as a plain-text table: a line per quantity, a column per channel, intervals in brackets."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome
from cannoise_jax.physics.transfer.photon_transfer import PhotonTransfer, channels_of
from cannoise_jax.physics.transfer.quantities import Quantity
from cannoise_jax.physics.transfer.shape import dark_lines, lamp_notes
from cannoise_jax.physics.transfer.stated_gain import gain_note
from cannoise_jax.recordings.recording import Recording

_LONG = 1e7
"""From here on numbers are written by their order: ends of intervals that nothing bounds."""


def format_transfer(result: PhotonTransfer) -> str:
    """The table of one ISO setting. Intervals are 90 %."""
    setting = f", {named}" if (named := setting_of(result)) else ""
    names = channels_of(result)
    lines = [["", "unit", *(names if len(names) > 1 else ["all pixels"])]]
    notes: list[str] = []
    missing: dict[str, list[str]] = {}
    for name, unit in dict.fromkeys((q.name, q.unit) for q in result.quantities):
        group = [q for q in result.quantities if (q.name, q.unit) == (name, unit)]
        cells = _cells(group, names)
        lacking: dict[str, list[str]] = {}
        for q in group:
            if isinstance(q.outcome, NotMeasurable):
                lacking.setdefault(q.outcome.record, []).append(q.channel)
        if any(isinstance(q.outcome, Estimate) for q in group):
            lines.append([name, unit, *cells])
            notes += [f"{name}: {note}" for note in _notes(group)]
        for reason, channels in sorted(lacking.items()):
            said = f"{name} ({unit})" if len(lacking) > 1 else name
            said += f" of {', '.join(channels)}" if len(channels) < len(group) else ""
            missing.setdefault(reason, []).append(said)
    out = [f"{result.camera}{setting}: photon transfer (EMVA 1288 definitions), 90 % intervals"]
    if len(lines) > 1:
        out += ["", *aligned(lines)]
    darks = dark_lines(result.statistics)
    if darks:
        out += ["", "Darks over exposure, DN, all channels:", *aligned(darks)]
    notes += lamp_notes(result.statistics)
    stated = _stated_gain(result)
    notes += [stated] if stated else []
    if notes:
        out += ["", *dict.fromkeys(notes)]
    if missing:
        out += ["", "Not measured, for want of these recordings:"]
        out += [f"  {'; '.join(dict.fromkeys(names_))}: {reason}" for reason, names_ in missing.items()]
    return "\n".join(out)


def setting_of(result: PhotonTransfer) -> str:
    """The gain setting as the camera counts it, empty where none is stated: the ISO of one that counts in dB
    is made up (100 at 0 dB)."""
    return gain_words(result.statistics[0].recording)


def gain_words(recording: Recording) -> str:
    """The gain setting of a recording, as `setting_of`."""
    if recording.gain_db is not None:
        return f"gain {recording.gain_db:g} dB"
    return "" if recording.iso is None else f"ISO {recording.iso:g}"


def format_outcome(outcome: Outcome) -> str:
    """`value [low, high]` with as many digits as the interval is worth, or `not measured`."""
    if isinstance(outcome, NotMeasurable):
        return "not measured"
    width = outcome.ci90[1] - outcome.ci90[0]
    digits = 0
    while digits < 7 and width > 0 and 10**-digits > width / 8:
        digits += 1
    value, low, high = (
        f"{v:z.{digits}f}" if abs(v) < _LONG else f"{v:.2g}" for v in (outcome.value, *outcome.ci90)
    )
    return f"{value} [{low}, {high}]" if width > 0 else f"{outcome.value:zg}"


def _stated_gain(result: PhotonTransfer) -> str | None:
    found = [o for o in result.outcomes("system gain") if isinstance(o, Estimate)]
    recordings = [s.recording for s in result.statistics]
    return gain_note(recordings, [o.value for o in found], [o.stderr for o in found])


def _cells(group: list[Quantity], names: Sequence[str]) -> list[str]:
    whole = [q for q in group if q.channel == "all"]
    if whole:
        return [format_outcome(whole[0].outcome)]
    by_channel = {q.channel: q for q in group}
    return [format_outcome(by_channel[n].outcome) if n in by_channel else "" for n in names]


def _notes(group: list[Quantity]) -> list[str]:
    notes = {q.channel: q.note for q in group if q.note}
    if len(set(notes.values())) == 1 and len(notes) > 1:
        return [next(iter(notes.values()))]
    return ["; ".join(note if c == "all" else f"{c} {note}" for c, note in notes.items())] if notes else []


def aligned(lines: list[list[str]]) -> list[str]:
    """Cells padded to columns."""
    count = max(len(line) for line in lines)
    # A line with one value for all channels does not widen the first channel's column.
    widths = [max(len(line[i]) for line in lines if len(line) == count or i < 2) for i in range(count)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=False)).rstrip()
        for line in lines
    ]
