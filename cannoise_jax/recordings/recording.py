"""What was recorded: frames of one camera at one setting, and the recordings of one camera.

A recording keeps the sensor's own numbers (DN, as stored) and what is needed to read them: the mosaic's
colour order, black and white level. Everything else may be missing, and missing is `None`, never a guess.
Values are normalised as (DN - black) / (white - black): 0 is the black level, 1 the white level.
"""

from __future__ import annotations

import math
import re
import reprlib
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from jaxtyping import Float, UInt16

CFA_PATTERNS = ("RGGB", "GRBG", "GBRG", "BGGR", "MONO")
KINDS = ("scene", "flat", "dark", "bias")
DARK = ("dark", "bias")
"""Kinds that no light fell on."""
LIT = ("scene", "flat")
REFERENCES = ("independent", "burst_mean")
COLDEST_C = -273.15
"""Absolute zero."""
HOTTEST_C = 150.0
"""Silicon records nothing beyond; what is higher is in kelvin, or a slip."""
SHORTEST_S, LONGEST_S = 1e-9, 1e6
"""Exposures beyond are in another unit, or slips; biases may state 0."""
LEAST = 2.0**-126
"""Magnitude of a number that is not 0: float32 has no less in full precision."""
MOST = 1e9
"""An ISO, or another setting without a limit of its own."""
MOST_DB = 200.0
"""A factor of ten thousand million; cameras have some fifty decibels."""

Kind = Literal["scene", "flat", "dark", "bias"]
PerChannel = tuple[float, float, float, float]
"""One value per site of the 2x2 mosaic cell, in mosaic order (0,0), (0,1), (1,0), (1,1)."""


_BREAKS = re.compile(r"\s*[\t\n\v\f\r\x1c-\x1e\x85\u2028\u2029]\s*")
_LONGEST_LINE = 880
"""Characters of a message: some name every mechanism that there is."""


def iso_of_gain(decibels: float) -> float:
    """The ISO that stands for the gain of a camera that counts in dB: 100 at 0 dB."""
    return 100 * 10 ** (decibels / 20)


def gain_of_iso(iso: float) -> float | None:
    """The gain in dB that an ISO stands for, in tenths; None for one that a camera states as such. Those are
    whole numbers, and what stands for a gain hardly ever is one: 0, 20 and 40 dB are not told."""
    tenths = 200 * math.log10(iso / 100) if iso > 0 else 0.0
    if iso == round(iso) or abs(tenths - round(tenths)) > 1e-3:
        return None
    return round(tenths) / 10


def in_one_line(value: object) -> str:
    """A value as messages quote it: shortened, and without the line breaks of arrays."""
    return " ".join(reprlib.repr(value).split())


def printable(text: str) -> str:
    """A text in one line: a space for breaks and tabs, a question mark for what else no line can show. Names
    of files may hold them, and what a terminal takes for orders."""
    return "".join(c if c.isprintable() else "?" for c in _BREAKS.sub(" ", text).rstrip())


class BadInput(ValueError):
    """Input that cannot be used: one printable line that names the file, what is wrong, and what to do about
    it."""

    def __str__(self) -> str:
        line = printable(super().__str__())
        if len(line) <= _LONGEST_LINE:
            return line
        # A file may hold a name of any length; who it is and what to do stand at the ends.
        return f"{line[: _LONGEST_LINE // 2]} ... {line[-_LONGEST_LINE // 3 :]}"


