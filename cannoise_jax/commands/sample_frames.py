"""What bin/sample does: clean images and a reference in, noisy frames as a camera stores them out."""

from __future__ import annotations

import argparse
import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from cannoise_jax.commands.entry import progress
from cannoise_jax.recordings.atomic import new_folder, one_work
from cannoise_jax.recordings.codes import detect_code_step
from cannoise_jax.recordings.load import load_recording, open_file, recording_paths
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.opened import BROKEN_ARRAYS
from cannoise_jax.recordings.packing import pack, to_mosaic_order, to_packed_order
from cannoise_jax.recordings.recording import (
    DARK,
    BadInput,
    PerChannel,
    Recording,
    mosaic_map,
    per_channel,
)
from cannoise_jax.recordings.references import mean_frame
from cannoise_jax.recordings.unfinished import is_finished

_PATCH, _PATCHES = 64, 16
"""Reference patches: side in packed pixels, as in training, and how many of a recording, on a 4x4 grid."""
_RANGE = (-0.05, 1.5)
"""Least and largest value of a clean array: what lies beyond is no normalised signal, but codes."""


@dataclass(frozen=True, eq=False)
class Clean:
    """A clean mosaic `[H, W]`, normalised, and the recording that it came from, if any."""

    path: Path
    image: Float[np.ndarray, "h w"]
    cfa: str
    recording: Recording | None


@dataclass(frozen=True, eq=False)
class Target:
    """The camera and setting to imitate. reference: packed `[n, h, w, 4]`; nlf: shot and read, packed order;
    given: whether these are stated somewhere, or else estimated from the reference."""

    camera: str
    iso: float | None
    reference: Float[np.ndarray, "n h w 4"]
    nlf: tuple[Any, Any]
    given: bool
    black_level: PerChannel | None = None
    white_level: float | None = None
    code_step: float = 1.0
    cfa: str | None = None


def synthesise(arguments: argparse.Namespace) -> list[Path]:
    """Writes one native file per clean image and returns their paths.

    All inputs are read before the first file is written. Raises BadInput.
    """
    import jax  # only here: flags are checked, and --help answered, without waiting for it

    from cannoise_jax.sampling import load_model
    from cannoise_jax.tiles import sample_mosaic

    model = load_model(arguments.model)
    target = _target(arguments, model)
    if model.level == "estimated":
        if arguments.reference in model.cameras:
            raise BadInput(
                f"{arguments.reference}: this model reads the level off references of one setting: "
                "name a recording instead of a camera"
            )
        target = dataclasses.replace(target, given=False)
    if model.level == "given" and not target.given:
        raise BadInput(
            f"{arguments.reference}: this model must be told shot and read, which the file does not state: "
            "use a file that does, or a model trained with config.level=both"
        )
    model = _own_sensor(model, target.camera)
    sources = _clean_images(arguments, target.cfa)
    outputs = [arguments.out / f"{source.path.stem}_{target.camera}.h5" for source in sources]
    levels = [_levels(arguments, source, target) for source in sources]
    if len(set(outputs)) < len(outputs):
        raise BadInput(
            f"{arguments.clean}: two files of one name would be written to one: rename one of them"
        )
    for path in outputs:
        if is_finished(path) and not arguments.force:
            raise BadInput(f"{path}: exists: name another folder, or replace it with --force")
    tell = progress("sampling pixels")
    pixels, done = arguments.frames * sum(source.image.size for source in sources), 0

    def told(count: int) -> None:
        nonlocal done
        done += count
        tell(done, pixels)

    with new_folder(arguments.out), one_work(outputs):
        for i, (source, path, (black, white)) in enumerate(zip(sources, outputs, levels, strict=True)):
            frames = []
            for t in range(arguments.frames):
                key = jax.random.fold_in(jax.random.fold_in(jax.random.key(arguments.seed), i), t)
                noise = sample_mosaic(
                    model, key, source.image, source.cfa, target.reference,
                    target.nlf if target.given else None, progress=told,
                )  # fmt: skip
                frames.append(_codes(source.image + noise, black, white, target.code_step))
            shot, read = (
                per_channel(np.asarray(to_mosaic_order(np.broadcast_to(v, 4), source.cfa)))
                for v in target.nlf
            )
            write_recording(
                path,
                Recording(
                    np.stack(frames), source.cfa, black, white, target.camera, clean=source.image,
                    iso=target.iso, shot=shot, read=read, code_step=target.code_step, reference="independent",
                ),
            )  # fmt: skip
    return outputs


