"""What a workdir of bin/denoise holds already, and whether it is of the same recordings and settings.

Denoisers differ in a table by their noise model alone; of other recordings they would be tested on pixels
that they were trained on, and in no message would it show.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.denoise_sources import slug
from cannoise_jax.commands.outputs import make_folder
from cannoise_jax.recordings.atomic import texts_in_place
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.recordings.recording import CaptureSet
    from cannoise_jax.training.denoise import Denoiser, Recipe

STAMP, FULL_SCALE, GENERATOR_STEPS = "recordings_sha256", "full_scale_e", "generator_steps"
"""What a denoiser tells about itself: `denoise_data.stamp` of its recordings, and flags of its training."""
_FLAGS = {
    "steps": "--steps", "features": "--features", "batch_size": "--batch", "scenes": "--scenes",
    FULL_SCALE: "--full-scale", GENERATOR_STEPS: "--generator-steps",
}  # fmt: skip


def capture_of(place: Path, stated: Mapping[str, Any]) -> CaptureSet:
    """The recordings of a folder without the frames that show no noise, which are said. stated: what flags
    say of all."""
    from cannoise_jax.recordings.load import load_capture_set
    from cannoise_jax.recordings.usable import usable

    capture, left_out = usable(load_capture_set(place, **stated))
    for line in left_out:
        print(f"bin/denoise: {line}", file=sys.stderr, flush=True)
    return capture


def folder_of(workdir: Path, camera: str, exposure_s: float) -> Path:
    """Where the denoisers of a camera and an exposure lie."""
    return workdir / "denoisers" / f"{slug(camera)}_{exposure_s:g}s"


def sound_denoisers(folder: Path, again: Iterable[Path]) -> dict[Path, Denoiser]:
    """The denoisers of a folder that can be read. Of the others those of `again` are said: they are trained
    again."""
    from cannoise_jax.training.denoise import load_denoiser

    found = {}
    wanted = set(again)
    for path in sorted(folder.glob("*.npz")):
        try:
            found[path] = load_denoiser(path)
        except BadInput:
            if path in wanted:
                print(f"bin/denoise: {path}: not a readable denoiser: trained again", file=sys.stderr)
    return found


def settings_of(recipe: Recipe, about: Mapping[str, Any]) -> dict[str, Any]:
    """What denoisers of one table must have in common, but for their noise model and seed."""
    own = {name: about[name] for name in (FULL_SCALE, GENERATOR_STEPS) if name in about}
    return {**asdict(recipe), **own}


def check_wanted(found: Mapping[Path, Denoiser], wanted: Mapping[str, Any]) -> None:
    """Raises BadInput for a denoiser of other settings than those that are asked for."""
    for path, denoiser in found.items():
        own = settings_of(denoiser.recipe, denoiser.about)
        for name in (n for n in wanted if n in own and own[n] != wanted[n]):
            flag = _FLAGS.get(name)
            instead = f"give {flag} {_said(own[name])}, or " if flag else "name "
            raise BadInput(
                f"{path}: was trained with {flag or name} {_said(own[name])}, not {_said(wanted[name])}: "
                f"{instead}another --workdir"
            )


def check_alike(found: Mapping[Path, Denoiser]) -> None:
    """Raises BadInput where denoisers of one table were trained with different settings."""
    seen: dict[str, tuple[Any, Path]] = {}
    for path, denoiser in found.items():
        for name, own in settings_of(denoiser.recipe, denoiser.about).items():
            other, first = seen.setdefault(name, (own, path))
            if own != other:
                raise BadInput(
                    f"{path}: was trained with {_FLAGS.get(name, name)} {_said(own)}, {first.name} with "
                    f"{_said(other)}: give each setting a workdir of its own"
                )


def check_recordings(found: Mapping[Path, Denoiser], stamp: str) -> None:
    """Raises BadInput for a denoiser that was trained on other recordings, or does not say on which."""
    for path, denoiser in found.items():
        own = denoiser.about.get(STAMP)
        if own != stamp:
            if own is None:
                raise BadInput(f"{path}: states no recordings (an older version): name another --workdir")
            raise BadInput(f"{path}: was trained on other recordings: name those, or another --workdir")


def check_workdir(workdir: Path, camera: str, stamp: str) -> None:
    """Raises BadInput where camera models and generators of a workdir were fitted to other recordings of a
    camera of this name."""
    path = _record(workdir, camera)
    if not path.exists():
        return
    try:
        own = json_of(path.read_text(encoding="utf-8"))[STAMP]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise BadInput(f"{path}: not readable: name another --workdir") from error
    if own != stamp:
        raise BadInput(
            f"{path}: {workdir} is of other recordings of {camera}: name those, or another --workdir"
        )


def record_recordings(workdir: Path, camera: str, stamp: str) -> None:
    """Writes what `check_workdir` reads, before anything is fitted."""
    path = _record(workdir, camera)
    if not path.exists():
        make_folder(workdir)
        with texts_in_place({path: json.dumps({"camera": camera, STAMP: stamp}, indent=1) + "\n"}):
            pass


def _record(workdir: Path, camera: str) -> Path:
    return workdir / f"recordings_{slug(camera)}.json"


def _said(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
