"""What the recordings of one split say beside their fields: what signatures are built for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float


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
    full: bool = False
    sure: bool = True
    alone: float = 0.0
    part: int = 0


class GroupBaseline(NamedTuple):
    """Poisson-Gaussian parameters of one gain setting: per mosaic site, DN and DN/e-; error: of the gain.
    pedestal: black level before rounding and clipping at code 0, `black` as the darks store it."""

    iso: float | None
    black: Float[np.ndarray, "4"]
    gain: Float[np.ndarray, "4"]
    read_dn: Float[np.ndarray, "4"]
    gain_error: Float[np.ndarray, "4"]
    read_error: Float[np.ndarray, "4"]
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


class Recorded(NamedTuple):
    """What the files say, and what was calibrated.

    black: stated black level per mosaic site, DN; tolerance: how far it may be rounded; greens: sites of the
    two greens, None: there are none. jitter: variance of the frame offsets of the darks, DN^2. stated: gain
    (DN/e-) and read noise (DN) per gain setting that are judged, None: none are; fitted_too: whether they are
    themselves fits. step: of the codes, span: white minus black, DN. mono: whether neighbours see the same
    colour. times: numbers of the frames of every recording, in the order they were taken. occurred: see
    `Occurred`.
    """

    black: Float[np.ndarray, "4"]
    greens: tuple[int, int] | None
    tolerance: float
    jitter: float
    codes: Codes
    baselines: tuple[GroupBaseline, ...]
    stated: tuple | None
    fitted_too: bool
    step: float
    span: float
    mono: bool
    times: dict[int, list[int]]
    occurred: Occurred
