"""Where recordings bear no measurement, or contradict what is stated of them, as calibrating says it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from cannoise_jax.discovery.frames.calibrate import gain_groups
from cannoise_jax.discovery.frames.splits import all_frames, split_recordings
from cannoise_jax.physics.transfer.faults import Faults, faults
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.physics.transfer.one_temperature import other_temperatures
from cannoise_jax.physics.transfer.photon_transfer import channel_lines
from cannoise_jax.physics.transfer.rails import MOVES, moving, with_measured_black
from cannoise_jax.physics.transfer.smoothed import moving as light_moves
from cannoise_jax.physics.transfer.unlit import NO_PART, lit_rectangle, without_unlit
from cannoise_jax.recordings.crop import cut_to
from cannoise_jax.recordings.lazy import chosen
from cannoise_jax.recordings.packing import ALL
from cannoise_jax.recordings.recording import BadInput, CaptureSet, Recording


class FaultWarning(UserWarning):
    """Recordings bear no measurement, or contradict what is stated of them."""


def faults_of(capture: CaptureSet) -> dict[float | None, Faults]:
    """The faults of the frames that a run looks at, by ISO. A scene whose reference follows each frame may
    move."""
    used = all_frames(split_recordings(capture))
    looked = [
        _only(r, numbers) for r, numbers in zip(capture.recordings, used, strict=True) if not _followed(r)
    ]
    out = {}
    for iso in gain_groups(capture):
        if own := [frame_statistics(r) for r in looked if r.iso == iso]:
            out[iso] = faults(own, channel_lines(with_measured_black(own)))
    return out


def fault_lines(found: Mapping[float | None, Faults]) -> list[str]:
    """A line for each reason why recordings bear no measurement, or contradict what is stated of them, with
    the setting where there are several."""
    out = []
    for iso, wrong in found.items():
        of = f"ISO {iso:g}: " if len(found) > 1 and iso is not None else ""
        moves = f"the gain{at_iso(iso)} was not measured: {wrong.moves}" if wrong.moves else ""
        doubted = f"the gain{at_iso(iso)}: {wrong.doubted}" if wrong.doubted else ""
        lines = (
            f"{wrong.lines}: defects, for which there is no name among the findings" if wrong.lines else ""
        )
        plain = (
            wrong.cut_off,
            *wrong.stated,
            wrong.unlit,
            lines,
            wrong.longer,
            wrong.uneven,
            wrong.spots,
            wrong.lamp,
        )
        out += [line for line in (moves, doubted, *(f"{of}{line}" for line in plain if line)) if line]
    return out


def at_iso(iso: float | None) -> str:
    """The setting as a sentence names it, where one is stated."""
    return "" if iso is None else f" at ISO {iso:g}"


def without_moving(capture: CaptureSet) -> tuple[CaptureSet, tuple[str, ...]]:
    """The recordings without scenes that move, and a line for each: their motion would be measured as noise.
    They stay where they are all that is lit, and where a reference tells their light."""
    kept, lines = [], []
    lit = {r.iso for r in capture.recordings if r.kind == "flat"}
    for r in capture.recordings:
        alone = r.kind != "scene" or r.clean is not None or r.iso not in lit
        sites = (ALL,) if r.cfa == "MONO" else range(4)  # of which a camera without colours shows one scene
        share = 0.0 if alone else max(moving(r, c) for c in sites)
        if share > MOVES:
            why = f"{100 * share:.0f} % of what changes between frames is no noise"
            lines.append(f"{r.path or r.kind}: {why}: the scene or its light moves: left out")
        else:
            kept.append(r)
    return dataclasses.replace(capture, recordings=tuple(kept)), tuple(lines)


def without_moving_flats(
    capture: CaptureSet, found: Mapping[float | None, Faults]
) -> tuple[CaptureSet, tuple[str, ...]]:
    """The recordings without flats under which the light moves, and a line for each, where something else is
    left: its motion has any shape, and is no noise."""
    lines, kept = [], []
    for r in capture.recordings:
        if found[r.iso].flats and r.kind == "flat" and (alike := light_moves(frame_statistics(r))):
            lines.append(f"{r.path or r.kind}: {alike}: the light moves: left out")
        else:
            kept.append(r)
    if not kept:
        return capture, ()
    return dataclasses.replace(capture, recordings=tuple(kept)), tuple(lines)


def within_light(
    capture: CaptureSet, found: dict[float | None, Faults]
) -> tuple[CaptureSet, dict[float | None, Faults]]:
    """The recordings cut to the part of the frame that light reaches in all flats, and the faults of that,
    where it does not reach the rest: overscan that no header states would be sensitivity, dark current and
    columns of the camera. Both unchanged where no such part holds most of the light."""
    told = {iso: wrong.unlit for iso, wrong in found.items() if wrong.unlit}
    if not told:
        return capture, found
    parted = [
        part
        for iso in told
        for part in without_unlit([frame_statistics(r) for r in capture.recordings if r.iso == iso])
    ]
    place = lit_rectangle(parted)
    if place is None:
        return capture, found
    rows, columns = (f"{at.start + 1} to {at.stop}" for at in place)
    capture, (iso, why) = cut_to(capture, place), next(iter(told.items()))
    again = faults_of(capture)
    line = f"{why.split(NO_PART)[0]}: all frames are cut to rows {rows}, columns {columns}"
    return capture, {**again, iso: again[iso]._replace(unlit=line)}


def without_spots(capture: CaptureSet, found: Mapping[float | None, Faults]) -> CaptureSet:
    """The recordings with flats without the spots of light that move over them."""
    kept = tuple(
        frame_statistics(r).recording if found[r.iso].spots and r.kind == "flat" else r
        for r in capture.recordings
    )
    return dataclasses.replace(capture, recordings=kept)


def at_one_temperature(capture: CaptureSet) -> tuple[CaptureSet, tuple[str, ...]]:
    """The recordings without darks that are warmer or colder than the others of their exposure, and a line
    for each gain setting that has some: one dark current is looked for."""
    gone, lines = [], []
    for iso in {r.iso: None for r in capture.recordings}:
        others, line = other_temperatures([r for r in capture.recordings if r.iso == iso])
        gone += others
        lines += [f"{line}: bin/calibrate says how dark current grows with the temperature"] if others else []
    kept = tuple(r for r in capture.recordings if not any(r is other for other in gone))
    return dataclasses.replace(capture, recordings=kept), tuple(lines)


def check_measurable(capture: CaptureSet, found: Mapping[float | None, Faults]) -> None:
    """Raises BadInput where recordings of one ISO are of two gains, or darks above white, and where scenes
    without a reference are all that is lit at an ISO, and move."""
    for iso, wrong in found.items():
        if refused := wrong.above or wrong.unlike:
            raise BadInput(refused)
        lit = [r for r in capture.recordings if r.iso == iso and r.kind == "scene" and r.clean is None]
        if wrong.moves and lit:
            raise BadInput(f"{lit[0].path or capture.camera}: {wrong.moves}")


def _followed(recording: Recording) -> bool:
    return recording.clean is not None and recording.clean.ndim == 3


def _only(recording: Recording, numbers: list[int]) -> Recording:
    return dataclasses.replace(recording, frames=chosen(recording.frames, tuple(numbers)), clean=None)
