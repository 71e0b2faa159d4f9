"""Statistics of recordings that several signatures ask for: computed once."""

from __future__ import annotations

import weakref
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from functools import wraps
from typing import Any, Generic, Protocol, TypeVar

_MOST = 64
"""Recordings whose results are kept."""
Result = TypeVar("Result")


class Numbered(Protocol):
    """A recording by its number, and how many frames were before those that it has: fields."""

    @property
    def number(self) -> int: ...

    @property
    def before(self) -> int: ...


Field = TypeVar("Field", bound=Numbered)


class Kept(Generic[Result]):
    """Results that hold as long as the arrays that they were made of are the same objects: nothing changes an
    array in place. The arrays are not kept alive for it. most: how many results are kept."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._kept: OrderedDict[tuple[Any, ...], tuple[tuple[Any, ...], Result]] = OrderedDict()

    def of(self, arrays: Sequence[Any], more: Hashable, make: Callable[[], Result]) -> Result:
        """The result of these arrays (None: none) and of what else it needs, made where none is known."""
        key = (more, *(id(a) for a in arrays))
        found = self._kept.get(key)
        # An array that is gone may have left its address to another.
        if found and all(ref() is a for ref, a in zip(found[0], arrays, strict=True)):
            return found[1]
        result = make()
        self._kept[key] = tuple(_reference(a) for a in arrays), result
        for old, (references, _) in list(self._kept.items()):
            if len(self._kept) > self._most or any(_gone(r) for r in references):
                self._kept.pop(old, None)
        return result


def remembered(*reads: str) -> Callable[[Callable[[Field], Result]], Callable[[Field], Result]]:
    """A function of a field whose result is kept as long as the arrays that it `reads` are the same ones."""

    def wrap(function: Callable[[Field], Result]) -> Callable[[Field], Result]:
        kept = Kept[Result](_MOST)

        @wraps(function)
        def call(field: Field) -> Result:
            arrays = [getattr(field, name) for name in reads]
            return kept.of(arrays, (field.number, field.before), lambda: function(field))

        return call

    return wrap


def _gone(reference: Callable[[], Any]) -> bool:
    return isinstance(reference, weakref.ref) and reference() is None


def _reference(value: Any) -> Callable[[], Any]:
    return (lambda: None) if value is None else weakref.ref(value)
