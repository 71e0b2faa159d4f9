"""bin/denoise train|test|apply: denoisers trained on noise models, judged on real darks.

bin/denoise train --recordings DIR --workdir RUN [--noise pg,calibrated,real_darks] [--exposure 0.1,10,100]
bin/denoise test --recordings DIR --workdir RUN
bin/denoise apply --denoiser FILE --recording FILE --out FILE
"""

from __future__ import annotations

import argparse
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

from cannoise_jax.commands.denoise_judge import judge
from cannoise_jax.commands.denoise_kept import (
    FULL_SCALE,
    GENERATOR_STEPS,
    STAMP,
    capture_of,
    check_recordings,
    check_wanted,
    check_workdir,
    folder_of,
    record_recordings,
    settings_of,
    sound_denoisers,
)
from cannoise_jax.commands.denoise_sources import (
    check_sources,
    generators_of,
    is_refined,
    labels_of,
    sensors_of,
)
from cannoise_jax.commands.entry import command
from cannoise_jax.commands.freed_memory import give_back_large
from cannoise_jax.commands.outputs import check_file, check_folder, make_folder
from cannoise_jax.commands.parser import (
    OneLineParser,
    add_level_flags,
    add_mechanisms_flag,
    count,
    folder,
    overrides,
    place,
    seconds,
)
from cannoise_jax.recordings.atomic import file_in_place, new_folder
from cannoise_jax.recordings.recording import BadInput

_DEFAULT = "gaussian,gaussian_pooled,pg,pg_at_exposure,pg_estimated,random_phase,calibrated,real_darks"
_TEST_SCENES = 16


@command("denoise")
def main(argv: list[str] | None = None) -> int:
    """Returns 0, 1 for a loss that is not finite, or 2 after one line when something cannot be used."""
    arguments = sys.argv[1:] if argv is None else argv
    parsed = _parser().parse_args(arguments)
    try:
        {"train": _train, "test": judge, "apply": _apply}[parsed.verb](parsed, arguments)
    except BadInput as error:
        print(f"bin/denoise: {error}", file=sys.stderr)
        return 2
    except FloatingPointError as error:
        print(f"bin/denoise: {error}", file=sys.stderr)
        return 1
    return 0


def _train(arguments, argv) -> None:
    """One denoiser for every exposure, noise model and seed that the workdir has not yet."""
    import jax
    from tqdm import tqdm

    from cannoise_jax.mechanisms.outside import entries_of
    from cannoise_jax.training.denoise import Recipe, check_size, save_denoiser, train_denoiser
    from cannoise_jax.training.denoise_data import dim_scenes, half_real, stamp
    from cannoise_jax.training.noise_sources import open_source

    recipe = Recipe(
        steps=arguments.steps,
        features=arguments.features,
        batch_size=arguments.batch,
        scenes=arguments.scenes,
    )
    check_folder(arguments.workdir, (), force=True)
    labels = labels_of(arguments.noise)
    entries = entries_of(arguments.mechanisms)
    check_sources(labels, entries)
    capture = capture_of(arguments.recordings, overrides(arguments))
    every = {exposure: half_real(capture, exposure, arguments.full_scale) for exposure in arguments.exposure}
    for data in every.values():
        check_size(data.train.shape[1:], recipe)
    own, of = stamp(capture), {FULL_SCALE: arguments.full_scale, GENERATOR_STEPS: arguments.generator_steps}
    check_workdir(arguments.workdir, capture.camera, own)
    made: set[Path] = set()
    for exposure in every:
        folder = folder_of(arguments.workdir, capture.camera, exposure)
        names = [folder / f"{label}_{seed}.npz" for label in labels for seed in range(arguments.seeds)]
        found = sound_denoisers(folder, names)
        check_recordings(found, own)
        check_wanted(found, settings_of(recipe, of))
        made |= found.keys()
    record_recordings(arguments.workdir, capture.camera, own)
    sensors = sensors_of(labels, capture, arguments.workdir)
    for exposure, data in every.items():
        folder = folder_of(arguments.workdir, data.camera, exposure)
        clean = None
        for label, name in labels.items():
            source = None
            for seed in range(arguments.seeds):
                path = folder / f"{label}_{seed}.npz"
                if path in made:
                    continue
                if clean is None:
                    clean = dim_scenes(
                        jax.random.key(1), "train", recipe.scenes, data.train.shape[1:], data.cfa
                    )
                if source is None:
                    generators = generators_of(name, data, sensors, arguments)
                    source = open_source(name, data, sensors, generators, entries)
                started = time.monotonic()
                about: dict[str, Any] = {
                    "noise": label, "seed": seed, "camera": data.camera, "exposure_s": exposure,
                    FULL_SCALE: data.full_scale_e, "gain_dn_per_e": data.gain_dn_per_e, "cfa": data.cfa,
                    STAMP: own,
                }  # fmt: skip
                if is_refined(name):
                    about[GENERATOR_STEPS] = arguments.generator_steps
                bar = tqdm(total=recipe.steps, desc=f"{folder.name} {label} {seed}", mininterval=1)
                with bar:

                    def tell(step, loss, bar=bar):
                        bar.update(step - bar.n)
                        bar.set_postfix(loss=f"{loss:.5f}", refresh=False)

                    trained = train_denoiser(recipe, source, clean, data.cfa, seed, about, tell)
                trained.about["seconds"] = round(time.monotonic() - started, 1)
                make_folder(folder)
                save_denoiser(path, trained)
                print(path, flush=True)


