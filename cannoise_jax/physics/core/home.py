"""Where the mechanisms of the package are: they are built from the core, which is told and imports none."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cannoise_jax.physics.core.mechanism import Mechanism

_TOLD: list[Callable[[], Mapping[str, Mechanism]]] = []
"""One function: the package says it as it is imported, before any of its modules can be asked."""


def tell(records: Callable[[], Mapping[str, Mechanism]]) -> None:
    """Says how the records are had, by id, in the order of the signal chain; called on first use."""
    _TOLD[:] = [records]


def records() -> Mapping[str, Mechanism]:
    """The records that were told."""
    return _TOLD[0]()
