"""What a case is, and the sound files that cases are made of."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple


class Case(NamedTuple):
    """kind: for the count. must: "refuse", or "either" where both one line and a result are sound. seconds:
    time of a core that it may take."""

    kind: str
    target: str
    argv: list[str]
    must: str = "either"
    seconds: float = 20.0


class Kit(NamedTuple):
    """The sound files: recordings by name, a night of FITS files, a sensor.json with maps, a model.npz, a
    denoiser, a published result."""

    recordings: dict[str, Path]
    night: Path
    sensor: Path
    model: Path
    denoiser: Path
    result: Path
