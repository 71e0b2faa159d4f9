"""One run on several devices and processes gives the numbers of one device, to rounding."""

from __future__ import annotations

import json
import os
import pickle
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.data import load_data
from cannoise_jax.training.devices import join, make_mesh
from cannoise_jax.training.state import init_state
from tests.training.shared_run import CI, STOP, config, run

ROOT = CI.parents[1]
CODE = ("cannoise_jax/training", "cannoise_jax/networks", "cannoise_jax/recordings/pipeline.py", "configs")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """What all runs train on, and a file of it and of the state that they begin with: drawing one and
    compiling the other takes longer than training."""
    drawn = load_data(config(), tmp_path_factory.mktemp("data"))
    state = init_state(config(), drawn.known, jnp.asarray(drawn.noisy_examples()))
    first = jax.device_get(state._replace(key=jax.random.key_data(state.key)))
    file = tmp_path_factory.mktemp("drawn") / "data.pickle"
    file.write_bytes(pickle.dumps((drawn, first)))
    return drawn, file


@pytest.fixture(scope="module")
def alone(data, tmp_path_factory):
    """The losses of one device."""
    folder = tmp_path_factory.mktemp("alone")
    run(folder, data[0])
    return losses(folder)


def losses(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [line for line in lines if "generator/spread" in line]


def start(folder, file, *more, devices=1):
    """The program of `shared_run` on so many devices of this machine's CPU."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    return subprocess.Popen(
        [sys.executable, "-m", "tests.training.shared_run", str(folder), str(file), str(devices), *more],
        cwd=ROOT, env={**os.environ, "XLA_FLAGS": flags}, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def differ(found, wanted):
    """The largest relative difference of two courses of the losses, which is rounding: sums over the batch in
    another order."""
    assert [line["step"] for line in found] == [line["step"] for line in wanted] == [1, 2, 3, 4, 5, 6]
    for ours, theirs in zip(found, wanted, strict=True):
        assert ours == pytest.approx(theirs, rel=2e-4, abs=1e-7)
    pairs = [(a[name], b[name]) for a, b in zip(found, wanted, strict=True) for name in b]
    return max(abs(a - b) / abs(b) for a, b in pairs if b)


def tell(tables, what, largest):
    columns = ("losses of", "largest relative difference from one device")
    tables.add("several_devices", columns, [(what, f"{largest:.1g}")], CODE)


def test_eight_devices_follow_one_and_must_divide_the_batch(data, alone, tmp_path, tables):
    program = start(tmp_path, data[1], devices=8)
    printed, errors = program.communicate(timeout=600)
    assert program.returncode == 0, errors
    assert printed.split() == ["6"]
    lines = [line for line in errors.splitlines() if line.startswith("bin/train")]
    assert len(lines) == 1 and "config.batch_size: 4: 8 devices share a batch" in lines[0]
    tell(tables, "eight devices", differ(losses(tmp_path), alone))


@pytest.mark.slow
def test_two_processes_follow_one_stop_together_and_one_resumes(data, alone, tmp_path, tables):
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    programs = [start(tmp_path, data[1], address, "2", str(n)) for n in range(2)]
    ended = [(program.communicate(timeout=600), program.returncode) for program in programs]
    for (printed, errors), status in ended:
        assert status == 0, errors
        assert printed.split()[-1] == str(STOP)  # one had the signal
    assert run(tmp_path, data[0]).finished
    tell(tables, "two processes, resumed by one", differ(losses(tmp_path), alone))


def test_devices_that_are_not_there_are_refused():
    assert make_mesh(0, 5) is None
    with pytest.raises(BadInput, match="--devices: 2 asked for, 1 here"):
        make_mesh(2, 4)


@pytest.mark.parametrize("place", [(None, 2, 0), ("host:1", 2, None), ("host", 2, 0), ("host:1", 2, 2)])
def test_processes_that_cannot_join_are_refused(place):
    with pytest.raises(BadInput, match=r"^--coordinator: "):
        join(*place)
