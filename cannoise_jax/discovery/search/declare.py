"""Declare: what the recordings are, and so which mechanisms they can show; for each of the others,
what to record."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches

from cannoise_jax.discovery.search.locate import Located
from cannoise_jax.mechanisms import LISTED
from cannoise_jax.mechanisms.checked import check_entry
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.signature import Signature
from cannoise_jax.vocabulary import UNKNOWN

_SHOWN = 6
"""Names that a message lists."""


def registered(
    without: Sequence[str] = (), mechanisms: Sequence[str | Entry] | None = None
) -> tuple[Entry, ...]:
    """The entries that a run may name: those of the package, and of one's own where `mechanisms` holds any;
    of these `mechanisms` alone where given. Raises ValueError for a name that is none of them, ValueError and
    TypeError for what `check_entry` refuses."""
    if isinstance(without, str):
        raise TypeError(f"without is the text {without!r}: expected names in a list")
    odd = next((m for m in mechanisms or () if not isinstance(m, (str, Entry))), None)
    if odd is not None:
        raise TypeError(f"mechanisms holds a {type(odd).__name__}: expected names and entries")
    own = tuple(m for m in mechanisms or () if isinstance(m, Entry) and m not in LISTED)
    known = {entry.id: entry for entry in LISTED}
    for entry in own:
        if entry.id in known or entry.id == UNKNOWN.id:
            raise ValueError(f"{entry.id}: there is a mechanism of this name: choose another")
        check_entry(entry)
        known[entry.id] = entry
    wanted = None if mechanisms is None else {m if isinstance(m, str) else m.id for m in mechanisms}
    for id in (*without, *(wanted or ())):
        if id not in known:
            near, some = get_close_matches(id, known, n=1), ", ".join(list(known)[:_SHOWN])
            others = f"{len(known) - _SHOWN} more: bin/simulate --catalogue --out FILE shows them"
            said = f"did you mean {near[0]}?" if near else f"known: {some} and {others}"
            raise ValueError(f"{id}: no such mechanism: {said}")
    return tuple(e for id, e in known.items() if id not in without and (wanted is None or id in wanted))


def testable(
    located: Located, signatures: tuple[Signature, ...], entries: tuple[Entry, ...]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Ids that some signature could test on these recordings, and the others with what to record."""
    tested = {s.mechanism for s in signatures if s.name in located.scores}
    yes = tuple(e.id for e in entries if e.id in tested)
    return yes, tuple((e.id, needs(e)) for e in entries if e.id not in tested)


NOTHING_LOOKS = "nothing looks for it yet; it would show in "


def needs(entry: Entry) -> str:
    """What to record for a mechanism; said so where no recording helps yet."""
    return entry.needs if entry.looked_for else NOTHING_LOOKS + entry.needs


def kinds(capture: CaptureSet) -> list[dict]:
    """One line per recording: what it is, as the report lists it."""
    out = []
    for r in capture.recordings:
        settings = {
            "iso": r.iso,
            "exposure_s": r.exposure_s,
            "temperature_c": r.temperature_c,
            "reference": r.reference if r.clean is not None else None,
        }
        out.append({"file": r.path or "in memory", "kind": r.kind, "frames": r.count, "settings": settings})
    return out
