"""A signature of what has neither a closed form nor a law for new codes: its own statistic tells all."""

from __future__ import annotations

from collections.abc import Callable

from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.handed import Addition, Found
from cannoise_jax.signatures.score import Score
from cannoise_jax.signatures.signature import (
    BY_SHIFT,
    NO_CLOSED_FORM,
    NO_LAW,
    NO_PATTERN,
    NO_PLACE,
    NOT_SIMULATED,
    Signature,
)


def plain(**fields) -> Signature:
    """A signature by its name, place, what it reads, score, absorb and what it covers; what is not said of it
    is said by a constant."""
    constants = {
        "mechanism": None,
        "predict": NO_LAW,
        "pattern": NO_PATTERN,
        "simulate": NOT_SIMULATED,
        "place": NO_PLACE,
        "detectable": BY_SHIFT,
        "least": NO_CLOSED_FORM,
    }
    return Signature(**{**constants, **fields})  # type: ignore[arg-type]


def carried(
    values: Callable[[Score], dict[str, float]], map_name: str | None = None
) -> Callable[[Found], Addition]:
    """Adds the mechanism with these parameters of the score, and the pattern as its map where it has one."""

    def simulate(found: Found) -> Addition:
        maps = {}
        if map_name is not None and found.pattern is not None:
            maps = {map_name: as_map(found.pattern)}
        return Addition(values(found.score), maps)

    return simulate
