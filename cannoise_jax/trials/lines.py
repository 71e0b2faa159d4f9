"""Results of a long run, a line of JSON each, in a file that the next run goes on with.

The first line says of what they are; the last may be cut off.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from cannoise_jax.recordings.recording import BadInput


def read(path: Path, asked: dict[str, Any], other: str) -> list[dict[str, Any]]:
    """The results of one file. Raises BadInput, which says `other`, for those of anything else than asked."""
    head, *lines = path.read_text(encoding="utf-8").split("\n")
    try:
        settings = json.loads(head)
    except json.JSONDecodeError:
        settings = None
    if head and settings != asked:
        raise BadInput(f"{path}: {other}")
    return [json.loads(line) for line in lines if line.endswith("}")]


@contextlib.contextmanager
def adding(path: Path, asked: dict[str, Any]) -> Iterator[Callable[[dict[str, Any]], None]]:
    """A function that adds a result to the file, which is made where there is none."""
    with open(path, "a", encoding="utf-8") as file:
        if not path.stat().st_size:
            file.write(json.dumps(asked) + "\n")
        elif not path.read_text(encoding="utf-8").endswith("\n"):
            file.write("\n")  # a line that was cut off

        def add(result: dict[str, Any]) -> None:
            file.write(json.dumps(result) + "\n")
            file.flush()

        yield add
