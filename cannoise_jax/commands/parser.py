"""What the commands share in reading their flags: refusal in one line, and levels per channel."""

from __future__ import annotations

import argparse
from typing import NoReturn


class OneLineParser(argparse.ArgumentParser):
    """Refuses flags in one line on stderr, `bin/NAME: message (see --help)`, with exit status 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {' '.join(message.split())} (see --help)\n")


def numbers(text: str) -> tuple[float, ...]:
    """One value, or four in mosaic order as a,b,c,d. Raises argparse.ArgumentTypeError for anything else."""
    try:
        values = tuple(float(part) for part in text.split(","))
    except ValueError:
        values = ()
    if len(values) not in (1, 4):
        raise argparse.ArgumentTypeError(f"{text!r}: give one value, or four as a,b,c,d in mosaic order")
    return values


def count(text: str) -> int:
    """A whole number from 1. Raises argparse.ArgumentTypeError for anything else."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text!r}: give a whole number, 1 or more")
    return value
