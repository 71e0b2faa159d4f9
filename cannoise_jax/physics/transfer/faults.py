"""What every command that measures recordings says of them alike, where numbers cannot be right."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from cannoise_jax.physics.robust import median
from cannoise_jax.physics.transfer.black import flat_seconds, reference_dark, stand_in
from cannoise_jax.physics.transfer.defects import bad_line, defects_line, shadows_line, spots_line
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators.own_charge import holds_charge
from cannoise_jax.physics.transfer.estimators.pick import brightest_flat, darkest
from cannoise_jax.physics.transfer.fit import Line
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.lost_bit import lost_bit
from cannoise_jax.physics.transfer.other_light import other_light_line
from cannoise_jax.physics.transfer.quantities import SET_ASIDE, set_aside
from cannoise_jax.physics.transfer.rails import STILL, contradicted_black, cut_off
from cannoise_jax.physics.transfer.regions import drifting_halves, uneven_halves, uneven_noise
from cannoise_jax.physics.transfer.several_gains import several_gains
from cannoise_jax.physics.transfer.smoothed import flats_moving
from cannoise_jax.physics.transfer.stated import codes_line, colours_line, exposures_lines, levels_line
from cannoise_jax.physics.transfer.unlike_biases import unlike_biases
from cannoise_jax.physics.transfer.unlit import unlit_line, without_unlit
from cannoise_jax.recordings.recording import DARK

_LONGER, _LONG_S = 10.0, 1.0
"""Times the exposure of flats, and seconds, from which dark charge may matter in darks and not in flats."""
_TOLD = 3
"""Exposures of darks from which on dark current, and what the shortest hold of it, is told."""

_MOST = 0.3
"""Share of the pixels of a dark which reach the white level, where that cannot be the right one."""


class Faults(NamedTuple):
    """Where recordings of one ISO setting bear no measurement, or contradict what is stated of them: a line
    each, empty where they do not.

    cut_off: darks show neither read noise nor black level. above: hardly a pixel of theirs stays below the
    white level. unlike: flats and darks are of two gains. moves: scenes tell no gain. doubted: flats tell
    one that may be wrong. black: the stated black level is none of the darks'. colours: the greens of the
    stated order are none. lights, charge: flats, or darks, contradict their exposures. codes: those of
    flats and darks have not one scale, or half of them never occur. biases: they are no repeats of the
    darks. levels: frames of a dark lie at two. flats: their light moves. unlit: no light reaches a part of
    a flat. longer: the read noise is that of long darks. uneven: it, or the gain, differs between parts of
    the frame. halves: its darks have two, which move against each other. defects: pixels that show nothing.
    lines: columns and rows far from all others. shadows: of dust. spots: of light, that move over flats.
    lamp: a flat has another light than a longer one of the same lamp.
    """

    cut_off: str = ""
    unlike: str = ""
    moves: str = ""
    doubted: str = ""
    black: str = ""
    unlit: str = ""
    longer: str = ""
    uneven: str = ""
    halves: str = ""
    defects: str = ""
    lines: str = ""
    shadows: str = ""
    spots: str = ""
    lamp: str = ""
    colours: str = ""
    lights: str = ""
    charge: str = ""
    codes: str = ""
    biases: str = ""
    above: str = ""
    levels: str = ""
    flats: str = ""

    @property
    def stated(self) -> tuple[str, ...]:
        """What is stated of the recordings, or looks as if all were of one camera, and is contradicted."""
        return (
            self.black, self.colours, self.lights, self.charge, self.codes, self.biases, self.levels,
            self.flats,
        )  # fmt: skip


def faults(statistics: Sequence[FrameStatistics], lines: Sequence[Line | NotMeasurable] = ()) -> Faults:
    """The faults of the recordings of one ISO setting. lines: of photon transfer, by channel; without them,
    as where a table states them, nothing is said of the gain and of what it tells."""
    reasons = (line.record for line in lines if isinstance(line, NotMeasurable))
    moves = next((reason for reason in reasons if reason.endswith(STILL)), "")
    drawn = [line for line in lines if isinstance(line, Line)]
    worst = max(drawn, key=lambda line: line.dropped, default=None)
    doubted = set_aside(worst) if worst is not None and worst.dropped > SET_ASIDE else ""
    parted = without_unlit(statistics)
    lights, charge = exposures_lines(parted)
    slope = sum(line.slope.value for line in drawn) / len(drawn) if drawn else 0.0
    return Faults(
        cut_off=cut_off(statistics), above=_above_white(statistics), unlike=several_gains(statistics),
        moves=moves, doubted=doubted, black=contradicted_black(statistics), colours=colours_line(parted),
        lights=lights, charge=charge, codes=lost_bit(parted) or codes_line(parted),
        biases=unlike_biases(parted, slope) if drawn else "", levels=levels_line(statistics),
        flats=flats_moving(parted) if drawn else "", unlit=unlit_line(parted), longer=_longer(statistics),
        uneven=_uneven(parted), halves=drifting_halves(darkest(parted)), defects=defects_line(parted),
        lines=bad_line(parted), shadows=shadows_line(parted),
        spots=spots_line(parted), lamp=other_light_line(parted),
    )  # fmt: skip


def _above_white(statistics: Sequence[FrameStatistics]) -> str:
    dark = reference_dark(statistics)
    white = 0.0 if dark is None else dark.recording.white_level
    if dark is None or dark.clipped.mean() < _MOST or float(median(dark.mean)) < white / 2:
        return ""
    return (
        f"{dark.recording.path or dark.recording.camera}: most pixels of the darks reach the white level "
        f"({white:g} DN) in some frame, so that they tell no noise: state the right one (--white-level)"
    )


def _uneven(statistics: Sequence[FrameStatistics]) -> str:
    dark = reference_dark(statistics)
    return "" if dark is None else uneven_noise(dark) or uneven_halves(brightest_flat(statistics), dark)


def _longer(statistics: Sequence[FrameStatistics]) -> str:
    """Which darks of another exposure than the flats stand for some as long, or, far longer, tell the read
    noise; empty where others do."""
    darks = [s for s in statistics if s.recording.kind in DARK and s.variance is not None]
    seconds, flat = [s.recording.exposure_s for s in darks], flat_seconds(statistics)
    known = [t for t in seconds if t is not None]
    if instead := stand_in(statistics):
        own, dark = instead
        return (
            f"flats of {own:g} s are measured above darks of {dark:g} s, whose dark charge counts as that of "
            f"the flats: where it matters record darks of {own:g} s"
        )
    reference = reference_dark(statistics)
    timed = None not in seconds and len(set(seconds)) < _TOLD
    if reference is not None and timed and holds_charge(reference):
        return (
            f"the darks of {reference.recording.exposure_s:g} s hold dark charge: read noise and black level "
            "are with it and its shot noise: record biases, or darks of three exposures or more"
        )
    if flat is None or len(set(seconds)) != 1 or not known or known[0] < max(_LONGER * flat, _LONG_S):
        return ""
    return (
        f"the read noise is that of darks of {known[0]:g} s, with the shot noise of their dark charge: "
        f"record biases, or darks as long as the flats ({flat:g} s)"
    )
