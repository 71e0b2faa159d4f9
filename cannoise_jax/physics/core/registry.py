"""All mechanisms by id, in the order of the signal chain."""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections.abc import Callable
from typing import Any

from cannoise_jax.mechanisms import (
    capture,
    converter,
    dark_charge,
    digital,
    noise_steps,
    photons,
    pixel,
    readout,
    transport,
)
from cannoise_jax.physics.core.mechanism import STAGES, Mechanism
from cannoise_jax.vocabulary import VOCABULARY

_CHAIN: tuple[Mechanism, ...] = (
    *capture.MECHANISMS,
    *photons.MECHANISMS,
    *dark_charge.MECHANISMS,
    *noise_steps.MECHANISMS,
    pixel.COSMIC_RAYS,  # their charge is there before any moves
    *transport.MECHANISMS,
    *pixel.MECHANISMS,
    *readout.MECHANISMS,
    *converter.MECHANISMS,
    *digital.MECHANISMS,
    capture.BOOKKEEPING,  # the description is laid over whatever came out
)


def _mutual(records: tuple[Mechanism, ...]) -> dict[str, Mechanism]:
    """By id; what one record says it is confused with is said of the other as well, after its own list."""
    return {
        m.id: dataclasses.replace(
            m,
            confused_with=(
                *m.confused_with,
                *(o.id for o in records if m.id in o.confused_with and o.id not in m.confused_with),
            ),
        )
        for m in records
    }


MECHANISMS: dict[str, Mechanism] = _mutual(_CHAIN)

_ACTS_ON = ("mean", "charge", "signal", "code")


def mechanism(id: str) -> Mechanism:
    """The functions of a mechanism. Raises ValueError for an id that has none."""
    found = MECHANISMS.get(id)
    if found is None:
        near = "the vocabulary lists it, but it has no sampler" if id in VOCABULARY else "it is no mechanism"
        raise ValueError(f"{id}: {near}; known: {', '.join(MECHANISMS)}")
    return found


def chain_position(id: str, record: Mechanism) -> tuple[int, int, int]:
    """Sort key along the chain: what it acts on, its stage, then the order above; mechanisms without a name
    come last of their stage."""
    ids = list(MECHANISMS)
    order = ids.index(id) if id in MECHANISMS else len(ids)
    return _ACTS_ON.index(record.acts_on), STAGES.index(record.stage), order


@functools.cache
def _estimators() -> dict[str, Callable[..., Any]]:
    # Looked up late: estimators may themselves build models from the mechanisms above.
    return dict(importlib.import_module("cannoise_jax.physics.transfer.estimators").ESTIMATORS)


def estimator(id: str) -> Callable[..., Any] | None:
    """The function that estimates a mechanism's parameters from suitable recordings, with standard errors, as
    `estimators.ESTIMATORS` lists it; None where it has none of its own."""
    return _estimators().get(id)
