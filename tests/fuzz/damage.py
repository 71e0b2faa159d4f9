"""Ways in which files go wrong. Each takes a generator and content, and returns other content."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

ODD_NUMBERS = (
    *(-1, 0, 1, 2, 3, -3, 0.5, 255, 65535, 65536, 2**31 - 1, 2**31, 2**63, -(2**63), 10**400),
    *(1e30, -1e30, 1e308, -1e308, 1e-308, 5e-324, -400, float("nan"), float("inf"), -float("inf")),
)
ODD_VALUES = (
    *(None, True, False, "", "a", "RGGB\0", "XYZW", "\ud83d\ude00", "../../x", "1e5", "nan", "a" * 5000),
    *([], [[]], [None], {}, {"a": 1}, [1, 2, 3], [[1, 2], [3, 4]], [1] * 1000, *ODD_NUMBERS),
)


def damaged_bytes(rng: random.Random, content: bytes) -> tuple[bytes, str]:
    """Bits flipped, a part lost, doubled, zeroed, filled or moved; cut short; extended; emptied. And how."""
    data = bytearray(content)
    size = len(data)
    kind = rng.choice(
        ("flip", "flip", "head", "cut", "zero", "fill", "lose", "double", "swap", "more", "none")
    )
    start = rng.randrange(size) if size else 0
    span = min(size - start, rng.choice((1, 2, 4, 8, 64, 512)))
    if kind == "flip":
        for _ in range(rng.choice((1, 5, 50))):
            data[rng.randrange(size)] ^= 1 << rng.randrange(8)
    elif kind == "head":  # where formats keep their counts and offsets
        for _ in range(rng.choice((1, 3))):
            data[rng.randrange(min(size, 512))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF))
    elif kind == "cut":
        del data[start:]
    elif kind == "zero":
        data[start : start + span] = bytes(span)
    elif kind == "fill":
        data[start : start + span] = b"\xff" * span
    elif kind == "lose":
        del data[start : start + span]
    elif kind == "double":
        data[start:start] = data[start : start + span]
    elif kind == "swap":
        other = rng.randrange(size)
        data[start : start + span], data[other : other + span] = (
            data[other : other + span],
            data[start : start + span],
        )
    elif kind == "more":
        data += rng.randbytes(rng.choice((1, 100, 10_000)))
    else:
        data = bytearray()
    return bytes(data), kind


def damaged_json(rng: random.Random, text: str) -> str:
    """A value replaced, removed, renamed or nested too deep somewhere; or its bytes damaged."""
    kind = rng.choice(("value", "value", "value", "remove", "rename", "deep", "type", "bytes"))
    if kind == "bytes":
        return damaged_bytes(rng, text.encode())[0].decode(errors="replace")
    if kind == "deep":
        return "[" * 20_000
    document = json.loads(text)
    if kind == "type":
        return json.dumps(rng.choice(ODD_VALUES))
    document = copy.deepcopy(document)
    parent, key = rng.choice(list(places(document)))
    if kind == "remove":
        del parent[key]
    elif kind == "rename" and isinstance(parent, dict):
        parent[rng.choice(("", "x", key.upper(), key + " "))] = parent.pop(key)
    else:
        parent[key] = rng.choice(ODD_VALUES)
    return json.dumps(document)


def places(node: Any):
    """Every container with a key into it."""
    entries = list(node.items()) if isinstance(node, dict) else list(enumerate(node))
    for key, value in entries:
        yield node, key
        if isinstance(value, (dict, list)) and value:
            yield from places(value)
