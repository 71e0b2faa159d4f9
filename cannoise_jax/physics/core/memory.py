"""Whether frames fit into memory: XLA ends the interpreter where they do not, without an exception."""

from __future__ import annotations

import math

import jax

_BYTES = 12
"""That a drawn value takes at least on the way: two copies in float32, its code, and its random bits."""


def check_room(frames: int, size: tuple[int, ...]) -> None:
    """Raises ValueError where so many frames of a size cannot be held at once."""
    needed, free = _BYTES * frames * math.prod(size), free_bytes()
    if free is not None and needed > free:
        fit = int(free // (2 * _BYTES * math.prod(size)))
        raise ValueError(
            f"{frames} frames of {' x '.join(map(str, size))} take {needed / 1e9:.3g} GB and more, of "
            f"{free / 1e9:.3g} GB that are free: draw them in parts"
            + (f", of {fit} at most, with a key each" if fit else "")
        )


def free_bytes() -> int | None:
    """Free memory of the device that draws; None where it is not known."""
    stats = jax.devices()[0].memory_stats()
    if stats and "bytes_limit" in stats:
        return int(stats["bytes_limit"]) - int(stats.get("bytes_in_use", 0))
    if jax.default_backend() != "cpu":
        return None
    try:
        with open("/proc/meminfo", encoding="ascii") as lines:
            found = dict(line.split(":", 1) for line in lines)
        return 1024 * int(found["MemAvailable"].split()[0])
    except (OSError, KeyError, ValueError, IndexError):
        return None
