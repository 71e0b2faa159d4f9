"""What bin/denoise trains on: names of noise models, and the camera models and generators that they need."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cannoise_jax.commands.outputs import make_folder
from cannoise_jax.recordings.atomic import texts_in_place
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import BadInput

if TYPE_CHECKING:
    from cannoise_jax.mechanisms.entry import Entry

_VERDICT = "gain.json"


def labels_of(names: str) -> dict[str, str]:
    """Noise models by the name that their files get."""
    out: dict[str, str] = {}
    for name in (n.strip() for n in names.split(",") if n.strip()):
        base, plus, more = name.partition("+")
        path = Path(base)
        stem = path.parent.name + "_" + path.stem if path.suffix and path.exists() else path.name
        out[f"{stem.strip('_')}{plus}{more}"] = name
    return out


def check_sources(labels: dict[str, str], mechanisms: Sequence[Entry] = ()) -> None:
    """Raises BadInput, before anything is made, for the name of no noise model, and for a sensor.json that is
    none. mechanisms: entries from outside the package that it may name."""
    from cannoise_jax.physics.core.sensor import SensorModel
    from cannoise_jax.training.noise_sources import FITTED, NAMED, REFINED

    known = (*NAMED, *FITTED, *REFINED)
    for name in (part for label in labels.values() for part in label.split("+")):
        if name not in known and not Path(name).exists():
            raise BadInput(
                f"--noise {name}: neither {', '.join(known)}, nor a sensor.json or a trained model"
            )
        if name not in known and Path(name).suffix == ".json" and Path(name).is_file():
            SensorModel.load(name, mechanisms)


def is_refined(name: str) -> bool:
    """Whether a noise model is a generator that starts from a camera model, or has one among it."""
    from cannoise_jax.training.noise_sources import REFINED

    return name.partition("+")[0] in REFINED


def sensors_of(labels: dict[str, str], capture, workdir: Path) -> dict[str, Any]:
    """Camera models of the training part that are asked for, kept in the workdir once fitted."""
    import jax

    from cannoise_jax.physics.core.sensor import SensorModel
    from cannoise_jax.training.denoise_data import training_part
    from cannoise_jax.training.noise_sources import FITTED, REFINED

    bases = [name.partition("+")[0] for name in labels.values()]
    wanted = {REFINED.get(base, base) for base in bases} & set(FITTED)
    out = {}
    for name in sorted(wanted):
        folder = workdir / "sensors" / slug(capture.camera)
        path = folder / f"{name}.json"
        if not path.exists():
            make_folder(folder)
            print(f"{path}: fitting to the training part of {capture.camera}", flush=True)
            if name == "calibrated":
                from cannoise_jax.commands.calibrate import calibrate
                from cannoise_jax.physics.transfer.model import sensor_model

                model = sensor_model(*calibrate(training_part(capture)))
            else:
                from cannoise_jax.discovery.diagnose import diagnose

                model = diagnose(
                    training_part(capture), key=jax.random.key(0), compare=False,
                    tell=lambda text: print(f"  {text}", flush=True),
                ).model  # fmt: skip
            model.save(path)
        # Under another light than that of the recordings.
        out[name] = SensorModel.load(path).under_steady_light()
    return out


def generators_of(name: str, data, sensors: dict[str, Any], arguments) -> dict[str, Any]:
    """The generator that refines a sensor model at this exposure, where the name asks for one: trained on the
    first frames of the training part, kept in the workdir. Where denoisers gain nothing from it on the
    others, `gain.json` says so, and the camera model takes its place: None.

    Raises BadInput for what cannot be used in the generator's folder.
    """
    from cannoise_jax.training.noise_sources import REFINED
    from cannoise_jax.training.worth import JUDGE, SEEDS, parted

    base = name.partition("+")[0]
    if base not in REFINED:
        return {}
    folder = _generator_folder(arguments.workdir, data.camera, data.exposure_s, base)
    verdict, plain, inner = folder / _VERDICT, sensors[REFINED[base]], parted(data)
    steps = min(arguments.steps, JUDGE.steps)
    recipe = replace(JUDGE, steps=steps, features=arguments.features, batch_size=arguments.batch)
    by = {"denoiser": asdict(recipe), "seeds": SEEDS, "generator_steps": arguments.generator_steps}
    found = verdict_of(verdict) if verdict.exists() else {}
    before = found.get("judged_by", {}).get("generator_steps", arguments.generator_steps)
    if before != arguments.generator_steps:
        raise BadInput(
            f"{folder}: its generator was trained with --generator-steps {before}, not "
            f"{arguments.generator_steps}: give --generator-steps {before}, or another --workdir"
        )
    if found.get("judged_by") != by:
        found = _judged(inner, folder, plain, recipe, arguments) | {"judged_by": by}
        make_folder(folder)
        with texts_in_place({verdict: json.dumps(found, indent=1) + "\n"}):
            print(verdict, flush=True)
    return {base: _refine(inner, folder, plain, arguments) if found["adopted"] else None}


def _judged(data, folder: Path, plain, recipe, arguments) -> dict[str, Any]:
    """Whether the generator is adopted, and why: by what denoisers gain from it. data: None where no frame is
    left to judge by."""
    from cannoise_jax.training.noise_sources import refined, sensor
    from cannoise_jax.training.worth import gain_of

    if data is None:
        return {"adopted": False, "reason": "one dark frame for training: none to judge by"}
    try:
        model = _refine(data, folder, plain, arguments)
    except BadInput as error:
        raise BadInput(f"{error} (or remove {folder}, to train its generator anew)") from error
    print(f"{folder}: denoisers judge what it adds, on frames held back from it", flush=True)
    try:
        gain = gain_of(data, refined(data, model), sensor(data, plain), recipe)
    except FloatingPointError as error:
        return {"adopted": False, "reason": f"no denoiser can be trained on it ({error})"}
    return {"adopted": gain.low > 0, "gain_db": gain._asdict(), "interval": "90 %"}


def verdict_of(path: Path) -> dict[str, Any]:
    """What `gain.json` says. Raises BadInput for a file that cannot be read."""
    try:
        found = json_of(path.read_text())
        whole = isinstance(found, dict) and isinstance(found.get("judged_by", {}), dict)
        if whole and isinstance(found.get("adopted"), bool):
            return found
    except (OSError, ValueError, RecursionError):
        pass
    raise BadInput(f"{path}: not readable: remove it and run again")


def verdicts_of(
    workdir: Path, camera: str, exposure_s: float, names: Iterable[str]
) -> dict[str, dict[str, Any]]:
    """By noise model of `names` what was found of its generator, of a camera at an exposure."""
    from cannoise_jax.training.noise_sources import REFINED

    bases = {name.partition("+")[0] for name in names} & set(REFINED)
    files = {name: _generator_folder(workdir, camera, exposure_s, name) / _VERDICT for name in sorted(bases)}
    return {name: verdict_of(file) for name, file in files.items() if file.exists()}


def said_of(verdict: dict[str, Any]) -> str:
    """A verdict in words."""
    if "gain_db" not in verdict:
        return f"the learned part is left out: {verdict['reason']}"
    gain = verdict["gain_db"]
    taken = "is used" if verdict["adopted"] else "is left out"
    return (
        f"the learned part {taken}: on frames held back from it denoisers gain {gain['value']:+.2f} dB "
        f"[{gain['low']:+.2f}, {gain['high']:+.2f}] by it"
    )


def _generator_folder(workdir: Path, camera: str, exposure_s: float, name: str) -> Path:
    return workdir / "generators" / f"{slug(camera)}_{exposure_s:g}s_{name}"


def _refine(data, folder: Path, plain, arguments):
    """Trains the generator, or takes the one that is there."""
    from tqdm import tqdm

    from cannoise_jax.commands.train import default_config
    from cannoise_jax.model_file import MODEL_FILE, load_model
    from cannoise_jax.training.loop import NonFiniteLoss, train
    from cannoise_jax.training.refine import refine_config, refine_data, write_unit
    from cannoise_jax.training.result import write_model

    if not (folder / MODEL_FILE).exists():
        make_folder(folder)
        sensor = write_unit(folder / "sensor.json", plain, data.train.shape[1:])
        config = refine_config(
            default_config(), folder / "sensor.json", data.exposure_s, arguments.generator_steps, seed=0
        )
        bar = tqdm(total=config.steps * config.batch_size, desc=folder.name, unit="patch", mininterval=1)
        try:
            with bar:
                prepared = refine_data(data, sensor)
                outcome = train(config, folder, prepared, lambda done, steps: bar)
        except NonFiniteLoss as error:
            raise FloatingPointError(str(error)) from error
        if not outcome.finished:
            raise BadInput(f"{folder}: stopped: the same command goes on")
        write_model(config, outcome.state, prepared, folder)
        print(folder / MODEL_FILE, flush=True)
    return load_model(folder)


def slug(name: str) -> str:
    """A camera's name as that of a file."""
    return re.sub(r"[^A-Za-z0-9.-]+", "_", name).strip("_")
