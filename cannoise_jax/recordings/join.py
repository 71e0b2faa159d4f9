"""Several recordings of one camera at one setting as one, without reading them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from cannoise_jax.recordings.lazy import LazyArray, read_stack
from cannoise_jax.recordings.metadata import FIELDS
from cannoise_jax.recordings.recording import BadInput, Recording, name_of

# What may drift from file to file while the setting stays the same.
ALIKE_KELVIN = 2.5
"""Temperatures are one where the coldest and the warmest are this near."""
_DRIFTING = ("temperature_c", "egain", "em_gain")


def join_recordings(recordings: Sequence[Recording]) -> Recording:
    """One recording with the frames of all, in the order given, still to be read when indexed.

    The temperature is the mean where all state one. Raises BadInput when sizes or settings differ, or when
    only some have a reference.
    """
    first, *others = recordings
    _check_temperatures(recordings)
    for number, other in enumerate(others, start=1):
        _check_alike(first, other, (name_of(first, 0), name_of(other, number)))
    if not others:
        return first
    frames = _join([r.frames for r in recordings])
    clean: Any = None if first.clean is None else _join([_one_a_frame(r) for r in recordings])
    temperatures = [r.temperature_c for r in recordings]
    known = [t for t in temperatures if t is not None]
    return dataclasses.replace(
        first,
        frames=frames,
        clean=clean,
        egain=first.egain if {r.egain for r in recordings} == {first.egain} else None,
        em_gain=first.em_gain if {r.em_gain for r in recordings} == {first.em_gain} else None,
        temperature_c=float(np.mean(known)) if len(known) == len(recordings) else None,
    )


def _check_alike(first: Recording, other: Recording, names: tuple[str, str]) -> None:
    if first.size != other.size:
        sizes = ["{} x {}".format(*r.size) for r in (first, other)]
        raise BadInput(f"{names[1]}: {sizes[1]} pixels, {names[0]} has {sizes[0]}: one size a recording")
    for name in FIELDS:
        values = getattr(first, name), getattr(other, name)
        if values[0] != values[1] and name not in _DRIFTING:
            advice = f", or set --{name}" if name in ("camera", "kind", "iso") else ""
            raise BadInput(
                f"{names[1]}: {name} is {values[1]}, {names[0]}: {values[0]}: join equal settings{advice}"
            )
    if (first.clean is None) != (other.clean is None):
        without = names[0] if first.clean is None else names[1]
        raise BadInput(f"{without}: holds no reference, the other recordings do")


def _check_temperatures(recordings: Sequence[Recording]) -> None:
    known = sorted(
        (r.temperature_c, name_of(r, number))
        for number, r in enumerate(recordings)
        if r.temperature_c is not None
    )
    if not known:
        return
    (cold, first), (warm, other) = known[0], known[-1]
    if warm - cold > ALIKE_KELVIN:
        raise BadInput(
            f"{other}: {warm:.1f} C, {first}: {cold:.1f} C: join equal settings, or set --temperature"
        )


def _one_a_frame(recording: Recording) -> Any:
    clean = recording.clean
    assert clean is not None
    return clean if clean.ndim == 3 else np.broadcast_to(clean, (recording.count, *clean.shape))


def _join(parts: Sequence[Any]) -> LazyArray:
    starts = np.cumsum([0, *(len(p) for p in parts)])
    shape = (int(starts[-1]), *parts[0].shape[1:])
    read_one = partial(_read_one, tuple(parts), tuple(starts.tolist()))
    return LazyArray(partial(read_stack, read_one, shape), shape, np.dtype(parts[0].dtype))


def _read_one(parts: tuple[Any, ...], starts: tuple[int, ...], number: int) -> np.ndarray:
    which = int(np.searchsorted(starts, number, side="right")) - 1
    return np.asarray(parts[which][number - starts[which]])
