"""bin/simulate: raw recordings of a camera model, or the catalogue of mechanisms as one page.

bin/simulate --sensor sensor.json --clean IMAGE|DIR|flat:0.2|dark --frames 8 --iso 800 --out DIR
bin/simulate --catalogue --out catalogue.html
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
import sys
import warnings
import zlib
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cannoise_jax.commands.entry import command, progress, show_warnings
from cannoise_jax.commands.outputs import check_file, line_of
from cannoise_jax.commands.parser import (
    OneLineParser,
    above_zero,
    add_mechanisms_flag,
    celsius,
    decibels,
    place,
    seconds,
    seed,
)
from cannoise_jax.commands.pulse import now_at
from cannoise_jax.recordings.recording import BadInput, gain_of_iso, iso_of_gain

if TYPE_CHECKING:
    import jax
    import numpy as np

    from cannoise_jax.commands.scenes import Clean
    from cannoise_jax.physics.core.sensor import SensorModel, Settings
    from cannoise_jax.recordings.recording import Recording

_MOST_FRAMES = 10_000


@command("simulate")
def main(argv: list[str] | None = None) -> int:
    """Writes native recordings or the catalogue; returns 0, or 2 after one line on stderr."""
    arguments = _parser().parse_args(argv)
    show_warnings("simulate")
    try:
        if arguments.catalogue:
            from cannoise_jax.mechanisms.catalogue import write_catalogue
            from cannoise_jax.recordings.atomic import new_folder

            check_file(arguments.out, ".html", arguments.force)
            with new_folder(arguments.out.parent):
                write_catalogue(arguments.out, tell=progress("drawing mechanisms"))
            print(f"{arguments.out}: the catalogue of mechanisms")
            return 0
        for path, recording in _recordings(arguments):
            print(line_of(path, recording))
    except BadInput as error:
        print(f"bin/simulate: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(prog="bin/simulate", description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--sensor", metavar="FILE", help="a sensor.json, or preset:NAME")
    add_mechanisms_flag(parser, "entries of your own that the sensor names")
    add("--clean", metavar="SCENE", help="a picture, .npy or .h5 file, a folder of them, flat:LEVEL, or dark")
    add(
        "--out",
        metavar="PATH",
        type=place,
        required=True,
        help="folder for the recordings, SCENE_isoISO_EXPOSUREs.h5, or the page's file",
    )
    add("--frames", type=int, default=1, help="frames per recording (default 1)")
    add("--force", action="store_true", help="replace recordings that exist")
    gain = parser.add_mutually_exclusive_group()
    gain.add_argument("--iso", type=above_zero, help="default: the first calibrated ISO")
    gain.add_argument(
        "--gain",
        type=decibels,
        metavar="DB",
        help="for --iso, of a camera that counts its gain in dB",
    )
    add("--exposure", type=seconds, default=0.01, metavar="S", help="exposure time in seconds (default 0.01)")
    add("--temperature", type=celsius, metavar="C", help="degrees Celsius (default: that of the calibration)")
    add(
        "--size",
        type=_size,
        metavar="HxW",
        help="of flats and darks (default: of the stored maps, or 512x512)",
    )
    add(
        "--seed",
        type=seed,
        default=0,
        help="of the noise (default 0), which differs between names",
    )
    add("--unit", type=seed, help="another unit of the camera, by number: other frozen patterns")
    add(
        "--steady-light",
        action="store_true",
        help="without the light and references of the recordings",
    )
    add("--catalogue", action="store_true", help="write the page that explains every mechanism")
    return parser


def _size(text: str) -> tuple[int, int]:
    try:
        height, width = (int(v) for v in text.lower().split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size: write HEIGHTxWIDTH, as 512x512") from None
    if not (2 <= height <= 2**15 and 2 <= width <= 2**15):
        raise argparse.ArgumentTypeError(f"{text}: sides must be 2 to 32768 pixels")
    return height, width


def _recordings(arguments: argparse.Namespace) -> Iterator[tuple[Path, Recording]]:
    """Draws and writes one recording per clean mosaic."""
    if not arguments.sensor or not arguments.clean:
        raise BadInput("give --sensor and --clean, or --catalogue")
    if not 1 <= arguments.frames <= _MOST_FRAMES:
        raise BadInput(f"--frames {arguments.frames}: must be from 1 to {_MOST_FRAMES}")
    now_at("loading libraries")
    import jax
    import numpy as np

    from cannoise_jax.commands.drawing import Drawing
    from cannoise_jax.commands.scenes import scenes
    from cannoise_jax.physics.core.sensor import Settings
    from cannoise_jax.recordings.atomic import new_folder, one_work
    from cannoise_jax.recordings.native import write_recording
    from cannoise_jax.recordings.unfinished import is_finished

    now_at("reading the camera model and the scenes")
    model = _sensor(arguments.sensor, arguments.mechanisms)
    if arguments.steady_light:
        model = model.under_steady_light()
    if arguments.unit is not None:
        model = model.with_unit(jax.random.key(arguments.unit))
    iso, decibels = _asked(arguments, float(np.asarray(model.iso)[0]))
    _check_noise(model, iso, f"--iso {iso:.9g}" if decibels is None else f"--gain {decibels:g}")
    settings = Settings(iso, arguments.exposure, arguments.temperature, arguments.frames)
    clean_scenes = scenes(arguments.clean, model.cfa, arguments.size or _stored_size(model))
    paths = [arguments.out / _name(clean, settings, decibels, arguments.unit) for clean in clean_scenes]
    for clean, path in zip(clean_scenes, paths, strict=True):
        height, width = clean.values.shape
        if model.cfa != "MONO" and (height % 2 or width % 2):
            raise BadInput(
                f"{clean.name}: {height} x {width} pixels: a {model.cfa} mosaic has even sizes: crop it"
            )
        if is_finished(path) and not arguments.force:
            raise BadInput(f"{path}: exists: name another folder, or replace it with --force")
    for size in {clean.values.shape for clean in clean_scenes}:
        # Raises BadInput where the unit's measured maps are of another size; draws nothing.
        jax.eval_shape(lambda size=size: model.with_maps(size).mechanisms)
    key, tell = jax.random.key(arguments.seed), progress("drawing recordings")
    drawing = Drawing()
    with new_folder(arguments.out), one_work(paths):
        for number, (clean, path) in enumerate(zip(clean_scenes, paths, strict=True)):
            tell(number, len(clean_scenes), path.name)
            # By name, so that a dark and a flat of two calls have no noise in common.
            own = jax.random.fold_in(key, zlib.crc32(path.name.encode()))
            draw = partial(_drawn, model, own, clean, settings)
            with drawing.told(path.name, settings.frames, clean.values.size, draw):
                recording = dataclasses.replace(record(model, own, clean, settings), gain_db=decibels)
            write_recording(path, recording, progress(f"writing frames of {path.name}", alone=False))
            yield path, recording
            tell(number + 1, len(clean_scenes))


def _asked(arguments: argparse.Namespace, first: float) -> tuple[float, float | None]:
    """The ISO to simulate, and the gain in dB where that is what was asked for, or what the camera counts its
    first setting in."""
    if arguments.gain is not None:
        return iso_of_gain(arguments.gain), arguments.gain
    return (first, gain_of_iso(first)) if arguments.iso is None else (arguments.iso, None)


def _check_noise(model: SensorModel, iso: float, asked: str) -> None:
    """Raises BadInput for a setting so far off those of the calibration that its noise is no camera's."""
    import numpy as np

    from cannoise_jax.recordings.stated_values import MOST_NLF

    if max(float(np.max(v)) for v in _noise_at(model, iso)) > MOST_NLF:
        isos = np.asarray(model.iso)
        ends = [gain_of_iso(float(iso)) for iso in (isos.min(), isos.max())]
        known = f"ISO {isos.min():g} to {isos.max():g}"
        known = known if None in ends else f"gains of {ends[0]:g} to {ends[1]:g} dB (--gain)"
        raise BadInput(
            f"{asked}: the noise of {model.camera} would there be wider than its whole range: it is "
            f"calibrated at {known}, name one not far off"
        )


