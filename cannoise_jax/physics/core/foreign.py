"""Functions of a user's mechanism, called so that what they raise is one line with its name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from cannoise_jax.recordings.recording import BadInput

_LONGEST = 300
"""Characters of a message of the user's code that a line shows; JAX writes pages."""
_UNKNOWN_YET = ("Concretization", "Tracer", "NonConcrete")
"""How the names of the errors begin that JAX raises where a value is needed that is not there under jit."""


def called(id: str, what: str, function: Callable[..., Any], *given: Any, **named: Any) -> Any:
    """What a function of a mechanism from outside the package returns. id: of the mechanism; what: the
    function is of it, in words.

    Raises BadInput in one line for whatever the function raises, but for interrupts and want of memory, which
    are not its own."""
    try:
        return function(*given, **named)
    except Exception as error:  # whatever the user's code raises
        if of_interrupt(error) or of_memory(error):
            raise
        if isinstance(error, BadInput) and str(error).startswith(f"{id}: "):
            raise  # a function of it that was called within this one
        if type(error).__name__.startswith(_UNKNOWN_YET):
            raise BadInput(
                f"{id}: its {what} takes values as numbers that are not known yet under jit, as NumPy does: "
                "write it in jax.numpy"
            ) from error
        words = " ".join(f"{type(error).__name__}: {error}".split())
        raise BadInput(f"{id}: its {what} fails ({words[:_LONGEST]}): mend it") from error


def of_another_type(id: str, what: str, returned: Any, wanted: str) -> BadInput:
    """Says that a function of a mechanism returned something else than what is `wanted`, in words."""
    return BadInput(f"{id}: its {what} returns a value of type {type(returned).__name__}: return {wanted}")


def of_interrupt(error: BaseException | None) -> bool:
    """Whether an error is Ctrl-C, or what somebody made of it: Python itself has RuntimeError for one that
    comes in `__set_name__`, as in a late import."""
    seen: set[int] = set()
    while error is not None and id(error) not in seen:
        if isinstance(error, KeyboardInterrupt):
            return True
        seen.add(id(error))
        error = error.__cause__ or error.__context__
    return False


def of_memory(error: BaseException) -> bool:
    """Whether NumPy or JAX lacks memory."""
    return isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)[:200]
