"""What the names of mechanisms mean: the records of the package, found by id."""

from __future__ import annotations

import functools
from collections.abc import Mapping

from cannoise_jax.physics.core.grammar import TIMES
from cannoise_jax.physics.core.home import records
from cannoise_jax.physics.core.mechanism import ACTS_ON, STAGES, Mechanism
from cannoise_jax.physics.core.places import SITES


@functools.cache
def packaged() -> Mapping[str, Mechanism]:
    """The mechanisms of the package by id, in the order of the signal chain."""
    return records()


def mechanism(id: str) -> Mechanism:
    """The mechanism of a name. Raises ValueError for one that the package does not have."""
    found = packaged().get(id)
    if found is None:
        raise ValueError(f"{id:.80}: it is no mechanism of the package; known: {', '.join(packaged())}")
    return found


RESERVED = frozenset({"scaling", "maps", "point", "again"})
"""What `SensorModel.with_mechanism` takes beside parameters."""


def check_record(record: Mechanism) -> None:
    """Raises ValueError for a mechanism from outside that has the name of one of the package, draws nothing,
    or has no strength or place."""
    if packaged().get(record.id, record) is not record:
        raise ValueError(f"{record.id}: the package has a mechanism of this name: choose another")
    if record.id in packaged():
        return
    if record.sample is None and record.baseline is None:
        raise ValueError(f"{record.id}: draws nothing: give its record a `sample`")
    names = [p.name for p in record.parameters]
    if not names or (record.scales or names[0]) not in names:
        raise ValueError(f"{record.id}: has no strength: `scales` names one of its parameters ({names})")
    if taken := sorted(RESERVED.intersection(names)):
        raise ValueError(f"{record.id}: a parameter cannot be named {taken[0]}: choose another name")
    choices = {"stage": STAGES, "acts_on": ACTS_ON, "over": SITES, "time": TIMES}
    for axis, known in choices.items():
        value = getattr(record.point, axis, None)
        if value not in known:
            raise ValueError(f"{record.id}: {axis} is {value!r}: one of {', '.join(known)}")


def chain_position(record: Mechanism) -> tuple[int, int, int]:
    """Sort key along the chain: what it acts on, its stage, then the order above; mechanisms of no name, and
    those from outside, come last of their stage."""
    ids = list(packaged())
    order = ids.index(record.id) if record.id in ids else len(ids)
    return ACTS_ON.index(record.acts_on), STAGES.index(record.stage), order
