"""What a comparison of a simulator with recordings holds: the records that its parts hand to one another."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


class Statistics(NamedTuple):
    """One family of one recording.

    law: `energy`, `mean` or `count`.
    values: by unit and statistic.
    size: degrees of freedom of an energy, variance of a unit's mean under white noise, 1 for counts.
    frames: of which a static map is the mean.
    """

    law: str
    values: Float[np.ndarray, "u k"]
    size: Float[np.ndarray, "k"]
    frames: int = 1


class Measured(NamedTuple):
    """The families of one recording by name, the summed periodogram of its contrasts and how many they are,
    its static map for the comparison between recordings (None: not known), whether its noise is less than a
    code, and the number of its columns."""

    families: dict[str, Statistics]
    power: Float[np.ndarray, "h v"] | None
    contrasts: int
    static: Float[np.ndarray, "h w"] | None
    coarse: bool = False
    width: int = 0


class Seen(NamedTuple):
    """What is kept of one recording for the report.

    name, kind, exposure_s: of the recording; size, frames: its rows and columns, and how many.
    sigma: the simulator's noise per site, DN; log_sigma: the mean of its logarithm over the pixels.
    signal: mean above black, DN.
    degree: of the surface that stands for the light, 0 where none does.
    """

    name: str
    kind: str
    sigma: Float[np.ndarray, "4"]
    log_sigma: float
    signal: float
    size: tuple[int, int]
    frames: int
    exposure_s: float | None
    degree: int


class Judgement(NamedTuple):
    """One family of one recording, or of several of a kind together."""

    family: str
    where: str
    recorded: Float[np.ndarray, "k"]
    simulated: Float[np.ndarray, "k"]
    z: Float[np.ndarray, "k"]
    passing: float

    @property
    def found(self) -> np.ndarray:
        """Which statistics differ."""
        return np.flatnonzero(np.abs(self.z) > self.passing)


class Peak(NamedTuple):
    """One frequency whose power differs: cycles per pixel down and across, excess amplitude in standard
    deviations of the noise (of the side that has it), signed by which has more."""

    where: str
    frequency: tuple[float, float]
    amplitude: float
    z: float


class Compared(NamedTuple):
    """The bank of the recordings and of every set of the simulator, by recording, and what was judged.

    held_back: whether all frames were kept from whoever made the simulator.
    """

    label: str
    camera: str
    alpha: float
    seen: dict[str, Seen]
    recorded: dict[str, Measured]
    simulated: dict[str, list[Measured]]
    judgements: list[Judgement]
    peaks: list[Peak]
    sets: int
    step: float
    held_back: bool = False
