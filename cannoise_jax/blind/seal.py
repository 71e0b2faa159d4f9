"""Sealing: capture sets in one place, what was injected in another, and a commitment that ties them.

The truth is canonical JSON with a random salt; the folder of sets holds only its SHA-256. Nothing that is
written beside the sets depends on whether a set holds an effect.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from cannoise_jax.blind.chain import Effect
from cannoise_jax.blind.compose import CURVE, Spec, compose
from cannoise_jax.blind.effects import effect, facts
from cannoise_jax.blind.effects_unlisted import SCALES
from cannoise_jax.blind.listed import NAMES
from cannoise_jax.blind.sets import SIZE, Design, draw_design, draw_scene, record, write_set
from cannoise_jax.blind.strength import reachable
from cannoise_jax.recordings.recording import BadInput, Recording

SCHEMA = "cannoise/blind/1"
_TRIES = 60


def seal(
    out: Path,
    truth: Path,
    seed: int,
    sets: int,
    nulls: int,
    progress: Callable[[int, int], None],
    kinds: tuple[str, ...] = (),
    code: str | None = None,
) -> str:
    """Writes the sets below `out` and the truth to `truth`; returns the commitment.

    kinds: categories to make, empty for all. code: fingerprint of the analysis that the sets are meant for,
    noted beside them. Raises BadInput when either exists already, or the truth would lie inside `out`.
    """
    if out.exists() and any(out.iterdir()):
        raise BadInput(f"{out}: not empty: choose a new folder, sealed sets are never written over")
    if truth.exists():
        raise BadInput(f"{truth}: exists already: choose a new file, a truth is never written over")
    if out.resolve() in truth.resolve().parents:
        raise BadInput(f"{truth}: lies inside the sets: keep the truth where the analysis does not look")
    rng = np.random.default_rng(seed)
    specs = compose(rng, sets, nulls, kinds)
    if not specs:
        raise BadInput(f"{out}: no set to seal: give --sets or --nulls above 0")
    entries, manifest = [], {}
    out.mkdir(parents=True, exist_ok=True)
    write_atomically(truth, "")  # found out now, not after all sets, where it cannot be written
    truth.unlink()
    for i, spec in enumerate(specs):
        recordings, entry = make(spec, np.random.default_rng([seed, i]))
        write_set(out / spec.name, recordings)
        digest = set_hash(out / spec.name)
        entries.append({**entry, "sha256": digest})
        manifest[spec.name] = {
            "without": list(spec.without),
            "locate_only": spec.category == "locate",
            "sha256": digest,
        }
        progress(i + 1, len(specs))
    content = canonical({"schema": SCHEMA, "seed": seed, "salt": secrets.token_hex(16), "sets": entries})
    commitment = hashlib.sha256(content.encode()).hexdigest()
    write_atomically(truth, content)
    public = {"schema": SCHEMA, "truth_sha256": commitment, "code_sha256": code, "sets": manifest}
    write_atomically(out / "manifest.json", json.dumps(public, indent=1))
    return commitment


def make(spec: Spec, rng: np.random.Generator) -> tuple[list[Recording], dict[str, Any]]:
    """The recordings of one set and its entry in the truth."""
    for _ in range(_TRIES):
        design = draw_design(rng, spec.design, spec.reference)
        exposed = design.exposed()
        amplitudes = [reachable(name, multiple, design.camera, exposed) for name, multiple in spec.effects]
        if None not in amplitudes:
            break
    else:
        raise BadInput(f"{spec.effects}: no set of design {spec.design!r} shows it at a moderate strength")
    design = replace(design, engine=spec.engine)
    injected: list[dict[str, Any]] = []
    effects: list[Effect] = []
    for (name, multiple), amplitude in zip(spec.effects, amplitudes, strict=True):
        effects.append(effect(name, float(amplitude or 0)))
        unit = NAMES[name].unit if name in NAMES else unlisted_unit(name)
        least = reachable(name, 1.0, design.camera, exposed)
        injected.append(
            {
                "mechanism": name,
                "amplitude": amplitude,
                "unit": unit,
                "multiple": multiple,
                "mde": least,
                "where": facts(name, design.camera, SIZE),
            }
        )
    blank = None
    if spec.category in ("null", "curve"):
        blank = [m for m in CURVE if m != "rts" and reachable(m, 1.0, design.camera, exposed) is None]
    design, described, more = _mislead(spec.adversary, design, rng)
    recordings = [described(r) for r in record(design, (*effects, *more), rng)]
    camera = {k: v for k, v in asdict(design.camera).items() if k != "unit"}
    entry = {
        "set": spec.name,
        "category": spec.category,
        "effects": injected,
        "adversary": spec.adversary,
        "without": list(spec.without),
        "nothing_shows": blank,
        "design": spec.design,
        "reference": design.reference,
        "engine": design.engine,
        "camera": camera,
    }
    return recordings, entry


def set_hash(folder: Path) -> str:
    """SHA-256 over the names and contents of a set's files. Raises BadInput for a folder without files."""
    digest = hashlib.sha256()
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    for path in paths:
        digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    if not paths:
        raise BadInput(f"{folder}: no such set, or an empty one: bring back what bin/blind seal wrote")
    return digest.hexdigest()


def unlisted_unit(name: str) -> str:
    """Unit of an effect that the vocabulary does not hold."""
    return "1" if SCALES[name] == "signal" else "DN"


def _mislead(adversary: str | None, design: Design, rng: np.random.Generator):
    """A design, a way to describe recordings, and effects for something wrong outside the sensor."""

    def same(r: Recording) -> Recording:
        return r

    camera = design.camera
    if adversary == "misregistered":
        shift = (float(rng.uniform(0.15, 0.4)), float(rng.uniform(0.15, 0.4)))

        def moved(r: Recording) -> Recording:
            if r.kind != "scene" or r.clean is None:
                return r
            clean = np.array(r.clean, copy=True)
            for i in range(2):
                for j in range(
                    2
                ):  # each colour plane by itself; half the step, for planes are two pixels apart
                    plane = ndimage.shift(clean[i::2, j::2], (shift[0] / 2, shift[1] / 2), mode="nearest")
                    clean[i::2, j::2] = plane
            return replace(r, clean=clean)

        return design, moved, ()
    if adversary == "nyquist":
        shots = tuple(
            replace(s, clean=draw_scene(rng, SIZE, nyquist=0.4)) if s.kind == "scene" else s
            for s in design.shots
        )
        return replace(design, shots=shots), same, ()
    if adversary == "lamp_drift":
        return design, same, (effect("illumination_drift", 0.03),)
    if adversary == "short_burst":
        return replace(design, burst=8), same, ()
    if adversary == "wrong_black":
        off = float(rng.choice((-1, 1))) * max(0.3 * camera.read_e * camera.gain, camera.step)
        black = tuple(b + off for b in camera.black)
        return design, lambda r: replace(r, black_level=black), ()
    if adversary == "wrong_white":
        return design, lambda r: replace(r, white_level=camera.white * 1.1), ()
    return design, same, ()


def canonical(value: Any) -> str:
    """JSON with sorted keys and no spare blanks, so that equal values have equal hashes."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def write_atomically(path: Path, text: str) -> None:
    """Writes a text file all at once, or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.{os.getpid()}.part")  # shards may end at the same moment
    try:
        part.write_text(text)
        os.replace(part, path)
    finally:
        part.unlink(missing_ok=True)
