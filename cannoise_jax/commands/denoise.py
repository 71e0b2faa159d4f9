"""bin/denoise train|test|apply: denoisers trained on noise models, judged on real darks.

bin/denoise train --recordings DIR --workdir RUN [--noise pg,calibrated,real_darks] [--exposure 0.1,10,100]
bin/denoise test --recordings DIR --workdir RUN
bin/denoise apply --denoiser FILE --recording FILE --out FILE
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import shlex
import sys
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.denoise_sources import (
    check_sources,
    generators_of,
    labels_of,
    said_of,
    sensors_of,
    slug,
    verdicts_of,
)
from cannoise_jax.commands.entry import command
from cannoise_jax.commands.freed_memory import give_back_large
from cannoise_jax.commands.outputs import check_file, check_folder, make_folder
from cannoise_jax.commands.parser import OneLineParser, count, folder, place, seconds
from cannoise_jax.recordings.atomic import file_in_place, texts_in_place
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.recordings.recording import CaptureSet

ORDER = ("gaussian", "pg", "calibrated", "discovered", "ours_on_discovered", "real_darks")
"""As the noise models are expected: each no worse than the one before."""
_DEFAULT = "gaussian,gaussian_pooled,pg,pg_at_exposure,pg_estimated,random_phase,calibrated,real_darks"
_TEST_SCENES = 16


@command("denoise")
def main(argv: list[str] | None = None) -> int:
    """Returns 0, 1 for a loss that is not finite, or 2 after one line when something cannot be used."""
    arguments = sys.argv[1:] if argv is None else argv
    parsed = _parser().parse_args(arguments)
    try:
        {"train": _train, "test": _test, "apply": _apply}[parsed.verb](parsed, arguments)
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

    from cannoise_jax.training.denoise import Recipe, check_size, save_denoiser, train_denoiser
    from cannoise_jax.training.denoise_data import dim_scenes, half_real
    from cannoise_jax.training.noise_sources import open_source

    recipe = Recipe(
        steps=arguments.steps,
        features=arguments.features,
        batch_size=arguments.batch,
        scenes=arguments.scenes,
    )
    check_folder(arguments.workdir, (), force=True)
    capture = _capture(arguments.recordings)
    labels = labels_of(arguments.noise)
    check_sources(labels)
    every = {exposure: half_real(capture, exposure, arguments.full_scale) for exposure in arguments.exposure}
    for data in every.values():
        check_size(data.train.shape[1:], recipe)
    sensors = sensors_of(labels, capture, arguments.workdir)
    for exposure, data in every.items():
        folder = arguments.workdir / "denoisers" / f"{slug(data.camera)}_{exposure:g}s"
        clean = None
        for label, name in labels.items():
            source = None
            for seed in range(arguments.seeds):
                path = folder / f"{label}_{seed}.npz"
                if path.exists():
                    continue
                if clean is None:
                    clean = dim_scenes(
                        jax.random.key(1), "train", recipe.scenes, data.train.shape[1:], data.cfa
                    )
                if source is None:
                    source = open_source(name, data, sensors, generators_of(name, data, sensors, arguments))
                started = time.monotonic()
                about: dict[str, Any] = {
                    "noise": label, "seed": seed, "camera": data.camera, "exposure_s": exposure,
                    "full_scale_e": data.full_scale_e, "gain_dn_per_e": data.gain_dn_per_e, "cfa": data.cfa,
                }  # fmt: skip
                bar = tqdm(total=recipe.steps, desc=f"{folder.name} {label} {seed}", mininterval=1)
                with bar:

                    def tell(step, loss, bar=bar):
                        bar.update(step - bar.n)
                        bar.set_postfix(loss=f"{loss:.5f}", refresh=False)

                    made = train_denoiser(recipe, source, clean, data.cfa, seed, about, tell)
                made.about["seconds"] = round(time.monotonic() - started, 1)
                make_folder(folder)
                save_denoiser(path, made)
                print(path, flush=True)


def _capture(place: Path) -> CaptureSet:
    """The recordings of a folder without the frames that show no noise, which are said."""
    from cannoise_jax.recordings.load import load_capture_set
    from cannoise_jax.recordings.usable import usable

    capture, left_out = usable(load_capture_set(place))
    for line in left_out:
        print(f"bin/denoise: {line}", file=sys.stderr, flush=True)
    return capture


def _test(arguments, argv) -> None:
    """Every denoiser of the workdir on the held-out darks; writes denoising.json and prints a table."""
    import jax
    import numpy as np

    from cannoise_jax.evaluation.denoising import in_order, psnr, ssim, summary
    from cannoise_jax.recordings.packing import pack
    from cannoise_jax.training.denoise import denoised, load_denoiser
    from cannoise_jax.training.denoise_data import dim_scenes, half_real, held_out_images

    started = time.monotonic()
    found = [(p, load_denoiser(p)) for p in sorted((arguments.workdir / "denoisers").glob("*/*.npz"))]
    capture = _capture(arguments.recordings)
    path = arguments.workdir / f"denoising_{slug(capture.camera)}.json"
    found = [(p, d) for p, d in found if d.about["camera"] == capture.camera]
    if not found:
        raise BadInput(f"{arguments.workdir}: no denoiser for {capture.camera}: bin/denoise train makes them")
    check_file(path, ".json", arguments.force)
    out: dict[str, Any] = {}
    for exposure in sorted({d.about["exposure_s"] for _, d in found}):
        own = [d for _, d in found if d.about["exposure_s"] == exposure]
        data = half_real(capture, exposure, own[0].about["full_scale_e"])
        clean = dim_scenes(jax.random.key(2), "test", arguments.scenes, data.test.shape[1:], data.cfa)
        noisy = held_out_images(data, clean, jax.random.key(3))
        truth, shown = (pack(np.asarray(x, np.float32), data.cfa) for x in (clean, noisy))
        made: dict[str, dict[str, dict[int, list[float]]]] = {"psnr_db": {}, "ssim": {}}
        for d in own:
            images = denoised(d, shown)
            for metric, function in (("psnr_db", psnr), ("ssim", ssim)):
                rows = made[metric].setdefault(d.about["noise"], {})
                rows[d.about["seed"]] = [function(t, i) for t, i in zip(truth, images, strict=True)]
        seeds = sorted(set.intersection(*(set(rows) for rows in made["psnr_db"].values())))
        if not seeds:
            raise BadInput(f"{arguments.workdir}: no seed is there for all noise models: train the rest")
        result: dict[str, Any] = {
            "seeds": len(seeds),
            "scenes": arguments.scenes,
            "steps": own[0].recipe.steps,
        }
        result["test_frames"] = len(data.test)
        result["noisy"] = {
            "psnr_db": float(np.mean([psnr(t, i) for t, i in zip(truth, shown, strict=True)])),
            "ssim": float(np.mean([ssim(t, i) for t, i in zip(truth, shown, strict=True)])),
        }
        for metric, by_noise in made.items():
            numbers = {name: np.array([rows[s] for s in seeds]) for name, rows in by_noise.items()}
            result[metric] = summary(numbers, "pg", "real_darks")
            result[f"{metric}_order"] = in_order(numbers, ORDER)
        result["seconds_of_training"] = {
            name: round(float(np.mean([d.about["seconds"] for d in own if d.about["noise"] == name])), 1)
            for name in made["psnr_db"]
        }
        result["learned_part"] = verdicts_of(arguments.workdir, capture.camera, exposure, made["psnr_db"])
        out[f"{exposure:g}"] = result
        print(_table(f"{capture.camera}, {exposure:g} s", result), flush=True)
    record = {
        "schema": "cannoise/denoising/1", "camera": capture.camera, "exposures_s": out,
        "command": f"bin/denoise {shlex.join(argv)}", "version": importlib.metadata.version("cannoise-jax"),
        "interval": "90 %, seeds and scenes drawn again", "seconds": round(time.monotonic() - started, 1),
    }  # fmt: skip
    with texts_in_place({path: json.dumps(record, indent=1, allow_nan=False) + "\n"}):
        print(path)


def _table(title: str, result: dict[str, Any]) -> str:
    """PSNR and SSIM by noise model, with what each gains over PG."""
    lines = [
        f"{title}: {result['seeds']} seeds, {result['scenes']} test scenes, {result['steps']} steps; noisy "
        f"{result['noisy']['psnr_db']:.2f} dB",
        f"{'trained on':<26}{'PSNR dB':>9}{'over pg [90 %]':>26}{'gap':>7}{'SSIM':>8}{'over pg [90 %]':>28}",
    ]
    for name, row in sorted(result["psnr_db"].items(), key=lambda item: item[1]["mean"]["value"]):
        other = result["ssim"][name]
        gap = f"{row['gap_closed']:.0%}" if "gap_closed" in row else "-"
        lines.append(
            f"{name:<26}{row['mean']['value']:>9.2f}{_gain(row, 2):>26}{gap:>7}"
            f"{other['mean']['value']:>8.4f}{_gain(other, 4):>28}"
        )
    for step in result["psnr_db_order"]:
        lines.append(f"  {step['upper']} against {step['lower']}: {step['outcome']}")
    lines += [f"  {name}: {said_of(verdict)}" for name, verdict in result["learned_part"].items()]
    return "\n".join(lines) + "\n"


def _gain(row: dict[str, Any], digits: int) -> str:
    if "over_pg" not in row:
        return "-"
    value, low, high = (row["over_pg"][k] for k in ("value", "low", "high"))
    return f"{value:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}]"


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
    recording = load_recording(arguments.recording)
    about: list[Any] = [denoiser.about.get(name) for name in ("gain_dn_per_e", "full_scale_e")]
    if not all(isinstance(v, (int, float)) and np.isfinite(v) and v > 0 for v in about):
        raise BadInput(f"{arguments.denoiser}: states no gain and full scale: train it again")
    span = np.float32(float(about[0]) * float(about[1]))
    network = applied(denoiser.recipe)
    shape = (recording.count, *recording.size)
    header = {"descr": "<f4", "fortran_order": False, "shape": shape}
    bar = tqdm(total=int(np.prod(shape)), unit="px", unit_scale=True)
    with bar, file_in_place(arguments.out) as file:
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
    add = train.add_argument
    add(
        "--noise", default=_DEFAULT, metavar="NAME,...",
        help="gaussian, gaussian_pooled, pg, pg_at_exposure, pg_estimated, random_phase, calibrated, "
        "discovered, ours_on_calibrated, ours_on_discovered (a generator that starts from that "
        "sensor model), real_darks, a sensor.json, or a trained model; A+real_darks: five to one",
    )  # fmt: skip
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
    apply.add_argument("--force", action="store_true", help="replace a file that exists")
    return parser


if __name__ == "__main__":
    sys.exit(main())
