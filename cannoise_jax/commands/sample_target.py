"""The camera and setting that bin/sample imitates: a camera of the model, or a recording."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cannoise_jax.recordings.codes import detect_code_step
from cannoise_jax.recordings.load import load_recording, open_file
from cannoise_jax.recordings.packing import pack, to_packed_order
from cannoise_jax.recordings.recording import DARK, BadInput, PerChannel, Recording

_PATCH, _PATCHES = 64, 16
"""Reference patches: side in packed pixels, as in training, and how many of a recording, on a 4x4 grid."""


@dataclass(frozen=True, eq=False)
class Target:
    """The camera and setting to imitate. reference: packed `[n, h, w, 4]`; nlf: shot and read, packed order;
    given: whether these are stated somewhere, or else estimated from the reference. states: which levels the
    reference has of its own, and not from the flags of the clean images."""

    camera: str
    iso: float | None
    reference: Float[np.ndarray, "n h w 4"]
    nlf: tuple[Any, Any]
    given: bool
    black_level: PerChannel | None = None
    white_level: float | None = None
    code_step: float = 1.0
    cfa: str | None = None
    states: frozenset[str] = frozenset()


def target_of(arguments, model) -> Target:
    """The target that --reference and --iso name. Raises BadInput."""
    name, iso = arguments.reference, arguments.iso
    if name in model.cameras:
        camera = model.cameras[name]
        known = ", ".join(sorted(camera.settings, key=float))
        if iso is None:
            raise BadInput(f"--iso: not set: {name} is known at ISO {known}")
        found = [s for key, s in camera.settings.items() if float(key) == iso]
        if not found:
            raise BadInput(f"--iso {iso:g}: {name} is known at ISO {known}")
        nlf = (np.asarray(found[0].shot), np.asarray(found[0].read))
        return Target(name, iso, np.asarray(camera.reference), nlf, True)
    if not Path(name).exists():
        cameras = ", ".join(model.cameras) or "none"
        raise BadInput(f"{name}: neither a file nor a camera of the model, which are {cameras}")
    stated = {
        "cfa": arguments.reference_cfa,
        "black_level": arguments.reference_black_level,
        "white_level": arguments.reference_white_level,
    }
    states = set(stated)
    if Path(name).is_file():  # the flags of the clean images fill in what the file leaves out
        silent = {k for k in stated if open_file(Path(name)).known.get(k) is None}
        filled = {k: v for k, v in overrides(arguments).items() if k in silent and stated[k] is None}
        stated, states = stated | filled, states - filled.keys()
        if missing := [k for k in stated if k in silent and stated[k] is None]:
            flags = ", ".join(f"--reference-{k.replace('_', '-')}" for k in missing)
            raise BadInput(
                f"{name}: does not state {', '.join(missing).replace('_', ' ')}: set it with {flags}"
            )
    target = _target_recording(load_recording(name, **stated), iso)
    return dataclasses.replace(target, states=frozenset(states))


def _target_recording(recording: Recording, iso: float | None) -> Target:
    import jax.numpy as jnp

    from cannoise_jax.physics.single_image import estimate_nlf
    from cannoise_jax.sampling import repeated

    if iso is not None and recording.iso is not None and recording.iso != iso:
        raise BadInput(
            f"{recording.path}: recorded at ISO {recording.iso:g}: a reference sets the ISO, leave --iso"
        )
    height, width = (size // 2 for size in recording.size)
    if min(height, width) < 1:
        raise BadInput(f"{recording.path}: {recording.size[0]} x {recording.size[1]} pixels: no 2 x 2 fits")
    patches = []
    side = (min(_PATCH, height), min(_PATCH, width))
    dark = recording.black_map()
    for i in range(_PATCHES):
        frame = np.asarray(recording.frames[i * recording.count // _PATCHES][None])[0].astype(np.float32)
        packed = pack(
            ((frame - dark) / (recording.white_level - dark))[: 2 * height, : 2 * width], recording.cfa
        )
        y, x = ((size - s) * p // 3 for size, s, p in zip((height, width), side, divmod(i, 4), strict=True))
        patches.append(packed[y : y + side[0], x : x + side[1]])
    reference = np.stack(patches)
    given = recording.shot is not None and recording.read is not None
    if recording.shot is not None and recording.read is not None:
        # Metadata may state a read noise below 0: as everywhere, it counts as none.
        stated = (recording.shot, tuple(max(v, 0.0) for v in recording.read))
        nlf = tuple(np.asarray(to_packed_order(v, recording.cfa)) for v in stated)
    elif recording.kind in DARK:
        raise BadInput(
            f"{recording.path}: a {recording.kind} frame shows no shot noise: use a lit recording, or one "
            "that states shot and read"
        )
    else:
        nlf = tuple(np.asarray(v) for v in estimate_nlf(repeated(jnp.asarray(reference))))
    step = recording.code_step or detect_code_step(np.asarray(recording.frames[:1])) or 1.0
    return Target(
        recording.camera, recording.iso or iso, reference, (nlf[0], nlf[1]), given, recording.black_level,
        recording.white_level, step, recording.cfa,
    )  # fmt: skip


def overrides(arguments) -> dict[str, Any]:
    """What the flags state of the clean images."""
    names = ("cfa", "black_level", "white_level")
    return {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
