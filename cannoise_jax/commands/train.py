"""bin/train --workdir DIR [--config FILE] [--config.field=value] [--recordings DIR_A,DIR_B]

Trains, resumes where it was stopped, and ends with a table, a picture and results.json in the workdir.
Several devices, and processes on several machines, may share the work; a run resumes on any number of them.
"""

from __future__ import annotations

import difflib
import json
import re
import runpy
import signal
import sys
import tempfile
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from absl import flags
from ml_collections import ConfigDict, config_flags

from cannoise_jax.commands.entry import command, show_warnings
from cannoise_jax.commands.entry import progress as progress_of
from cannoise_jax.commands.freed_memory import keep_freed
from cannoise_jax.commands.interrupts import after_loading
from cannoise_jax.commands.pulse import current, now_at
from cannoise_jax.recordings.opened import json_of
from cannoise_jax.recordings.recording import CFA_PATTERNS, BadInput


def _default_config() -> str:
    """configs/default.py of this checkout, or of the installed package."""
    package = Path(__file__).resolve().parents[1]
    folders = (package.parent / "configs", package / "configs")
    return str(next((f for f in folders if (f / "default.py").is_file()), folders[0]) / "default.py")


def default_config() -> ConfigDict:
    """What configs/default.py gives."""
    return runpy.run_path(_default_config())["get_config"]()


def _flags(arguments: list[str], default: str | None = None) -> flags.FlagValues:
    """The command's flags, not yet parsed. Made anew each time: a config file that fails to load is kept."""
    values = flags.FlagValues()
    config_flags.DEFINE_config_file(
        "config",
        default or _default_config(),
        "A file with get_config(); a folder that holds a run goes on with its own.",
        lock_config=True,
        flag_values=values,
        sys_argv=["bin/train", *arguments],
    )
    flags.DEFINE_string("workdir", None, "Where checkpoints, metrics and results go.", flag_values=values)
    flags.DEFINE_list("recordings", [], "Folders of recordings, one a camera.", flag_values=values)
    flags.DEFINE_enum("cfa", None, CFA_PATTERNS, "Colour order of the recordings.", flag_values=values)
    flags.DEFINE_list("black-level", None, "DN; one, or four in mosaic order.", flag_values=values)
    flags.DEFINE_float("white-level", None, "DN.", flag_values=values)
    flags.DEFINE_integer(
        "devices", 1, "Devices of each process that share a batch; 0: all.", 0, flag_values=values
    )
    flags.DEFINE_string(
        "coordinator", None, "HOST:PORT of process 0 where several share a run; auto: as SLURM says.",
        flag_values=values,
    )  # fmt: skip
    flags.DEFINE_integer("processes", None, "How many they are.", 1, flag_values=values)
    flags.DEFINE_integer("process", None, "Number of this one, from 0.", 0, flag_values=values)
    return values


