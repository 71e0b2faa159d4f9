"""What the library that reads FITS files says of broken ones, in words that say what to do."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator
from pathlib import Path

from cannoise_jax.recordings.metadata import reading
from cannoise_jax.recordings.recording import BadInput

_MEANT = (
    (r"Unparsable card \((.+?)\)", "the value of {} in its header cannot be read: mend or remove that card"),
    (r"Keyword '(\S+?)' not found", "its header has no {}: damaged"),
    (r"Illegal keyword name: (.+?)\.?$", "its header has a keyword {}: damaged"),
    (
        r"unrecognized non-standard convention: (.{1,30})",
        "its header has a card that follows no rule ({}): mend or remove it",
    ),
    (r"trailing END|[Mm]issing padding|null bytes", "its header is damaged about its END: copy it again"),
    (r"decompress|compression type", "its compressed image is damaged: copy it again"),
    (r"SIMPLE|Empty or corrupt|matching an HDU", "its header is damaged: copy it again"),
)
"""Patterns of its messages, and what they mean; {} is what the pattern found."""


@contextlib.contextmanager
def reading_fits(path: str | Path, failure: str = "not a readable FITS file") -> Iterator[None]:
    """As `metadata.reading`: whatever goes wrong becomes BadInput in one line."""
    with reading(path, failure):
        try:
            yield
        except (BadInput, MemoryError, UnicodeDecodeError):
            raise
        except Exception as error:
            if isinstance(error, OSError) and error.errno:  # the system's, not the library's
                raise
            raise BadInput(f"{path}: {failure}: {meaning(error)}") from error


def meaning(error: Exception) -> str:
    """One of our own reasons; of what is not known, that the file is damaged, and the library's words."""
    text = " ".join(str(error).split())
    for pattern, words in _MEANT:
        if found := re.search(pattern, text):
            return words.format(*(repr(group.strip().strip("'"))[1:-1] for group in found.groups()))
    if isinstance(error, (TypeError, AttributeError, LookupError, ArithmeticError)):  # its words are Python's
        return "its header is damaged: copy it again"
    return f"damaged ({text[:100] or type(error).__name__}): copy it again"
