"""Entries from outside the package, held to what an entry must be before anything is measured."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cannoise_jax.mechanisms.entry import Entry
from cannoise_jax.physics.core.foreign import called, of_another_type
from cannoise_jax.physics.core.grammar import Point
from cannoise_jax.physics.core.mechanism import Mechanism, Parameter, Scaling
from cannoise_jax.physics.core.ranges import check_point
from cannoise_jax.physics.core.registry import check_record
from cannoise_jax.physics.core.sensor import SensorModel
from cannoise_jax.physics.core.settings import DEFAULT, context_of
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable
from cannoise_jax.physics.transfer.estimator import Estimator
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.signatures.added import as_map
from cannoise_jax.signatures.sampled import strength_of
from cannoise_jax.vocabulary import UNKNOWN, Term

_OF_RECORD = ("sample", "baseline", "draw_maps", "effect", "amplitude")
_FRAMES = 2
"""Frames that a sampler is traced with: more than one, as recordings have."""


def check_entry(entry: Entry) -> None:
    """What can be told of an entry from outside without a call of its functions.

    Raises ValueError or TypeError in one line that names it: for a name that is no word or that findings
    without a name have, a missing home, axes that do not go together, and fields of another type."""
    id, record = entry.id, entry.record
    if not isinstance(entry.term, Term) or not isinstance(record, Mechanism):
        raise TypeError(f"{id!r:.80}: an entry is of a Term and a Mechanism, see docs/adding_a_mechanism.md")
    if not isinstance(id, str) or not id.isidentifier():
        raise ValueError(f"{id!r:.80}: is no name of a mechanism: letters, digits and _, as in row_offset")
    if id == UNKNOWN.id or id.startswith(f"{UNKNOWN.id}_"):
        raise ValueError(f"{id:.80}: findings without a name are called so: choose another")
    if not all(isinstance(p, Parameter) for p in record.parameters):
        raise TypeError(f"{id}: its parameters are {record.parameters!r:.80}: give a tuple of Parameter")
    if not isinstance(record.scaling, Scaling):
        raise TypeError(f"{id}: its scaling is of type {type(record.scaling).__name__}: give a Scaling")
    check_record(record)
    if not isinstance(record.point, Point):
        raise TypeError(f"{id}: its point is of type {type(record.point).__name__}: give a grammar.Point")
    check_point(id, record.point)
    if not isinstance(record.home, str) or not record.home.strip():
        raise ValueError(
            f"{id}: its record has no `home`: say where its entry is, as in home='my_camera:ENTRY', for "
            "stored models to say it"
        )
    if not isinstance(entry.needs, str) or not entry.needs.strip():
        raise ValueError(f"{id}: `needs` is {entry.needs!r:.80}: say what to record to see it")
    of_entry = {"signatures": entry.signatures, "pattern": entry.pattern}
    for name, function in {**{n: getattr(record, n) for n in _OF_RECORD}, **of_entry}.items():
        absent = function is None and name not in ("amplitude", "signatures")
        if not absent and not callable(function):
            raise TypeError(f"{id}: its `{name}` is of type {type(function).__name__}: give a function")
    if entry.estimator is not None and not isinstance(entry.estimator, Estimator):
        kind = type(entry.estimator).__name__
        raise TypeError(f"{id}: its `estimator` is of type {kind}: give an Estimator(measure=...)")


def check_draws(entries: Iterable[Entry], size: tuple[int, int]) -> None:
    """Calls the functions of entries from outside once, for frames of [H, W], the sampler as under jit.

    Raises BadInput in one line that names the entry for whatever they raise or return that is of no use, and
    for typical values out of its ranges."""
    for entry in entries:
        id, record = entry.id, entry.record
        strength = strength_of(record)
        values: dict[str, Any] = {**record.defaults()}
        # One that is off by default is tried where it is on.
        values[strength.name] = values[strength.name] or min(strength.high, 1.0)
        model = _with(entry, values)
        settings = dataclasses.replace(DEFAULT, frames=_FRAMES)
        frames = jax.ShapeDtypeStruct(size, jnp.float32)
        jax.eval_shape(
            lambda key, clean, m=model, s=settings: m.sample(key, clean, s), jax.random.key(0), frames
        )
        jax.eval_shape(lambda clean, m=model, s=settings: m.expected(clean, s), frames)
        context = context_of(model, jnp.full((1, *size), 0.1, jnp.float32), settings)

        def quoted(v, context, record=record) -> float:
            return float(np.mean(np.asarray(record.amplitude(v, context), np.float64)))

        if not np.isfinite(amount := called(id, "`amplitude`", quoted, values, context)):
            raise BadInput(f"{id}: its `amplitude` is {amount} at its typical values: mend it")
        if pattern := maps_of(entry):
            _with(entry, values, pattern(np.ones(size), values))


def _with(entry: Entry, values: Mapping[str, Any], maps: dict[str, Any] | None = None) -> SensorModel:
    """A camera with the mechanism. Raises BadInput for values and maps that it does not have."""
    camera = SensorModel.poisson_gaussian(1.0, 2.0, 64.0, 4095.0)
    try:
        return camera.with_mechanism(entry.record, maps=maps, **values)
    except (ValueError, TypeError) as error:
        raise BadInput(f"{error}") from error


def maps_of(entry: Entry) -> Callable[..., dict[str, Any]] | None:
    """The `pattern` of an entry from outside, which raises BadInput in one line; None where it has none."""
    function = entry.pattern
    if function is None:
        return None

    def pattern(recorded, values) -> dict[str, Any]:
        maps = called(entry.id, "`pattern`", function, recorded, values)
        if not isinstance(maps, Mapping):
            raise of_another_type(entry.id, "`pattern`", maps, "its maps by name")
        return {name: called(entry.id, f"`pattern` ({name})", as_map, m) for name, m in maps.items()}

    return pattern


def measurable(entries: Sequence[Entry]) -> tuple[Entry, ...]:
    """Entries from outside with estimators whose errors are one line. Raises ValueError or TypeError as
    `check_entry`, and where one has no estimator or two have one name."""
    for number, entry in enumerate(entries):
        check_entry(entry)
        if entry.estimator is None:
            raise ValueError(
                f"{entry.id}: has no estimator, so nothing is measured of it: give its entry one, or search "
                "for it with bin/diagnose --mechanisms, which needs none"
            )
        if entry.id in (e.id for e in entries[:number]):
            raise ValueError(f"{entry.id}: is given twice: give it once")
    return tuple(dataclasses.replace(e, estimator=_measuring(e, e.estimator)) for e in entries if e.estimator)


def _measuring(entry: Entry, estimator: Estimator) -> Estimator:
    """The estimator of an entry, whose functions' errors are one line."""
    functions: dict[str, Any] = {
        f.name: _one_line(entry.id, f"estimator's `{f.name}`", getattr(estimator, f.name))
        for f in dataclasses.fields(Estimator)
        if callable(getattr(estimator, f.name)) and f.name != "measure"
    }

    def measure(*given) -> Any:
        found = called(entry.id, "estimator", estimator.measure, *given)
        if not isinstance(found, NotMeasurable):
            _check_estimates(entry, found)
        return found

    return dataclasses.replace(estimator, measure=measure, **functions)


def _one_line(id: str, what: str, function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *given, **named: called(id, what, function, *given, **named)


def _check_estimates(entry: Entry, found: Any) -> None:
    id, known = entry.id, entry.record.defaults()
    if not isinstance(found, Mapping) or not found:
        raise of_another_type(id, "estimator", found, "estimates by parameter, or NotMeasurable")
    for name, estimate in found.items():
        if name not in known:
            raise BadInput(f"{id}: its estimator measures {name!r:.80}: it has {', '.join(known)}")
        if not isinstance(estimate, Estimate):
            raise of_another_type(id, f"estimator ({name})", estimate, "an Estimate")
        if not np.isfinite(estimate.value):
            raise BadInput(f"{id}: its estimator gives {name} = {estimate.value}: give a finite number")
