"""Declare: what the recordings are, and so which mechanisms they can show; for each of the others,
what to record."""

from __future__ import annotations

from cannoise_jax.discovery.locate import Located
from cannoise_jax.mechanisms import LISTED
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.signatures.signature import Signature

NEEDS = {entry.id: entry.needs for entry in LISTED}


UNTESTED = (
    "poisson_skew",
    "excess_noise",
    "clock_induced_charge",
    "dual_gain",
    "dead_pixels",
    "cosmic_rays",
    "temperature_drift",
    "image_lag",
    "smear",
    "lossy_compression",
    "defect_correction",
    "hot_pixel_suppression",
    "scene_motion",
)
"""Ids that no statistic looks for, whatever is recorded."""


def registered(without: tuple[str, ...] = (), mechanisms: tuple[str, ...] | None = None) -> tuple[str, ...]:
    """Ids that this run may name. Raises ValueError for an id that the vocabulary does not have."""
    known = [entry.id for entry in LISTED]
    for id in (*without, *(mechanisms or ())):
        if id not in known:
            raise ValueError(f"{id}: no such mechanism; known: {', '.join(known)}")
    return tuple(id for id in known if id not in without and (mechanisms is None or id in mechanisms))


def testable(
    located: Located, signatures: tuple[Signature, ...], ids: tuple[str, ...]
) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Ids that some signature could test on these recordings, and the others with what to record."""
    tested = {p.mechanism for p in signatures if p.name in located.scores}
    yes = tuple(id for id in ids if id in tested)
    return yes, tuple((id, needs(id)) for id in ids if id not in tested)


def needs(id: str) -> str:
    """What to record for a mechanism; said so where no recording helps yet."""
    return f"nothing looks for it yet; it would show in {NEEDS[id]}" if id in UNTESTED else NEEDS[id]


def kinds(capture: CaptureSet) -> list[dict]:
    """One line per recording: what it is, as the report lists it."""
    out = []
    for r in capture.recordings:
        settings = {
            "iso": r.iso,
            "exposure_s": r.exposure_s,
            "temperature_c": r.temperature_c,
            "reference": r.reference if r.clean is not None else None,
        }
        out.append({"file": r.path or "in memory", "kind": r.kind, "frames": r.count, "settings": settings})
    return out
