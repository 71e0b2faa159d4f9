"""Shots of one setting as groups, groups of one sensor mode as sets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any

import numpy as np

from cannoise_jax.recordings.fits_readout import unlike
from cannoise_jax.recordings.folders.lights import by_light, level_of
from cannoise_jax.recordings.folders.shots import Shot
from cannoise_jax.recordings.join import ALIKE_KELVIN
from cannoise_jax.recordings.recording import DARK, KINDS, LIT

_ALIKE = 0.02
"""Exposures that differ by less than this share are one setting: shutters are that exact."""


@dataclass(frozen=True)
class Group:
    """Shots that become one recording. settings: fields of `Recording` that hold for all of them.

    mode: what all recordings of a set have in common. label: how plans and files call it.
    """

    kind: str
    shots: tuple[Shot, ...]
    settings: dict[str, Any]
    mode: tuple
    filter: str | None
    label: str

    @property
    def frames(self) -> int:
        """Number of frames."""
        return sum(s.frames for s in self.shots)

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.shots[0].shape[1], self.shots[0].shape[2]


MODE = (
    *("camera", "size", "binning", "origin", "gain", "offset", "readout", "cfa", "temperature", "bits"),
    "settings",
)
"""What `Group.mode` holds, in this order; the temperature only where the camera regulates it;
8 bits where files hold no more; settings: the words that tell readouts apart, see `readouts`."""


def grouped(
    shots: Sequence[Shot], kinds: dict[str, str], camera: str, overrides: dict[str, Any]
) -> list[Group]:
    """Shots as groups of equal settings, in the order of kinds and exposures. kinds: of each shot, by name.

    camera: the name of shots that state none.
    """
    clusters = _clusters([_temperature(s, overrides) for s in shots])
    regulated = _clusters([_set_to(s, overrides) for s in shots])
    exposures = _exposures(shots, kinds, overrides)
    folders, gains = _folders(shots), _stated_gains(shots)
    members: dict[tuple, list[Shot]] = {}
    for shot, cluster, held in zip(shots, clusters, regulated, strict=True):
        kind = kinds[shot.name]
        name = shot.about.get("filter") if kind in LIT else None
        mode = _mode(shot, camera, overrides, held, gains.get(shot.name))
        iso = overrides.get("iso", shot.known.get("iso"))
        # Darks of unknown exposures that lie apart were taken apart: their dark charge may differ.
        place = folders[shot.name] if kind == "dark" and exposures[shot.name] is None else ""
        key = (
            mode,
            KINDS.index(kind),
            iso,
            exposures[shot.name],
            name,
            cluster,
            shot.name if shot.whole else place,
        )
        members.setdefault(key, []).append(shot)
    order = sorted(
        members, key=lambda k: (str(k[0]), k[1], k[2] or 0, k[3] or 0, k[4] or "", str(k[5]), k[6])
    )
    made = []
    for key in order:
        members[key] = in_order(members[key])
        lights = [members[key]]
        if KINDS[key[1]] in LIT:
            # Recordings are made of files of one light: their frames are repeats of each other.
            dark = [s for k in order if KINDS[k[1]] in DARK and _same_black(k[0], key[0]) for s in members[k]]
            lights = by_light(members[key], level_of(dark) if dark else 0.0)
        for part in lights:
            level = f"{level_of(part):.0f}DN" if len(lights) > 1 else None
            made.append(_group(key, part, overrides, level))
    return made


def in_order(shots: list[Shot]) -> list[Shot]:
    """As they were taken, where all state when; else as they come."""
    times: list[float] = [t for s in shots if (t := s.about.get("taken_s")) is not None]
    if len(times) < len(shots):
        return shots
    return [shots[n] for n in sorted(range(len(shots)), key=times.__getitem__)]


def _folders(shots: Sequence[Shot]) -> dict[str, str]:
    """The folder of each shot, by name; empty where it lies alone there, as frames of one series may."""
    parents = {s.name: PurePath(s.name).parent.as_posix() for s in shots}
    frames: Counter[str] = Counter()
    for s in shots:
        frames[parents[s.name]] += s.shape[0]
    return {name: parent if frames[parent] > 1 else "" for name, parent in parents.items()}


def _stated_gains(shots: Sequence[Shot]) -> dict[str, float]:
    """What e-/DN each shot states, by name, of cameras whose shots state no other gain and differ in it:
    there it tells settings apart. None where a shot of the camera states nothing, or all state one."""
    out: dict[str, float] = {}
    for camera in {s.known.get("camera") for s in shots}:
        own = [s for s in shots if s.known.get("camera") == camera]
        known = [s.known.get("egain") for s in own if s.known.get("iso") is None]
        stated: list[float] = [e for e in known if e is not None]
        others = any(s.about.get("gain_setting") is not None for s in own)
        if len(stated) == len(own) and not others and max(stated) > (1 + _ALIKE) * min(stated):
            out |= {s.name: float(f"{s.known['egain']:.3g}") for s in own}
    return out


def _mode(
    shot: Shot, camera: str, overrides: dict[str, Any], regulated: float | None, stated: float | None
) -> tuple:
    known, about = shot.known, shot.about
    return (
        overrides.get("camera", known.get("camera", camera)),
        shot.shape[1:],
        about.get("binning"),
        about.get("origin"),
        stated if about.get("gain_setting") is None else about["gain_setting"],
        about.get("offset"),
        about.get("mode"),
        overrides.get("cfa", known.get("cfa")),
        regulated,
        about.get("bits"),
        about.get("settings"),
    )


def differing(mode: tuple, other: tuple) -> Iterator[tuple[str, str, str]]:
    """What two modes differ in, and what either holds of it, for people."""
    for name, here, there in zip(MODE, mode, other, strict=True):
        if name == "settings":
            yield from unlike(here, there)
        elif here != there:
            yield name, word_of(here, name), word_of(there, name)


def word_of(value: Any, name: str) -> str:
    """What a mode holds under a name of `MODE`, for people."""
    if value is None:
        return {"binning": "1x1", "origin": "0x0", "bits": "16"}.get(name, "not stated")
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, tuple):
        return "x".join(f"{v:g}" for v in value)
    return str(value)


def _same_black(first: tuple, second: tuple) -> bool:
    """Whether two modes share their black level: it hardly depends on the temperature."""
    pairs = zip(MODE, first, second, strict=True)
    return all(a == b for name, a, b in pairs if name != "temperature")


def _group(key: tuple, shots: Sequence[Shot], overrides: dict[str, Any], level: str | None) -> Group:
    mode, kind, iso, exposure, name, _, _ = key
    temperatures = [t for s in shots if (t := s.known.get("temperature_c")) is not None]
    settings: dict[str, Any] = {
        "camera": mode[0],
        "kind": KINDS[kind],
        "iso": iso,
        "gain_db": None if "iso" in overrides else shots[0].known.get("gain_db"),
        "exposure_s": exposure,
        "temperature_c": round(float(np.mean(temperatures)), 2) if temperatures else None,
    }
    settings |= {n: overrides[n] for n in ("temperature_c", "exposure_s") if n in overrides}
    # Of its own frames: others of the same cluster may be of a night that warmed.
    own = [t for s in shots if (t := _temperature(s, overrides)) is not None]
    label = _label(key, settings["gain_db"], level, float(np.median(own)) if own else None)
    return Group(KINDS[kind], tuple(shots), settings, mode, name, label)


def _label(key: tuple, gain_db: float | None, level: str | None, celsius: float | None) -> str:
    mode, kind, iso, exposure, name, _, _ = key
    parts = [KINDS[kind]]
    parts += [seconds(exposure)] if exposure is not None and KINDS[kind] != "bias" else []
    parts += [level] if level else []
    decibels = gain_db if gain_db is None else f"gain{gain_db:g}dB"
    parts += [decibels] if decibels else [] if iso is None else [f"iso{iso:.4g}"]
    parts += [] if mode[4] is None else [f"gain{mode[4]:g}"]
    parts += [] if name is None else ["".join(c if c.isalnum() else "-" for c in name)]
    parts += [] if celsius is None else [f"{round(celsius)}C"]
    return "_".join(parts)


def seconds(value: float) -> str:
    """An exposure as plans and file names write it."""
    if 0 < value < 1e-3:
        return f"{1e6 * value:.4g}us"
    return f"{1e3 * value:.4g}ms" if 0 < value < 0.1 else f"{value:.4g}s"


def _set_to(shot: Shot, overrides: dict[str, Any]) -> float | None:
    """What the camera is to regulate to; None where it is not stated to."""
    held = shot.about.get("set_temperature_c")
    return held if held is None else overrides.get("temperature_c", held)


def _temperature(shot: Shot, overrides: dict[str, Any]) -> float | None:
    """What the camera regulates to where it is there; a cooler that still falls, or cannot, is not."""
    held, there = shot.about.get("set_temperature_c"), shot.known.get("temperature_c")
    if held is not None and (there is None or abs(there - held) <= ALIKE_KELVIN):
        there = held
    return overrides.get("temperature_c", there)


def _exposures(
    shots: Sequence[Shot], kinds: dict[str, str], overrides: dict[str, Any]
) -> dict[str, float | None]:
    """The exposure of each shot, by name: the first of those within a few per cent; biases have one."""
    out: dict[str, float | None] = {}
    middle = 0.0
    stated = {s.name: overrides.get("exposure_s", s.known.get("exposure_s")) for s in shots}
    for name in sorted(stated, key=lambda n: (stated[n] is not None, stated[n])):
        value = stated[name]
        if value is None:
            out[name] = None
            continue
        if not (middle > 0 and value - middle <= _ALIKE * middle):
            middle = value
        out[name] = middle
    biases = [out[s.name] for s in shots if kinds[s.name] == "bias" and not s.whole]
    known = [b for b in biases if b is not None]
    return out | {s.name: min(known, default=None) for s in shots if kinds[s.name] == "bias" and not s.whole}


def _clusters(values: Sequence[float | None]) -> list[float | None]:
    """Each temperature as the mean of those that are one with it."""
    parts = _parted(sorted({v for v in values if v is not None}))
    middle = {v: float(np.mean(part)) for part in parts for v in part}
    return [None if v is None else middle[v] for v in values]


def _parted(order: list[float]) -> list[list[float]]:
    """Sorted temperatures, parted at the widest gap until the ends of each part agree: a night that warms by
    a kelvin an hour is no one setting. Of gaps that are as wide the one nearest the middle counts."""
    if not order or order[-1] - order[0] <= ALIKE_KELVIN:
        return [order] if order else []
    gaps = np.diff(order)
    wide = np.flatnonzero(gaps > 0.99 * gaps.max())
    off = [abs(order[n] + order[n + 1] - order[0] - order[-1]) for n in wide]
    at = int(wide[np.argmin(off)]) + 1
    return _parted(order[:at]) + _parted(order[at:])
