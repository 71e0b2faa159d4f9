"""A tiny run as a program: FOLDER DATA DEVICES [COORDINATOR PROCESSES PROCESS]. With a coordinator, the last
process gets SIGTERM after step `STOP`."""

from __future__ import annotations

import os
import pickle
import signal
import sys
from pathlib import Path
from runpy import run_path
from types import SimpleNamespace
from unittest import mock

import jax

from cannoise_jax.training import loop
from cannoise_jax.training.devices import join, leave, make_mesh

CI = Path(__file__).resolve().parents[2] / "configs" / "ci.py"
STOP = 4


def config():
    """That of CI; eight devices divide the batch."""
    made = run_path(str(CI))["get_config"]()
    made.batch_size, made.evaluate_every = 8, made.steps
    return made


def run(folder, data, devices=1, act=lambda: None):
    """Trains; `act` is called after step `STOP`."""
    done = []

    def update(n=1):
        done.append(n)
        if len(done) == STOP:
            act()

    watched = SimpleNamespace(update=update, set_postfix=lambda *_, **__: None)
    made = config()
    # Validation is of one device, as ever, and takes long to compile.
    with mock.patch.object(loop, "_validate", lambda *_: 0.0):
        return loop.train(made, Path(folder), data, lambda *_: watched, make_mesh(devices, made.batch_size))


def main(folder, data, devices, coordinator=None, processes="1", process="0"):
    stopped = process != "0" and int(process) == int(processes) - 1
    if coordinator:
        join(coordinator, int(processes), int(process))
    else:
        from cannoise_jax.commands.train import main as command

        refused = command(["--workdir", f"{folder}/none", "--config", str(CI), f"--devices={devices}"])
        assert refused == 2, "a batch of four over eight devices"
    drawn, first = pickle.loads(Path(data).read_bytes())
    first = first._replace(key=jax.random.wrap_key_data(first.key))
    with mock.patch.object(loop, "init_state", lambda *_: first):  # of one device, as ever
        outcome = run(
            folder, drawn, int(devices), lambda: os.kill(os.getpid(), signal.SIGTERM) if stopped else None
        )
    leave()
    print(outcome.step, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
