"""Darks of one temperature: the same exposure recorded twice, cold and warm, holds two dark currents."""

from __future__ import annotations

from collections.abc import Sequence

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.recording import DARK, Recording

_GATHERS_S = 0.1
"""Exposure of flats from which their dark charge may matter."""


def of_one_temperature(statistics: Sequence[FrameStatistics]) -> tuple[list[FrameStatistics], str]:
    """The recordings of one ISO without darks of another temperature, and a line that says which those are,
    and where no dark is as warm as the flats (`no_dark_as_warm`); empty for neither."""
    recordings = [s.recording for s in statistics]
    others, line = other_temperatures(recordings)
    kept = [s for s in statistics if not any(s.recording is r for r in others)]
    return kept, "; ".join(filter(None, (line, no_dark_as_warm(recordings))))


def other_temperatures(recordings: Sequence[Recording]) -> tuple[list[Recording], str]:
    """Of recordings of one ISO the darks of another temperature, and a line that names them, empty for none.

    Darks are left out only where an exposure was recorded at several temperatures: a sensor that warms in
    its longest exposures has no others. Those stay that are as warm as the flats, or else the coldest ones.
    """
    darks = [r for r in recordings if r.kind in DARK]
    twice = [_celsius(r) for r in darks if any(_is_again(r, other) for other in darks)]
    if not twice:
        return [], ""
    lit = [r for r in recordings if r.kind not in DARK]
    aims = [_celsius(r) for r in lit if r.temperature_c is not None] or [min(twice)]
    nearest = min(twice, key=lambda t: abs(t - float(median(aims))))
    others = [r for r in darks if r.temperature_c is not None and abs(_celsius(r) - nearest) > ALIKE_KELVIN]
    named = ", ".join(f"{r.path or r.camera} ({r.temperature_c:.4g} C)" for r in others)
    return others, f"darks of several temperatures: those of {nearest:.4g} C are used, not {named}"


def no_dark_as_warm(recordings: Sequence[Recording]) -> str:
    """A line where no dark has the temperature of flats whose exposure lets dark charge gather; empty where
    one has, or nothing is known. EMVA 1288 release 4.0 takes both under the same conditions."""
    darks = sorted({_celsius(r) for r in recordings if r.kind == "dark" and r.temperature_c is not None})
    for r in recordings:
        if r.kind == "flat" and darks and unlike_darks(r, recordings):
            near = " and ".join(f"{t:.4g}" for t in darks)
            return (
                f"flats of {r.temperature_c:.4g} C, darks of {near} C: their dark charge is not that of the "
                "flats, and what is left of it counts as light: "
                f"record darks of {r.exposure_s:g} s at {r.temperature_c:.4g} C"
            )
    return ""


def unlike_darks(flat: Recording, recordings: Sequence[Recording]) -> bool:
    """Whether the exposure of a flat lets dark charge gather, and none of the darks, of known temperatures,
    is as warm: then none shows the pattern of that charge."""
    own, seconds = flat.temperature_c, flat.exposure_s or 0.0
    darks = [_celsius(r) for r in recordings if r.kind == "dark" and r.temperature_c is not None]
    if own is None or not darks or seconds < _GATHERS_S:
        return False
    return min(abs(own - t) for t in darks) > ALIKE_KELVIN


def _celsius(recording: Recording) -> float:
    assert recording.temperature_c is not None
    return recording.temperature_c


def _is_again(one: Recording, other: Recording) -> bool:
    """Whether both are of one exposure and of two temperatures."""
    if one.temperature_c is None or other.temperature_c is None:
        return False
    alike = (one.kind, one.exposure_s) == (other.kind, other.exposure_s)
    return alike and abs(one.temperature_c - other.temperature_c) > ALIKE_KELVIN
