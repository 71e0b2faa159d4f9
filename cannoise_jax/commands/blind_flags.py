"""What the flags of bin/blind may say."""

from __future__ import annotations

import argparse

from cannoise_jax.blind.compose import PARTS, SHARES


def seeds_of(text: str) -> tuple[int, ...]:
    """Numbers from 0, as 1,2."""
    try:
        values = tuple(int(part) for part in text.split(","))
    except ValueError:
        values = ()
    if not values or min(values) < 0:
        raise argparse.ArgumentTypeError(f"{text!r}: give whole numbers, as 1,2")
    return values


def shard_of(text: str) -> tuple[int, int]:
    """Part i of n, as 1/2."""
    try:
        number, total = (int(part) for part in text.split("/"))
    except ValueError:
        number, total = 0, 0
    if not 1 <= number <= total:
        raise argparse.ArgumentTypeError(f"{text!r}: give i/n, such as 1/2")
    return number, total


def kinds_of(text: str) -> tuple[str, ...]:
    """Kinds of sets to seal."""
    kinds = tuple(part for part in text.split(",") if part)
    for kind in kinds:
        if kind not in SHARES:
            raise argparse.ArgumentTypeError(f"{kind!r}: give some of {', '.join(SHARES)}")
    return kinds


def parts_of(text: str) -> tuple[str, ...]:
    """Parts of a trial on real recordings."""
    parts = tuple(part for part in text.split(",") if part)
    if not parts or any(part not in PARTS for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}: give some of {', '.join(PARTS)}")
    return parts


def size_of(text: str) -> tuple[int, int]:
    """Height and width of a crop, pixels."""
    try:
        height, width = (int(part) for part in text.split("x"))
    except ValueError:
        height = width = 0
    if height < 64 or width < 64 or height % 2 or width % 2:
        raise argparse.ArgumentTypeError(f"{text!r}: give HxW, even numbers from 64, such as 192x256")
    return height, width
