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


@pytest.mark.slow
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


TOGETHER = """
import sys
import jax, numpy as np
from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training import devices
from cannoise_jax.training.state import abstract_state
from cannoise_jax.training.step import make_train_step
from tests.training.shared_run import config
from tests.training.test_step import make_batch
number = int(sys.argv[2])
devices.join(sys.argv[1], 2, number)
mesh = devices.make_mesh(0, 8)
assert mesh.size == 4 and devices.is_first() == (number == 0)
try:
    devices.make_mesh(0, 6)
except BadInput as error:
    assert "config.batch_size: 6: 4 devices share a batch" in str(error)
else:
    raise AssertionError
rows = np.arange(24.0, dtype=np.float32).reshape(8, 3)
shared = devices.shared_out({"x": rows[4 * number :][:4]}, mesh)["x"]
weights = devices.copied(np.float32([1, 2, 3]) * (1 + number), mesh)  # those of the first
slope = jax.grad(lambda w, x: ((x @ w) ** 2).mean())
slope = jax.jit(slope, out_shardings=devices.everywhere(mesh))(weights, shared)
np.testing.assert_allclose(devices.own_copy(slope, mesh), 2 * rows.T @ (rows @ [1, 2, 3]) / 8)
assert devices.any_process(number == 1) and not devices.any_process(False)
state = abstract_state(config(), 2)
after, _ = jax.eval_shape(make_train_step(config(), 2, None, mesh), state, make_batch(8))
assert jax.tree.structure(after) == jax.tree.structure(state)
devices.leave()
"""


def test_processes_share_a_batch_and_what_is_to_be_done():
    """Two of two devices each, without a training: sums over the batch, the first's numbers, one's signal."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    programs = [
        subprocess.Popen(
            [sys.executable, "-c", TOGETHER, address, str(n)],
            cwd=ROOT, env={**os.environ, "XLA_FLAGS": flags}, text=True, stderr=subprocess.PIPE,
        )
        for n in range(2)
    ]  # fmt: skip
    ended = [(program.communicate(timeout=300)[1], program.returncode) for program in programs]
    assert [status for _, status in ended] == [0, 0], ended


def test_devices_that_are_not_there_are_refused():
    assert make_mesh(0, 5) is None
    with pytest.raises(BadInput, match="--devices: 2 asked for, 1 here"):
        make_mesh(2, 4)


@pytest.mark.parametrize("place", [(None, 2, 0), ("host:1", 2, None), ("host", 2, 0), ("host:1", 2, 2)])
def test_processes_that_cannot_join_are_refused(place):
    with pytest.raises(BadInput, match=r"^--coordinator: "):
        join(*place)