class Frames(Protocol):
    """Frames in memory or on disk, `uint16[T, H, W]`: a slice of the first axis reads only those frames."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    @property
    def dtype(self) -> np.dtype: ...
    def __getitem__(self, index) -> np.ndarray: ...
    def __len__(self) -> int: ...


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames of one camera at one setting, in capture order, with what is known about them.

    Nothing is checked when one is made. `diagnose`, and every command, hold it to the rules for files and
    raise BadInput in one line where it breaks them (see `metadata.checked`).

    frames: `uint16[T, H, W]`, DN as stored; an array, or a lazy view of a file (see `Frames`).
    black_level, shot, read: mosaic order, see `PerChannel`. shot and read are variance coefficients in
      normalised units, var = shot * clean + read, so the system gain is K = shot * (white - black) DN/e-.
    clean: expected noise-free signal, normalised; `float32[H, W]`, or `[T, H, W]`, maybe lazy like frames.
    code_step: spacing of the stored codes in DN; None: to be detected; 0: not on a lattice.
    gain_db: the camera's gain setting where it counts in dB; its iso is then 100 x 10^(gain_db / 20).
    egain: the gain that the file states, e-/DN; what is measured never uses it. em_gain: by which the file
      says that charge was multiplied before it was read; likewise.
    reference: where `clean` comes from; None: unknown. reference_frames: how many were averaged.
    full_code: code of frames of the same setting that are left out because every pixel of them is full, DN.
    path: the file it was read from, for messages. sources: the files that its frames were taken from, where
      those are others than `path`, in the order of the frames.
    """

    frames: Frames | UInt16[np.ndarray, "t h w"]
    cfa: str
    black_level: PerChannel
    white_level: float
    camera: str = "unknown"
    kind: Kind = "scene"
    clean: Float[np.ndarray, "*t h w"] | None = None
    iso: float | None = None
    exposure_s: float | None = None
    temperature_c: float | None = None
    shot: PerChannel | None = None
    read: PerChannel | None = None
    code_step: float | None = None
    reference: str | None = None
    reference_frames: int | None = None
    path: str | None = None
    gain_db: float | None = None
    egain: float | None = None
    full_code: float | None = None
    sources: tuple[str, ...] = ()
    em_gain: float | None = None

    @property
    def count(self) -> int:
        """Number of frames T."""
        return self.frames.shape[0]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the mosaic in pixels."""
        return self.frames.shape[1], self.frames.shape[2]

    def black_map(self) -> Float[np.ndarray, "h w"]:
        """The black level of every pixel, DN."""
        return mosaic_map(self.black_level, self.size)


def name_of(recording: Recording, number: int) -> str:
    """How messages call a recording: by its file, or by its place among others, from 0, and its kind."""
    return recording.path or f"recording {number + 1} ({recording.kind})"


@dataclass(frozen=True, eq=False)
class CaptureSet:
    """The recordings of one camera: the files of one folder, sorted by name.

    As a `Recording`, it is checked by what takes it: an empty one, several cameras or several colour orders
    are refused by `diagnose`.
    """

    camera: str
    recordings: tuple[Recording, ...]
    path: str | None = None

    def of_kind(self, *kinds: str) -> tuple[Recording, ...]:
        """The recordings whose kind is among `kinds`, in order."""
        return tuple(r for r in self.recordings if r.kind in kinds)


def mosaic_map(
    values: PerChannel | Float[np.ndarray, "4"], size: tuple[int, int]
) -> Float[np.ndarray, "h w"]:
    """One value per mosaic site spread over a mosaic of `size`: `float32[H, W]`, H and W of any parity."""
    height, width = size
    cell = np.asarray(values, np.float32).reshape(2, 2)
    return np.tile(cell, ((height + 1) // 2, (width + 1) // 2))[:height, :width]


def normalise(frames: UInt16[np.ndarray, "... h w"], recording: Recording) -> Float[np.ndarray, "... h w"]:
    """DN to normalised units, (DN - black) / (white - black) per mosaic site: float32, unclipped."""
    black = recording.black_map()
    return (np.asarray(frames, np.float32) - black) / (np.float32(recording.white_level) - black)


def per_channel(value: float | tuple[float, ...] | np.ndarray) -> PerChannel:
    """One value, or one per mosaic site, as four. Raises ValueError for any other count."""
    flat = np.asarray(value, np.float64).reshape(-1)
    if flat.size not in (1, 4):
        raise ValueError(f"expected 1 or 4 values (mosaic order), got {flat.size}")
    a, b, c, d = np.broadcast_to(flat, (4,)).tolist()
    return a, b, c, d


def iso_numbers(isos: Iterable[float | None]) -> dict[float | None, float]:
    """The ISO by which a camera model knows each gain setting: the stated one; where none is stated, or 0 as
    astronomy cameras count, one below all others."""
    every = set(isos)
    lowest = min((iso for iso in every if iso), default=200.0)
    odd = sorted((iso for iso in every if not iso), key=lambda iso: iso is None)
    return {iso: iso or lowest / 2 ** (1 + odd.index(iso)) for iso in every}