def _noise_at(model: SensorModel, iso: float) -> tuple[np.ndarray, np.ndarray]:
    """Shot and read of every site, normalised, as the baseline has them."""
    import jax.numpy as jnp
    import numpy as np

    from cannoise_jax.physics.core.poisson_gaussian import nlf_from_electrons
    from cannoise_jax.physics.core.settings import baseline_at, black_at

    gain, read_noise = (np.asarray(v) for v in baseline_at(model, iso))
    span = jnp.asarray(model.white_level) - np.asarray(black_at(model, iso))
    shot, read = nlf_from_electrons(gain, read_noise, span)
    return np.asarray(shot), np.asarray(read)


def _name(clean: Clean, settings: Settings, decibels: float | None, unit: int | None) -> str:
    """The file of a recording: scene and setting, so that those of several settings lie side by side."""
    gain = f"iso{settings.iso:g}" if decibels is None else f"gain{decibels:g}dB"
    parts = [clean.name, gain, f"{settings.exposure_s:g}s"]
    parts += [] if settings.temperature_c is None else [f"{settings.temperature_c:g}C"]
    parts += [] if unit is None else [f"unit{unit}"]
    return "_".join(parts) + ".h5"


def record(model: SensorModel, key: jax.Array, clean: Clean, settings: Settings) -> Recording:
    """A recording of one clean mosaic: frames, and in `clean`, `shot` and `read` what the baseline
    expects."""
    import numpy as np

    from cannoise_jax.physics.core.settings import black_at
    from cannoise_jax.recordings.recording import Recording, per_channel

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        frames = np.asarray(model.sample(key, clean.values, settings))
    for warning in caught:
        if str(warning.category.__module__).startswith("cannoise_jax"):
            logging.warning("%s", warning.message)
    shot, read = _noise_at(model, settings.iso)
    black = np.asarray(black_at(model, settings.iso))
    return Recording(
        frames=frames,
        cfa=model.cfa,
        black_level=per_channel(black),
        white_level=float(np.asarray(model.white_level)),
        camera=model.camera,
        kind=clean.kind,
        clean=clean.values,
        iso=settings.iso,
        exposure_s=settings.exposure_s,
        temperature_c=settings.temperature_c,
        shot=per_channel(shot),
        read=per_channel(read),
        code_step=float(np.asarray(model.code_step)),
        reference="independent" if clean.kind == "scene" else None,
    )


def _drawn(model: SensorModel, key: jax.Array, clean: Clean, settings: Settings, frames: int) -> None:
    """Draws so many frames and drops them: how long that takes is wanted."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.sample(key, clean.values, dataclasses.replace(settings, frames=frames)).block_until_ready()


def _stored_size(model: SensorModel) -> tuple[int, int]:
    """The size of the maps that were measured on a unit; 512 x 512 without any."""
    shapes = [(1, 1), *(m.shape[-2:] for f in model.mechanisms for m in f.maps.values())]
    height, width = (max(shape[axis] for shape in shapes) for axis in (0, 1))
    return height if height > 1 else 512, width if width > 1 else 512


def _sensor(name: str, places: Sequence[str]) -> SensorModel:
    from cannoise_jax.mechanisms.outside import entries_of
    from cannoise_jax.physics.core.sensor import SensorModel

    if name.startswith("preset:"):
        return SensorModel.preset(name.removeprefix("preset:"))
    return SensorModel.load(name, entries_of(places))


if __name__ == "__main__":
    sys.exit(main())
