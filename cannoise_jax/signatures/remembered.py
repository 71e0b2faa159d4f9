"""Statistics of one recording that several signatures ask for: computed once."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from cannoise_jax.signatures.fields import Fields

_MOST = 64
"""Recordings whose results are kept."""
Result = TypeVar("Result")


def remembered(*reads: str) -> Callable[[Callable[[Fields], Result]], Callable[[Fields], Result]]:
    """A function of a field whose result is kept as long as the arrays that it `reads` are the same objects:
    nothing changes an array in place. They are not kept alive for it."""

    def wrap(function: Callable[[Fields], Result]) -> Callable[[Fields], Result]:
        kept: OrderedDict[tuple[int, ...], tuple[tuple[Any, ...], Result]] = OrderedDict()

        @wraps(function)
        def call(field: Fields) -> Result:
            arrays = [getattr(field, name) for name in reads]
            key = (field.number, field.before, *(id(a) for a in arrays))
            found = kept.get(key)
            # An array that is gone may have left its address to another.
            if found and all(ref() is a for ref, a in zip(found[0], arrays, strict=True)):
                return found[1]
            result = function(field)
            kept[key] = tuple(_reference(a) for a in arrays), result
            for old, (references, _) in list(kept.items()):
                if len(kept) > _MOST or any(_gone(r) for r in references):
                    kept.pop(old, None)
            return result

        return call

    return wrap


def _gone(reference: Callable[[], Any]) -> bool:
    return isinstance(reference, weakref.ref) and reference() is None


def _reference(value: Any) -> Callable[[], Any]:
    return (lambda: None) if value is None else weakref.ref(value)
