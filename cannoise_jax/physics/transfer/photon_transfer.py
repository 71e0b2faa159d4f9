"""Photon transfer: the Poisson-Gaussian baseline of a camera, from its recordings alone.

Quantities and symbols follow EMVA 1288 release 4.0 (linear camera model): system gain K, temporal dark noise
sigma_d, DSNU1288, PRNU1288, dark current mu_I, saturation; in DN as stored and in electrons. Temporal noise
comes from changes between frames (see `transfer.frames`), the slope from `transfer.fit` with its rule for
outliers, fixed patterns from `transfer.spatial`. What the recordings cannot give is `NotMeasurable` and says
what to record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.black import black_level, reference_dark
from cannoise_jax.physics.transfer.estimate import Estimate, NotMeasurable, Outcome
from cannoise_jax.physics.transfer.fit import ChannelMaps, Line, fit_line
from cannoise_jax.physics.transfer.frames import FrameStatistics, frame_statistics, pixel_variance
from cannoise_jax.physics.transfer.quantities import (
    RECORD_DARKS,
    RECORD_FLATS,
    Quantity,
    dark_current_quantities,
    line_noise_quantity,
    noise_below_a_code,
    noise_quantities,
    pattern_quantities,
    saturation_quantities,
)
from cannoise_jax.physics.transfer.shape import shape_quantities
from cannoise_jax.recordings.packing import PACKED_CHANNELS, site, to_mosaic_order
from cannoise_jax.recordings.recording import BadInput, CaptureSet, PerChannel, Recording

_LINEAR = 0.7  # share of the white level up to which flats enter the line (EMVA 1288, section 6)


@dataclass(frozen=True)
class PhotonTransfer:
    """All that photon transfer finds at one ISO setting."""

    camera: str
    iso: float | None
    cfa: str
    baseline: Baseline | NotMeasurable
    quantities: tuple[Quantity, ...]
    statistics: tuple[FrameStatistics, ...]

    def outcomes(self, name: str, unit: str | None = None) -> list[Outcome]:
        """The outcomes of a quantity (in one of its units), in the order of the channels."""
        return [q.outcome for q in self.quantities if q.name == name and unit in (None, q.unit)]


def photon_transfer(captures: CaptureSet) -> tuple[PhotonTransfer, ...]:
    """Photon transfer of a capture set, one result per ISO setting (recordings without ISO are one setting).

    Raises BadInput when recordings of one setting differ in size, colour order or white level.
    """
    settings = sorted({r.iso for r in captures.recordings}, key=lambda iso: (iso is not None, iso))
    return tuple(
        transfer_at([frame_statistics(r) for r in captures.recordings if r.iso == iso]) for iso in settings
    )


def channel_names(cfa: str) -> tuple[str, str, str, str]:
    """Names of the mosaic sites in mosaic order: R, Gr, Gb, B; positions for a monochrome sensor."""
    if cfa == "MONO":
        return "00", "01", "10", "11"
    a, b, c, d = to_mosaic_order(np.array(PACKED_CHANNELS), cfa)
    return str(a), str(b), str(c), str(d)


def transfer_at(statistics: Sequence[FrameStatistics]) -> PhotonTransfer:
    """Photon transfer of recordings made at one ISO setting. Raises BadInput as `photon_transfer`."""
    first = statistics[0].recording
    _check_alike([s.recording for s in statistics])
    step = _code_step(statistics)
    flats = [s for s in statistics if s.recording.kind == "flat"]
    dark = reference_dark(statistics)
    lit = flats or [s for s in statistics if s.recording.kind == "scene"]
    names = channel_names(first.cfa)
    found = black_level(statistics)
    black = found.level
    lines = channel_lines(statistics)
    quantities: list[Quantity] = []
    for c, name in enumerate(names):
        quantities += noise_quantities(name, c, lines[c], lit, dark, step, found)
        quantities += pattern_quantities(name, c, lines[c], flats, dark, black)
        quantities += dark_current_quantities(name, c, lines[c], statistics)
        quantities += saturation_quantities(name, c, lines[c], statistics, black)
    quantities.append(line_noise_quantity("row noise", dark, 0))
    quantities.append(line_noise_quantity("column noise", dark, 1))
    quantities += shape_quantities(dark) if dark is not None else []
    unknown = "needs a known photon flux: record flats under a calibrated light"
    quantities.append(Quantity("quantum efficiency", "e-/photon", "all", NotMeasurable(unknown)))
    return PhotonTransfer(
        first.camera, first.iso, first.cfa, _baseline(lines, dark, black, first, step, quantities),
        tuple(sorted(quantities, key=_table_order(quantities))), tuple(statistics),
    )  # fmt: skip


def channel_lines(statistics: Sequence[FrameStatistics]) -> list[Line | NotMeasurable]:
    """The photon transfer line of every channel, mosaic order."""
    flats = [s for s in statistics if s.recording.kind == "flat"]
    dark = reference_dark(statistics)
    lit = flats or [s for s in statistics if s.recording.kind == "scene"]
    black = black_level(statistics).level
    step = _code_step(statistics)
    return [_line(lit, dark, black, step, c) for c in range(4)]


def _code_step(statistics: Sequence[FrameStatistics]) -> float:
    return min((s.code_step for s in statistics if s.code_step > 0), default=0.0)


def _check_alike(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for other in recordings[1:]:
        for field, what in (("size", "size"), ("cfa", "colour order"), ("white_level", "white level")):
            if getattr(other, field) != getattr(first, field):
                raise BadInput(
                    f"{other.path}: {what} {getattr(other, field)} differs from {getattr(first, field)} of "
                    f"{first.path}: calibrate recordings of one sensor mode together"
                )


def _table_order(quantities: list[Quantity]):
    order = {(q.name, q.unit): at for at, q in reversed(list(enumerate(quantities)))}
    return lambda q: order[q.name, q.unit]


def _levels(
    lit: list[FrameStatistics], dark: FrameStatistics | None, black: PerChannel, step: float, c: int
) -> list[ChannelMaps]:
    levels = []
    within = [
        s for s in lit
        if s.variance is not None and s.level[c] < _LINEAR * (s.recording.white_level - black[c])
    ]  # fmt: skip
    for s in within or [s for s in lit if s.variance is not None]:
        signal, variance = site(s.mean, c) - black[c], pixel_variance(s, c)
        levels.append(ChannelMaps(signal, variance, ~site(s.clipped, c), s.recording.count, s.dof, False))
    if dark is not None and dark.variance is not None:
        # Charge that a longer dark holds beyond black has shot noise like any other.
        charge = max(float(dark.frame_means[:, c].mean()) - black[c], 0.0)
        zero = np.full(site(dark.mean, c).shape, charge)
        usable, variance = ~site(dark.clipped, c), pixel_variance(dark, c)
        if quiet := noise_below_a_code(dark, step, c):
            # Rounding adds step^2 / 12 to flats, and something else to noise of less than a code.
            variance = variance + (quiet.read.value**2 + step**2 / 12 - quiet.square)
        levels.append(ChannelMaps(zero, variance, usable, dark.recording.count, dark.dof, True))
    return levels


def _line(
    lit: list[FrameStatistics], dark: FrameStatistics | None, black: PerChannel, step: float, c: int
) -> Line | NotMeasurable:
    if not any(s.variance is not None for s in lit):
        return NotMeasurable(RECORD_FLATS)
    line = fit_line(_levels(lit, dark, black, step, c), step**2 / 12)
    if line is None or not line.sure:
        reason = RECORD_FLATS if dark is not None else f"{RECORD_DARKS}; {RECORD_FLATS}"
        return NotMeasurable(reason)
    return line


def _baseline(
    lines: list[Line | NotMeasurable], dark: FrameStatistics | None, black: PerChannel, first: Recording,
    step: float, quantities: list[Quantity],
) -> Baseline | NotMeasurable:  # fmt: skip
    reads = [q.outcome for q in quantities if q.name == "temporal dark noise" and q.unit == "DN"]
    for outcome in (*lines, *reads):
        if isinstance(outcome, NotMeasurable):
            return outcome
    slopes = [line.slope for line in lines if isinstance(line, Line)]
    noises = [r for r in reads if isinstance(r, Estimate)]
    return Baseline(
        gain=np.array([e.value for e in slopes]),
        read_noise=np.array([e.value for e in noises]),
        black_level=np.array(black),
        gain_stderr=np.array([e.stderr for e in slopes]),
        read_stderr=np.array([e.stderr for e in noises]),
        white_level=first.white_level,
        code_step=step,
    )
