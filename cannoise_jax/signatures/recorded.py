"""What the recordings of one split say beside their fields: what signatures are built for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.signatures.fields import Fields

_ANOTHER_GAIN = 1.2
"""Gain over another from which on strengths at both are told apart."""
_ANOTHER_EXPOSURE = 1.01
"""Exposure over another from which on they differ by more than how they are written."""


class Level(NamedTuple):
    """One point of a photon-transfer curve: temporal variance of pixels of like signal. full: of full pixels;
    sure: whether the signal of each pixel is known well enough to judge the curve; alone: variance of what
    pixels do not share; part: class of like signal of its recording."""

    recording: int
    channel: int
    signal: float
    variance: float
    error: float
    pixels: int
    full: bool
    sure: bool
    alone: float
    part: int


@dataclass(frozen=True, eq=False, kw_only=True)
class GroupBaseline(Baseline):
    """The baseline of one gain setting, what rows share in its read noise, and the curve that it is of.
    pedestal: black level before rounding and clipping at code 0, `black_level` as the darks store it."""

    iso: float | None
    levels: tuple[Level, ...]
    pedestal: Float[np.ndarray, "4"]


class Codes(NamedTuple):
    """Counts of codes, in units of the step: of broadly spread pixels, and of the darks; steps in DN."""

    broad: np.ndarray
    narrowest: float
    dark: tuple[np.ndarray, ...]
    lowest: tuple[int, ...]
    step: float
    detected: float
    stated: float | None


class Occurred(NamedTuple):
    """Codes that were expected, and those of them that never occurred: number of each, times expected."""

    code: np.ndarray
    expected: np.ndarray
    missing: np.ndarray
    step: float


class Stated(NamedTuple):
    """Gain (DN/e-) and read noise (DN) of every mosaic site that are judged, and their standard errors: 0 of
    what files state."""

    gain: Float[np.ndarray, "4"]
    read_noise: Float[np.ndarray, "4"]
    gain_stderr: Float[np.ndarray, "4"]
    read_stderr: Float[np.ndarray, "4"]


class Recorded(NamedTuple):
    """What the files say, and what was calibrated.

    black: stated black level of every gain setting, or that of the judged simulator, per mosaic site, DN;
      tolerance: how far it may be rounded.
    greens: sites of the two greens, None: there are none. mono: whether neighbours see the same colour.
    jitter: variance of the frame offsets of the darks, DN^2. step: of the codes, span: white minus black, DN.
    stated: what is judged per gain setting, None: nothing is; fitted_too: whether it is itself a fit.
    times: numbers of the frames of every recording, in the order they were taken. occurred: see `Occurred`.
    units: DN of each gain setting in one of the lowest, ones where they are not known.
    seconds: exposures that recordings state.
    rise: how the level of the judged simulator's darks rises with the exposure, and its standard error, DN/s
      at the lowest gain; zeros of none.
    charge: variance that the charge of the shortest dark of every gain setting has beyond that of the
      simulator's, DN^2.
    unlit: the darks as they were recorded, with all that is taken out of them later. flats: the same of flats
      of a sensor without colours, without their contrasts.
    """

    black: Float[np.ndarray, "g 4"]
    greens: tuple[int, int] | None
    tolerance: float
    jitter: float
    codes: Codes
    baselines: tuple[GroupBaseline, ...]
    stated: tuple[Stated | None, ...] | None
    fitted_too: bool
    step: float
    span: float
    mono: bool
    times: dict[int, list[int]]
    occurred: Occurred
    units: tuple[float, ...]
    seconds: tuple[float, ...]
    rise: tuple[float, float]
    charge: tuple[float, ...]
    unlit: tuple[Fields, ...]
    flats: tuple[Fields, ...] = ()

    @property
    def several_exposures(self) -> bool:
        """Whether what grows with the exposure is told from what does not."""
        return bool(self.seconds) and max(self.seconds) > _ANOTHER_EXPOSURE * min(self.seconds)

    @property
    def several_gains(self) -> bool:
        """Whether what a gain changes is told from what it does not."""
        return max(self.units) > _ANOTHER_GAIN * min(self.units)
