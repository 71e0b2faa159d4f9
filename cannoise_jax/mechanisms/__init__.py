"""Mechanisms of noise: one file a family, one entry each."""

from __future__ import annotations

import dataclasses
from collections import Counter

from cannoise_jax.mechanisms import (
    capture,
    converter,
    dark_charge,
    digital,
    noise_steps,
    parity,
    photons,
    pixel,
    readout,
    transfer,
    transport,
    unnamed,
)
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.mechanisms.pedestal import PEDESTAL
from cannoise_jax.mechanisms.residual import RESIDUAL
from cannoise_jax.signatures.behind_gain import BEHIND
from cannoise_jax.signatures.generic import BY_ITS_SAMPLER
from cannoise_jax.signatures.recorded import Recorded
from cannoise_jax.signatures.signature import Signature
from cannoise_jax.vocabulary import UNKNOWN, Term

_FAMILIES = (
    capture.ENTRIES,
    photons.ENTRIES,
    dark_charge.ENTRIES,
    noise_steps.ENTRIES,
    pixel.EARLY,  # charge that is there before any moves
    transport.ENTRIES,
    transfer.ENTRIES,
    pixel.ENTRIES,
    readout.ENTRIES,
    parity.ENTRIES,
    converter.ENTRIES,
    digital.ENTRIES,
    capture.LAST,  # the description is laid over whatever came out
)


def _mutual(entries: tuple[Entry, ...]) -> tuple[Entry, ...]:
    """What one record says it is confused with is said of the other as well, after its own list."""

    def both(entry: Entry) -> Entry:
        own = entry.record.confused_with
        more = (e.id for e in entries if entry.id in e.record.confused_with and e.id not in own)
        return dataclasses.replace(
            entry, record=dataclasses.replace(entry.record, confused_with=(*own, *more))
        )

    return tuple(both(entry) for entry in entries)


ENTRIES: tuple[Entry, ...] = _mutual(tuple(entry for family in _FAMILIES for entry in family))
"""All mechanisms in the order of the signal chain."""

RECORDS = {**{entry.id: entry.record for entry in ENTRIES}, **{r.id: r for r in (RESIDUAL, PEDESTAL)}}
"""All that a camera model may hold, by id: what no name explains is drawn and kept like the others."""

LISTED: tuple[Entry, ...] = tuple(sorted(ENTRIES, key=lambda entry: entry.term.listed))
"""The same in the order in which they are listed: class by class, the common ones first."""

MECHANISMS: dict[str, Entry] = {entry.id: entry for entry in ENTRIES}

VOCABULARY: dict[str, Term] = {**{entry.id: entry.term for entry in LISTED}, UNKNOWN.id: UNKNOWN}


def signatures(recorded: Recorded, entries: tuple[Entry, ...] = ENTRIES) -> tuple[Signature, ...]:
    """All that recordings are searched for: the signatures of the entries, and structures without a name.

    Raises ValueError where two have one name: scores are kept by it, so that one would be lost.
    """
    nameless = unnamed.signatures(recorded)
    named = (_at_its_place(s, nameless) for entry in entries for s in entry.looks(recorded))
    found = (*named, *nameless)
    for name, count in Counter(s.name for s in found).items():
        if count > 1:
            of = ", ".join(sorted({s.mechanism or UNKNOWN.id for s in found if s.name == name}))
            raise ValueError(f"{name}: {count} signatures of this name, of {of}: give each a name of its own")
    return tuple(_on_both_sides(_covering_all(s, found), found) for s in found)


def _at_its_place(signature: Signature, nameless: tuple[Signature, ...]) -> Signature:
    """A signature of which only the sampler is known, which the structures at its own place speak for: by a
    statistic of its own each tells more of it than a template, and what is found there has its name."""
    if signature.axes.law != BY_ITS_SAMPLER:
        return signature

    def place(s: Signature) -> tuple[str, str, str]:
        return s.axes.varies_over, s.axes.time, s.axes.scales

    same = tuple(s.name for s in nameless if place(s) == place(signature))
    return dataclasses.replace(
        signature, covers=(*signature.covers, *same), lifted_by=(*signature.lifted_by, *same)
    )


def _covering_all(signature: Signature, found: tuple[Signature, ...]) -> Signature:
    """The signature, which also covers those that say that it does."""
    more = tuple(s.name for s in found if signature.name in s.covered_by and s.name not in signature.covers)
    return dataclasses.replace(signature, covers=signature.covers + more) if more else signature


def _on_both_sides(signature: Signature, found: tuple[Signature, ...]) -> Signature:
    """The signature, to which what is behind the gain is what the same before it is."""
    names = {s.name for s in found}
    behind = {n: n + BEHIND for n in names if n + BEHIND in names}
    if not behind:
        return signature

    def both(named: tuple[str, ...]) -> tuple[str, ...]:
        return (*named, *(behind[n] for n in named if n in behind))

    return dataclasses.replace(
        signature,
        covers=both(signature.covers),
        lifted_by=both(signature.lifted_by),
        hides=lambda score: both(signature.hides(score)),
        before=lambda score: both(signature.before(score)),
        found_in=both(signature.found_in),
    )


def contains(general: str, special: str) -> bool:
    """Whether `general` is `special` or contains it as a special case, in any number of steps."""
    return general == special or any(contains(general, outer) for outer in VOCABULARY[special].within)