def _own_sensor(model, camera: str):
    from cannoise_jax.sampling import of_camera

    try:
        return of_camera(model, camera)
    except ValueError as error:
        raise BadInput(f"{error}: use a reference of one of them") from error


def _codes(mosaic, black, white, step):
    """DN as a camera stores them: rounded to its codes, cut at 0 and at the white level; below black is
    kept."""
    dark = mosaic_map(black, mosaic.shape)
    return np.clip(np.rint((dark + mosaic * (white - dark)) / step) * step, 0, white).astype(np.uint16)


def _clean_images(arguments, cfa: str | None) -> list[Clean]:
    """cfa: the colour order of the reference, for arrays, which state none."""
    path: Path = arguments.clean
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder")
    if not path.is_dir():
        return [_clean_image(path, arguments, cfa)]
    return [_clean_image(p, arguments, cfa) for p in recording_paths(path)]


def _clean_image(path: Path, arguments, cfa: str | None) -> Clean:
    """A floating-point NPY mosaic as it is; anything else as a recording."""
    if path.suffix.lower() == ".npy":
        try:
            image = np.load(path, allow_pickle=False)
        except BROKEN_ARRAYS as error:
            raise BadInput(f"{path}: not a readable NPY file") from error
        if np.issubdtype(image.dtype, np.floating):
            if image.ndim != 2:
                raise BadInput(f"{path}: shape {image.shape}: expected one clean mosaic, [H, W]")
            if np.any((image < _RANGE[0]) | (image > _RANGE[1])):  # NaN has its own words
                raise BadInput(
                    f"{path}: values from {np.nanmin(image):g} to {np.nanmax(image):g}: a clean mosaic is "
                    "(DN - black) / (white - black), from 0 to 1"
                )
            return _checked(Clean(path, image.astype(np.float32), arguments.cfa or cfa or "RGGB", None))
    return _from_recording(load_recording(path, **_overrides(arguments)))


def _from_recording(recording: Recording) -> Clean:
    """Its clean signal (the first, where each frame has one), else the mean of its frames."""
    if recording.clean is not None:
        image = np.asarray(recording.clean)
        image = image[0] if image.ndim == 3 else image
    else:
        image = mean_frame(recording)
    path = Path(recording.path or recording.camera)
    return _checked(Clean(path, np.asarray(image, np.float32), recording.cfa, recording))


def _checked(clean: Clean) -> Clean:
    height, width = clean.image.shape
    if height % 2 or width % 2:
        raise BadInput(f"{clean.path}: {height} x {width} pixels: a mosaic has even sizes: crop it")
    if min(height, width) < 32:
        raise BadInput(f"{clean.path}: {height} x {width} pixels: at least 32 x 32 are needed")
    if not np.all(np.isfinite(clean.image)):
        raise BadInput(f"{clean.path}: holds NaN or infinite values: replace them")
    return clean


def _target(arguments, model) -> Target:
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
    if Path(name).is_file():  # the flags of the clean images fill in what the file leaves out
        silent = {k for k in stated if open_file(Path(name)).known.get(k) is None}
        stated |= {k: v for k, v in _overrides(arguments).items() if k in silent and stated[k] is None}
        if missing := [k for k in stated if k in silent and stated[k] is None]:
            flags = ", ".join(f"--reference-{k.replace('_', '-')}" for k in missing)
            raise BadInput(
                f"{name}: does not state {', '.join(missing).replace('_', ' ')}: set it with {flags}"
            )
    return _target_recording(load_recording(name, **stated), iso)


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


def _levels(arguments, source: Clean, target: Target) -> tuple[PerChannel, float]:
    """Black and white level of what is written: of the reference, from the flags, or of the clean one."""
    own = source.recording
    blacks = (target.black_level, arguments.black_level, own.black_level if own else None)
    whites = (target.white_level, arguments.white_level, own.white_level if own else None)
    black_level = next((v for v in blacks if v is not None), None)
    white = next((v for v in whites if v is not None), None)
    if black_level is None or white is None:
        raise BadInput(f"{source.path}: levels unknown: add --black-level and --white-level (DN)")
    black = per_channel(black_level)
    if not max(black) < white <= 65535:
        raise BadInput(
            f"{source.path}: black level {max(black):g}, white level {white:g}: expected black < white"
        )
    return black, float(white)


def _overrides(arguments) -> dict[str, Any]:
    names = ("cfa", "black_level", "white_level")
    return {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
