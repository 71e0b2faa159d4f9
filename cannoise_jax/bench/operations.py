"""How many arithmetic operations a function's matrix products and convolutions need, whatever runs them.

Counted off the program as it is traced, before any compiler: 2 for each multiplication with its addition.
Zeros that a convolution puts between its inputs (`lhs_dilation`, as gradients of strided convolutions and
transposed ones have them) need no work and do not count; those at the edges do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import jax


def operations(function: Callable[..., Any], *arguments: Any) -> float:
    """Of one call with arrays, or shapes, like these."""
    return _of_program(jax.make_jaxpr(function)(*arguments).jaxpr)


def _of_program(program: Any) -> float:
    return sum(_of_equation(equation) for equation in program.eqns)


def _of_equation(equation: Any) -> float:
    name, parameters = equation.primitive.name, equation.params
    made = math.prod(equation.outvars[0].aval.shape) if equation.outvars else 0
    if name == "dot_general":
        (contracted, _), _ = parameters["dimension_numbers"]
        shape = equation.invars[0].aval.shape
        return 2.0 * made * math.prod(shape[axis] for axis in contracted)
    if name == "conv_general_dilated":
        kernel = equation.invars[1].aval.shape
        outputs = kernel[parameters["dimension_numbers"].rhs_spec[0]]
        return 2.0 * made * math.prod(kernel) / outputs / math.prod(parameters["lhs_dilation"])
    times = parameters.get("length", 1) if name == "scan" else 1
    return times * sum(_of_program(inner) for inner in _inner(parameters))


def _inner(parameters: dict[str, Any]) -> list[Any]:
    """The programs that an equation calls; of the branches of a condition all."""
    found = []
    for value in parameters.values():
        for one in value if isinstance(value, tuple | list) else (value,):
            program = getattr(one, "jaxpr", one)
            if hasattr(program, "eqns"):
                found.append(program)
    return found
