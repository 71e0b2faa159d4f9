"""Mechanisms from outside the package: entries that a module of the user's holds."""

from __future__ import annotations

import importlib

from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.recordings.recording import BadInput


def entries_at(place: str) -> tuple[Entry, ...]:
    """The entries of "module:NAME": one entry, or several in a row. Importing the module runs its code.

    Raises BadInput with one line for a place without entries.
    """
    module, _, name = place.partition(":")
    if not module or not name:
        raise BadInput(f"{place!r}: names no entries: write MODULE:NAME, as my_camera:ENTRIES")
    try:
        found = getattr(importlib.import_module(module), name)
    except ImportError as error:
        raise BadInput(f"{place}: cannot be imported ({error}): start where {module}.py is") from error
    except AttributeError as error:
        raise BadInput(f"{place}: {module} has no {name}: name what it calls its entries") from error
    entries = (found,) if isinstance(found, Entry) else found
    if not isinstance(entries, list | tuple) or not all(isinstance(e, Entry) for e in entries):
        raise BadInput(f"{place}: is no entry, nor a tuple of entries: see docs/adding_a_mechanism.md")
    return tuple(entries)