def _apply(arguments, argv) -> None:
    """Denoises every frame of a recording of any size, tile by tile; writes a floating-point NPY, DN above
    black over full scale."""
    import numpy as np
    from tqdm import tqdm

    from cannoise_jax.recordings.load import load_recording
    from cannoise_jax.tiles import filter_mosaic
    from cannoise_jax.training.denoise import applied, load_denoiser

    give_back_large()
    check_file(arguments.out, ".npy", arguments.force)
    denoiser = load_denoiser(arguments.denoiser)
    recording = load_recording(arguments.recording, **overrides(arguments))
    about: list[Any] = [denoiser.about.get(name) for name in ("gain_dn_per_e", "full_scale_e")]
    if not all(isinstance(v, (int, float)) and np.isfinite(v) and v > 0 for v in about):
        raise BadInput(f"{arguments.denoiser}: states no gain and full scale: train it again")
    span = np.float32(float(about[0]) * float(about[1]))
    network = applied(denoiser.recipe)
    shape = (recording.count, *recording.size)
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    bar = tqdm(total=int(np.prod(shape)), unit="px", unit_scale=True)
    with bar, new_folder(arguments.out.parent), file_in_place(arguments.out) as file:
        np.lib.format.write_array_header_1_0(file, header)
        for t in range(recording.count):
            frame = np.asarray(recording.frames[t : t + 1])[0].astype(np.float32)
            frame = (frame - recording.black_map()) / span
            made = filter_mosaic(
                partial(network, denoiser.variables), denoiser.recipe.module.reach, frame, recording.cfa,
                progress=bar.update,
            )  # fmt: skip
            file.write(np.asarray(made, "<f4").tobytes())
    print(arguments.out)


def _exposures(text: str) -> tuple[float, ...]:
    return tuple(map(seconds, text.split(",")))


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text!r}: give a positive number")
    return value


def _parser() -> argparse.ArgumentParser:
    parser = OneLineParser(
        prog="bin/denoise",
        description="Trains denoisers on noise models and tests them on real darks under computed light. "
        "Training and test share no pixel, frame or scene; camera models are fitted to the training part.",
    )
    verbs = parser.add_subparsers(dest="verb", metavar="train|test|apply", required=True)
    train = verbs.add_parser("train", help="one denoiser for each exposure, noise model and seed")
    test = verbs.add_parser("test", help="PSNR and SSIM of all denoisers of a workdir")
    for verb in (train, test):
        verb.add_argument("--recordings", required=True, type=folder, metavar="DIR", help="flats and darks")
        verb.add_argument("--workdir", required=True, type=folder, metavar="RUN", help="made or gone on with")
        add_level_flags(verb)
    add = train.add_argument
    add(
        "--noise", default=_DEFAULT, metavar="NAME,...",
        help="gaussian, gaussian_pooled, pg, pg_at_exposure, pg_estimated, random_phase, calibrated, "
        "discovered, ours_on_calibrated, ours_on_discovered (a generator that starts from that "
        "sensor model), real_darks, a sensor.json, or a trained model; A+real_darks: five to one",
    )  # fmt: skip
    add_mechanisms_flag(train, "entries of your own that a sensor.json names")
    add("--exposure", type=_exposures, default=(0.1, 10.0, 100.0), metavar="S,...", help="of the darks")
    add("--full-scale", type=_positive, default=100.0, metavar="E", help="electrons of full scale")
    add("--seeds", type=count, default=3, help="training runs of each")
    add("--steps", type=count, default=600, help="of training")
    add("--generator-steps", type=count, default=200, help="of training the generators of ours_on_...")
    add("--batch", type=count, default=8, help="patches a step")
    add("--features", type=count, default=32, help="of every layer; the paper: 64")
    add("--scenes", type=count, default=32, help="clean training images")
    test.add_argument("--scenes", type=count, default=_TEST_SCENES, help="clean test images")
    test.add_argument("--force", action="store_true", help="replace results that exist")
    apply = verbs.add_parser("apply", help="denoises a recording of any size, tile by tile")
    apply.add_argument(
        "--denoiser", required=True, type=place, metavar="FILE", help="RUN/denoisers/.../*.npz"
    )
    apply.add_argument("--recording", required=True, type=place, metavar="FILE", help="of any format")
    apply.add_argument(
        "--out", required=True, type=place, metavar="FILE.npy", help="DN above black / full scale"
    )
    add_level_flags(apply)
    apply.add_argument("--force", action="store_true", help="replace a file that exists")
    return parser


if __name__ == "__main__":
    sys.exit(main())
