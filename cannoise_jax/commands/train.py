"""bin/train --workdir DIR [--config FILE] [--config.field=value] [--recordings DIR_A,DIR_B]

Trains, resumes where it was stopped, and ends with a table, a picture and results.json in the workdir.
"""

from __future__ import annotations

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from absl import flags
from ml_collections import ConfigDict, config_flags

from cannoise_jax.recordings.recording import CFA_PATTERNS, BadInput


def _default_config() -> str:
    """configs/default.py of this checkout, or of the installed package."""
    package = Path(__file__).resolve().parents[1]
    folders = (package.parent / "configs", package / "configs")
    return str(next((f for f in folders if (f / "default.py").is_file()), folders[0]) / "default.py")


def _flags(arguments: list[str]) -> flags.FlagValues:
    """The command's flags, not yet parsed. Made anew each time: a config file that fails to load is kept."""
    values = flags.FlagValues()
    config_flags.DEFINE_config_file(
        "config",
        _default_config(),
        "A file with get_config().",
        lock_config=True,
        flag_values=values,
        sys_argv=["bin/train", *arguments],
    )
    flags.DEFINE_string("workdir", None, "Where checkpoints, metrics and results go.", flag_values=values)
    flags.DEFINE_list("recordings", [], "Folders of recordings, one a camera.", flag_values=values)
    flags.DEFINE_enum("cfa", None, CFA_PATTERNS, "Colour order of the recordings.", flag_values=values)
    flags.DEFINE_list("black-level", None, "DN; one, or four in mosaic order.", flag_values=values)
    flags.DEFINE_float("white-level", None, "DN.", flag_values=values)
    return values


def main(argv: list[str] | None = None) -> int:
    """Trains; returns 0, also when a signal stops it between steps; 1 when a loss is not finite; 2 after bad
    input, 130 when interrupted elsewhere, each in one line."""
    arguments = sys.argv[1:] if argv is None else argv
    if any(a in ("-h", "--help", "-help") for a in arguments):
        print(__doc__)
        values = _flags([])
        print("\n".join(f"  --{name}  {values[name].help}" for name in values if "." not in name))
        return 0
    started = time.monotonic()
    logging.basicConfig(format="bin/train: %(message)s", level=logging.WARNING)
    try:
        with _interruptible() as check:
            config, workdir = _read_flags(arguments)
            return _run(config, workdir, started, check)
    except BadInput as error:
        print(f"bin/train: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("bin/train: interrupted: the same command goes on from the last checkpoint", file=sys.stderr)
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
    before = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield check
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _read_flags(arguments: list[str]) -> tuple[ConfigDict, Path]:
    try:
        values = _flags(arguments)
        rest = values(["bin/train", *arguments])[1:]
        config = values.config
        config.to_dict()  # a file that could not be loaded says so only when it is looked at
    except flags.Error as error:
        raise BadInput(" ".join(str(error).split())) from error
    except Exception as error:  # a config file is a program: it may raise anything
        reason = " ".join(str(error).split())
        raise BadInput(f"--config: cannot be read: {type(error).__name__}: {reason}") from error
    if rest:
        raise BadInput(f"{rest[0]}: not understood: see bin/train --help")
    if not values.workdir:
        raise BadInput("--workdir: missing: name a folder for checkpoints and results")
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
    return config, Path(values.workdir)


def _run(config: ConfigDict, workdir: Path, started: float, check: Callable[[], None]) -> int:
    import jax
    from tqdm import tqdm

    from cannoise_jax.evaluation.figures import noise_figure
    from cannoise_jax.evaluation.tables import results_table, write_results
    from cannoise_jax.training.check import check_config
    from cannoise_jax.training.data import load_data
    from cannoise_jax.training.loop import NonFiniteLoss, check_workdir, train
    from cannoise_jax.training.result import compare, samplers_of, write_model

    check_config(config)
    check_workdir(config, workdir)
    check()
    print(f"{workdir}: reading the data", flush=True)
    data = load_data(config, workdir)
    check()
    named = ", ".join(data.cameras)
    trained = (
        f"{len(data.train)} patches of {named}"
        if data.trained_on is None
        else f"{len(data.train)} cameras drawn from the prior, to be measured on {named}"
    )
    print(f"{trained}; compiling takes a minute", flush=True)

    def progress(step: int, steps: int):
        return tqdm(
            total=steps * config.batch_size, initial=step * config.batch_size, unit="patch", mininterval=1,
            dynamic_ncols=True,
        )  # fmt: skip

    try:
        with ExitStack() as bars:  # what is printed next begins on a line of its own
            outcome = train(config, workdir, data, lambda *at: bars.enter_context(progress(*at)))
    except NonFiniteLoss as error:
        print(f"bin/train: {error}", file=sys.stderr)
        return 1
    if not outcome.finished:
        print(f"stopped at step {outcome.step}: the same command resumes", flush=True)
        return 0
    check()
    model = write_model(config, outcome.state, data, workdir)
    check()
    sampler = samplers_of(model, config)
    results = compare(sampler, config, data)
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
        raise BadInput(f"{workdir}: cannot be written: {error.strerror or error}") from error
    print(f"\n{workdir}/results.json, {workdir}/noise.png; {seconds / 60:.1f} minutes")
    return 0


if __name__ == "__main__":
    sys.exit(main())
