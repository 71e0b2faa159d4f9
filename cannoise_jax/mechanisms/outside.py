"""What a user's own module holds: mechanisms, and simulators."""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cannoise_jax.mechanisms.checked import check_entry
from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.foreign import of_interrupt, of_memory
from cannoise_jax.recordings.recording import BadInput


def imported(place: str) -> Any:
    """The value at "module:NAME" or "file.py:NAME". Importing the module runs its code.

    Raises BadInput with one line where there is none, or the module fails.
    """
    where, _, name = place.rpartition(":")
    if not where or not name:
        raise BadInput(f"{place!r}: names nothing: write MODULE:NAME or FILE.py:NAME, as my_camera:ENTRIES")
    try:
        if where.endswith(".py"):
            spec = importlib.util.spec_from_file_location(Path(where).stem, where)
            if spec is None or spec.loader is None:
                raise ImportError(f"no module in {where}")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        else:
            if "" not in sys.path:  # an installed command does not look where it is started
                sys.path.insert(0, "")
            module = importlib.import_module(where)
    except Exception as error:  # whatever the user's code raises
        if of_interrupt(error):
            raise
        words = f"{type(error).__name__}: {error}"
        start = f": start where {where}.py is" if isinstance(error, ModuleNotFoundError) else ""
        raise BadInput(f"{place}: cannot be imported ({words}){start}") from error
    if not hasattr(module, name):
        raise BadInput(f"{place}: {where} has no {name}: give the name that it has there")
    return getattr(module, name)


def function_at(place: str) -> Callable[..., Any]:
    """The function at "module:NAME", a simulator. Raises BadInput with one line where there is none; what it
    returns does so where its code fails."""
    found = imported(place)
    if not callable(found):
        raise BadInput(f"{place}: is no function of key, clean mosaic and settings: see docs/python.md")

    @functools.wraps(found)
    def called(*given: Any) -> Any:
        try:
            return found(*given)
        except Exception as error:  # whatever the user's code raises
            if of_interrupt(error) or of_memory(error):
                raise
            words = " ".join(f"{type(error).__name__}: {error}".split())
            raise BadInput(
                f"{place}: fails ({words[:300]}): it is called with key, clean, settings"
            ) from error

    return called


def entries_at(place: str) -> tuple[Entry, ...]:
    """The entries of "module:NAME": one entry, or several in a row.

    Raises BadInput with one line for a place without entries, and for what `check_entry` refuses.
    """
    found = imported(place)
    entries = (found,) if isinstance(found, Entry) else found
    if not isinstance(entries, list | tuple) or not all(isinstance(e, Entry) for e in entries):
        raise BadInput(f"{place}: is no entry, nor a tuple of entries: see docs/adding_a_mechanism.md")
    for entry in entries:
        try:
            check_entry(entry)
        except (ValueError, TypeError) as error:
            raise BadInput(f"{error}") from error
    return tuple(entries)


def entries_of(places: Sequence[str]) -> tuple[Entry, ...]:
    """The entries of several places, see `entries_at`."""
    return tuple(entry for place in places for entry in entries_at(place))
