"""What bin/sample does: clean images and a reference in, noisy frames as a camera stores them out."""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from cannoise_jax.commands.entry import counted, progress
from cannoise_jax.commands.pulse import now_at
from cannoise_jax.commands.sample_target import Target, overrides, target_of
from cannoise_jax.recordings.atomic import new_folder, one_work
from cannoise_jax.recordings.load import load_recording, recording_paths
from cannoise_jax.recordings.native import write_recording
from cannoise_jax.recordings.opened import BROKEN_ARRAYS
from cannoise_jax.recordings.packing import to_mosaic_order
from cannoise_jax.recordings.recording import (
    BadInput,
    PerChannel,
    Recording,
    mosaic_map,
    per_channel,
    printable,
)
from cannoise_jax.recordings.references import mean_frame
from cannoise_jax.recordings.unfinished import is_finished

_RANGE = (-0.05, 1.5)
"""Least and largest value of a clean array: what lies beyond is no normalised signal, but codes."""


@dataclass(frozen=True, eq=False)
class Clean:
    """A clean mosaic `[H, W]`, normalised, and the recording that it came from, if any."""

    path: Path
    image: Float[np.ndarray, "h w"]
    cfa: str
    recording: Recording | None


def synthesise(arguments: argparse.Namespace) -> list[Path]:
    """Writes one native file per clean image and returns their paths.

    All inputs are read before the first file is written. Raises BadInput.
    """
    now_at("loading libraries")
    import jax  # only here: flags are checked, and --help answered, without waiting for it

    from cannoise_jax.model_file import load_model
    from cannoise_jax.tiles import sample_mosaic

    now_at("reading the model and the reference")
    model = load_model(arguments.model)
    target = target_of(arguments, model)
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
    _say_unused(arguments, sources, target)
    pixels, done = arguments.frames * sum(source.image.size for source in sources), 0

    def told(count: int) -> None:
        nonlocal done
        done += count
        tell(done, pixels)

    with new_folder(arguments.out), one_work(outputs):
        for i, (source, path, (black, white)) in enumerate(zip(sources, outputs, levels, strict=True)):
            tell(done, pixels, path.name)
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
    paths = recording_paths(path)
    return [_clean_image(p, arguments, cfa) for p in counted(paths, "reading clean images")]


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
    return _from_recording(load_recording(path, **overrides(arguments)))


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


def _say_unused(arguments, sources: list[Clean], target: Target) -> None:
    """Says which levels the caller states change nothing: clean images that are normalised have none, and a
    reference that states its own is written with them."""
    normalised = all(s.recording is None or s.recording.clean is not None for s in sources)
    given = [n for n in ("black_level", "white_level") if getattr(arguments, n) is not None]
    unused = [n for n in given if normalised and n in target.states]
    if unused:
        flags = " and ".join(f"--{n.replace('_', '-')}" for n in unused)
        line = f"{flags}: not used: the clean images are normalised, and {arguments.reference} has levels"
        instead = f"--reference-{unused[0].replace('_', '-')} replaces them"
        print(f"bin/sample: {printable(line)} of its own, which {instead}", file=sys.stderr)


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
