"""Programs to be killed at any time. Each writes again and again, or trains, in the folder it is given."""

from __future__ import annotations

import hashlib
import itertools
import resource
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np

STEPS = 24


def versions(number: int):
    """A model whose strength and maps tell which version it is."""
    from cannoise_jax import SensorModel

    camera = SensorModel.poisson_gaussian(0.5, 3.0, 64, 1023, "RGGB").with_mechanism(
        "dsnu", sigma_dn=float(number)
    )
    return camera.with_maps((4, 6 * number))


def write_sensors(folder: str) -> None:
    """Two camera models in turn, in one place."""
    from cannoise_jax.physics.core.sensor_json import write_sensor

    both = [versions(1), versions(2)]
    (Path(folder) / "ready").touch()
    for model in itertools.cycle(both):
        write_sensor(Path(folder) / "sensor.json", model)


def write_recordings(folder: str) -> None:
    """Two recordings in turn, in one place."""
    from cannoise_jax.recordings.native import write_recording
    from cannoise_jax.recordings.recording import Recording

    both = [Recording(np.full((4, 32, 48), n, np.uint16), "RGGB", (0,) * 4, 1023.0) for n in (1, 2)]
    (Path(folder) / "ready").touch()
    for recording in itertools.cycle(both):
        write_recording(Path(folder) / "r.h5", recording)


def write_reports(folder: str) -> None:
    """Reports of two versions in turn, three files each, as a diagnosis leaves them."""
    from cannoise_jax.physics.core.sensor_json import write_sensor
    from cannoise_jax.recordings.atomic import texts_in_place

    out, both = Path(folder), {n: versions(n) for n in (1, 2)}
    (out / "ready").touch()
    for number, model in itertools.cycle(both.items()):
        texts = {out / name: f"{number}\n" * 1000 for name in ("report.json", "report.html")}
        with texts_in_place(texts):
            write_sensor(out / "sensor.json", model)


def small_state():
    """A state of training with a few arrays in place of networks."""
    import jax
    import jax.numpy as jnp

    from cannoise_jax.training.state import State

    part = {"params": {"w": jnp.zeros((32, 32)), "b": jnp.zeros(7)}, "spectral": {}}
    zero = jnp.zeros((), jnp.int32)
    return State(zero, zero, jax.random.key(3), part, part, part, {}, {}, {"generator": part["params"]})


def train(folder: str) -> None:
    """The loop of training with its checkpoints, around a step that needs no compiling; it resumes what is
    there, and at its end writes the digest of the state."""
    import jax
    import jax.numpy as jnp

    from cannoise_jax.training import loop

    (Path(folder) / "ready").touch()
    config = _config()

    def step(state, batch):
        time.sleep(0.004)
        draw = jax.random.normal(jax.random.fold_in(state.key, state.step), (32, 32))
        params = {**state.generator["params"], "w": state.generator["params"]["w"] * 0.9 + draw + batch}
        new = {**state.generator, "params": params}
        return state._replace(step=state.step + 1, generator=new), {"critic/wasserstein": jnp.float32(batch)}

    class Source:
        """Numbers in an order of their own; its place is the iterator's state."""

        at = 0

        def __next__(self):
            self.at += 1
            return float(np.random.default_rng(self.at).normal())

        def get_state(self):
            return {"at": self.at}

        def set_state(self, stored):
            self.at = stored["at"]

    silent = SimpleNamespace(update=lambda n=1: None, set_postfix=lambda *a, **k: None)
    loop.init_state = lambda *a, **k: small_state()
    loop.abstract_state = lambda *a, **k: small_state()
    loop.make_train_step = lambda *a, **k: step
    loop.make_sampler = lambda config: lambda state: None
    loop._validate = lambda writer, step, *a, **k: 1 / step
    data = SimpleNamespace(
        train=[],
        batches=lambda *_: Source(),
        known=1,
        noisy_examples=lambda: np.zeros((1, 32, 32, 4)),
        validation_cameras=("A",),
        cameras=("A",),
        examples={"A": SimpleNamespace(reference=np.zeros((1, 32, 32, 4)))},
        validation=SimpleNamespace(some=lambda count: None),
    )
    outcome = loop.train(config, Path(folder) / "w", data, lambda *at: silent)
    whole = hashlib.sha256()
    for leaf in jax.tree.leaves(outcome.state._replace(key=None)._asdict()):
        whole.update(np.asarray(leaf).tobytes())
    (Path(folder) / "digest").write_text(f"{outcome.step} {whole.hexdigest()}")


def train_on_a_full_disk(folder: str, size: str) -> None:
    """As `train`, where files end at `size` bytes."""
    most = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(size), most[1]))
    try:
        train(folder)
    finally:  # what is said is written to a file, too
        resource.setrlimit(resource.RLIMIT_FSIZE, most)


def _config():
    from runpy import run_path

    path = Path(__file__).resolve().parents[2] / "configs" / "ci.py"
    config = run_path(str(path))["get_config"]()
    config.update({"steps": STEPS, "checkpoint_every": 2, "evaluate_every": 6, "log_every": 1})
    return config