@command("train")
def main(argv: list[str] | None = None) -> int:
    """Trains; returns 0, also when a signal stops it between steps; 1 when a loss is not finite; 2 after bad
    input, 130 when interrupted elsewhere, each in one line."""
    arguments = sys.argv[1:] if argv is None else argv
    if any(a in ("-h", "--help", "-help") for a in arguments):
        print(_help())
        return 0
    started = time.monotonic()
    show_warnings("train")
    workdir = None
    try:
        with _interruptible() as check:
            config, workdir, values = _read_flags(arguments)
            with _no_empty_folder(workdir, values.processes is None and values.coordinator is None):
                return _run(config, workdir, values, started, check)
    except BadInput as error:
        print(f"bin/train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        begun = workdir is not None and any(workdir.glob("checkpoints/*"))
        onward = "goes on from the last checkpoint" if begun else "begins again"
        print(f"bin/train: interrupted: the same command {onward}", file=sys.stderr)
        return 130


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """Within it SIGTERM is what Ctrl-C is: KeyboardInterrupt. Training itself stops at its next step instead.

    Python drops an exception that is raised in a destructor or a callback of the garbage collector, so the
    yielded function raises it again: it is called between the phases of a run.
    """
    caught: list[int] = []

    def handle(number, frame):
        caught.append(number)
        raise KeyboardInterrupt

    def check() -> None:
        if caught:
            raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield check  # signals cannot be caught here
        return
    later = after_loading(handle)
    before = {number: signal.signal(number, later) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _no_empty_folder(folder: Path, alone: bool) -> Iterator[None]:
    """A folder that a run has made and not filled when it is refused or interrupted is taken away again, with
    its config where no step was taken; unless other processes share it (not alone)."""
    there = folder.exists()
    try:
        yield
    except (BadInput, KeyboardInterrupt):
        if not there:
            with suppress(OSError):
                if alone and {p.name for p in folder.iterdir()} == {"checkpoints", "config.json"}:
                    (folder / "checkpoints").rmdir()  # only where it is empty
                    (folder / "config.json").unlink()
                folder.rmdir()
        raise


def _read_flags(arguments: list[str]) -> tuple[ConfigDict, Path, flags.FlagValues]:
    file = (_value(arguments, "config") or "").partition(":")[0]
    if file and not Path(file).is_file():
        raise BadInput(f"--config {file}: no such file: name a config, as configs/default.py")
    try:
        with _stored_config(arguments) as stored:
            values = _flags(arguments, stored)
            rest = values(["bin/train", *arguments])[1:]
            config = values.config
            if not isinstance(config, ConfigDict):
                raise BadInput("--config: its get_config() returns no ConfigDict, see configs/default.py")
            config.to_dict()  # a file that could not be loaded says so only when it is looked at
    except flags.UnrecognizedFlagError as error:
        raise BadInput(f"unknown flag --{error.flagname}{_near_flag(error.flagname)}") from error
    except flags.Error as error:
        raise BadInput(_plainly(" ".join(str(error).split()))) from error
    except BadInput:
        raise
    except Exception as error:  # a config file is a program: it may raise anything
        _refuse_unknown_field(arguments, error)
        raise BadInput(f"--config: cannot be read: {type(error).__name__}: {error}") from error
    if rest:
        raise BadInput(f"{rest[0]}: not understood: see bin/train --help")
    if not values.workdir:
        raise BadInput("--workdir: missing: name a folder for checkpoints and results")
    if values["recordings"].present and not any(folder.strip() for folder in values.recordings):
        raise BadInput("--recordings: an empty name: name folders of recordings, one a camera")
    if values.recordings:
        if "recordings" not in config.data:
            raise BadInput("--recordings: this config reads other data: use it with configs/default.py")
        config.data.source = "recordings"
        config.data.recordings = tuple(values.recordings)
    try:
        black = values["black-level"].value
        if black is not None:
            config.data.black_level = tuple(float(level) for level in black)
    except ValueError as error:
        raise BadInput(f"--black-level: {error}") from error
    if values.cfa is not None:
        config.data.cfa = values.cfa
    if values["white-level"].value is not None:
        config.data.white_level = values["white-level"].value
    return config, Path(values.workdir), values


def _plainly(message: str) -> str:
    """What the library of flags says of a value, in the words of a user."""
    for kind, words in (
        (r"invalid literal for int\(\) with base 10", "a whole number"),
        ("could not convert string to float", "a number"),
    ):
        message = re.sub(rf"{kind}: (.*)$", rf"\1: give {words}", message)
    return message


@contextmanager
def _stored_config(arguments: list[str]) -> Iterator[str | None]:
    """The config of the run that the workdir holds, as a file with get_config(); None where there is none, or
    where another is asked for."""
    path = Path(_value(arguments, "workdir") or "") / "config.json"
    if _value(arguments, "config") is not None or not path.is_file() or not _value(arguments, "workdir"):
        yield None
        return
    try:
        stored = json_of(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise BadInput(f"{path}: not valid JSON: use another --workdir") from error
    if not isinstance(stored, dict) or not _is_config(stored):
        raise BadInput(f"{path}: holds no config: use another --workdir")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "stored.py"
        file.write_text(
            "import json\nfrom cannoise_jax.commands.train import as_config\n\n\n"
            f"def get_config():\n    return as_config(json.loads({json.dumps(stored)!r}))\n"
        )
        yield str(file)


def _is_config(stored: dict[str, Any]) -> bool:
    """Whether a stored config has the parts of one, and names that a field may have."""
    ours = default_config()
    parts = (name for name in ours if isinstance(ours[name], ConfigDict))
    return all(isinstance(stored.get(name), dict) for name in parts) and not any("." in k for k in stored)


def as_config(stored: dict[str, Any]) -> ConfigDict:
    """A config from its JSON: lists were tuples, and what is null may take any value."""

    def value(old: Any) -> Any:
        if isinstance(old, dict):
            return {name: value(v) for name, v in old.items()}
        return tuple(value(v) for v in old) if isinstance(old, list) else old

    return ConfigDict(value(stored))


def _value(arguments: list[str], name: str) -> str | None:
    """The last value of a flag, `--name value` or `--name=value`, None where it is not given."""
    found = None
    for at, argument in enumerate(arguments):
        flag, equals, value = argument.lstrip("-").partition("=")
        if argument.startswith("-") and flag == name:
            found = value if equals else (arguments[at + 1] if at + 1 < len(arguments) else "")
    return found


def _refuse_unknown_field(arguments: list[str], error: Exception) -> None:
    """Raises BadInput in the words of a command line for a --config.FIELD that does not exist."""
    words = re.findall(r"'(\w+)'|\"(\w+)\"", str(error).replace("\\", ""))
    names = [a or b for a, b in words]
    for argument in arguments:
        flag = argument.lstrip("-").partition("=")[0]
        if names and flag.startswith("config.") and names[0] in flag.split("."):
            near = names[1] if len(names) > 1 and "Did you mean" in str(error) else None
            path = flag.split(".")
            path[path.index(names[0])] = near or names[0]
            advice = f"did you mean --{'.'.join(path)}?" if near else "see bin/train --help"
            raise BadInput(f"--{flag}: no such field: {advice}") from error


def _near_flag(name: str) -> str:
    """What an unknown flag may be a slip of: another flag, or a field of the config by its last name."""
    fields = [f"config.{field.partition('=')[0]}" for field in _fields(default_config().to_dict())]
    known = {field.rpartition(".")[2]: field for field in fields} | {field: field for field in fields}
    for flag in (f for f in _flags([]) if "." not in f):
        known |= {flag: flag, flag.replace("-", "_"): flag}
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    return f": did you mean --{known[near[0]]}?" if near else ": see bin/train --help"


def _help() -> str:
    values = _flags([])
    lines = [__doc__ or ""]
    for name in (n for n in values if "." not in n and values[n].help):
        default = values[name].default if name != "config" else "configs/default.py"
        shown = "" if default in (None, []) else f" (default {default})"
        lines.append(f"  --{name}  {values[name].help}{shown}")
    lines.append("\nFields of the config, --config.FIELD=VALUE, with the defaults of configs/default.py:")
    fields = ", ".join(_fields(default_config().to_dict()))
    lines += textwrap.wrap(fields, 100, initial_indent="  ", subsequent_indent="  ",
                           break_long_words=False, break_on_hyphens=False)  # fmt: skip
    return "\n".join(lines)


def _fields(config: dict[str, Any], before: str = "") -> Iterator[str]:
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _fields(value, f"{before}{name}.")
        else:
            yield f"{before}{name}={value}".replace(", ", ",")


def _run(
    config: ConfigDict, workdir: Path, values: flags.FlagValues, started: float, check: Callable[[], None]
) -> int:
    keep_freed()
    now_at("loading libraries")
    import jax
    from tqdm import tqdm

    from cannoise_jax.evaluation.figures import noise_figure
    from cannoise_jax.evaluation.tables import results_table, write_results
    from cannoise_jax.training.check import check_config
    from cannoise_jax.training.data import load_data
    from cannoise_jax.training.devices import is_first, join, leave, make_mesh
    from cannoise_jax.training.loop import NonFiniteLoss, check_workdir, train
    from cannoise_jax.training.result import compare, samplers_of, write_model

    check_config(config)
    check_workdir(config, workdir)
    join(values.coordinator, values.processes, values.process)
    mesh = make_mesh(values.devices, config.batch_size)
    first = is_first()
    check()
    print(f"{workdir}: reading the data", flush=True)
    now_at("reading the data")
    data = load_data(config, workdir, progress_of("drawing patches of cameras"))
    check()
    named = ", ".join(data.cameras)
    trained = (
        f"{len(data.train)} patches of {named}"
        if data.trained_on is None
        else f"{len(data.train)} cameras drawn from the prior, to be measured on {named}"
    )
    print(f"{trained}; compiling takes a minute", flush=True)

    def progress(step: int, steps: int):
        bar = tqdm(
            total=steps * config.batch_size, initial=step * config.batch_size, unit="patch", mininterval=1,
            dynamic_ncols=True, disable=not first,
        )  # fmt: skip
        current().at(lambda: _stage(bar.n // config.batch_size if first else None, step, steps))
        return bar

    try:
        with ExitStack() as bars:  # what is printed next begins on a line of its own
            outcome = train(config, workdir, data, lambda *at: bars.enter_context(progress(*at)), mesh)
    except NonFiniteLoss as error:
        print(f"bin/train: {error}", file=sys.stderr)
        return 1
    leave()
    if not outcome.finished:
        print(f"stopped at step {outcome.step}: the same command resumes", flush=True)
        return 0
    if not first:
        return 0  # the first measures, alone
    check()
    now_at("writing the model")
    model = write_model(config, outcome.state, data, workdir)
    check()
    now_at("measuring on the test scenes")
    sampler = samplers_of(model, config)
    results = compare(sampler, config, data, progress_of("measuring on the test scenes"))
    check()
    print(f"\nHeld-out test scenes, checkpoint of step {outcome.step} (best on validation scenes)\n")
    print(results_table(results))
    seconds = time.monotonic() - started
    try:
        write_results(workdir / "results.json", results, round(seconds, 1))
        noise_figure(
            workdir / "noise.png",
            sampler.usual,
            data.test,
            data.cameras,
            jax.random.key(config.seed),
            16,
            config.references,
        )
    except OSError as error:
        raise BadInput(
            f"{workdir}: cannot be written ({error.strerror or error}): make room and run again; it "
            "goes on from the last checkpoint"
        ) from error
    print(f"\n{workdir}/results.json, {workdir}/noise.png; {seconds / 60:.1f} minutes")
    return 0


def _stage(now: int | None, began: int, steps: int) -> str:
    """What training is at where its bar stands still. now: None where nothing counts the steps."""
    if now is None:
        return f"training to step {steps} with the other processes"
    if now == began:
        return "training; its first step is compiled"
    return f"training: step {now} of {steps}; every validation takes a while, the first is compiled"


if __name__ == "__main__":
    sys.exit(main())
