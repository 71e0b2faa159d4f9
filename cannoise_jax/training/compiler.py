"""XLA's options of a config, as far as the XLA at hand knows them."""

from __future__ import annotations

import logging
from functools import lru_cache
from typing import Any

import jax
from ml_collections import ConfigDict, FrozenConfigDict

_log = logging.getLogger(__name__)


def compiler_options(config: ConfigDict | FrozenConfigDict) -> dict[str, Any] | None:
    """`config.compiler` as `jax.jit` takes it; None where it is empty.

    Options come and go with XLA's versions and change no result but its last bits: one that is unknown here
    is left out, with a warning. A value that an option cannot have is left to `jax.jit` to refuse.
    """
    return {name: value for name, value in dict(config.compiler).items() if _is_known(name)} or None


@lru_cache
def _is_known(name: str) -> bool:
    try:
        jax.jit(lambda x: x, compiler_options={name: ""}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" in str(error):
            _log.warning("config.compiler: this XLA has no option %s: left out", name)
            return False
    return True
