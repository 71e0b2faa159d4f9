"""Names of a package that are imported on first use, so that importing it does not wait for JAX."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any


def on_first_use(package: str, homes: Mapping[str, str], name: str) -> Any:
    """The value of `name` from its home, a module below `package`. Raises AttributeError for other names."""
    if name not in homes:
        raise AttributeError(f"module {package!r} has no attribute {name!r}")
    return getattr(import_module(f"{package}.{homes[name]}"), name)
