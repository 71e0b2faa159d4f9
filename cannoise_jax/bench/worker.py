"""One engine at one item, in a process of its own: python -m cannoise_jax.bench.worker ENGINE ITEM WEIGHTS

Says on stdout, a line of JSON each, what starting cost and then, for every number on stdin, what a call cost
when that many were made in a row. The weights go from our process to the other by a file of arrays.
"""

from __future__ import annotations

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cannoise_jax.bench.items import ITEMS, NLF, Item, batch_of, config_of, images_of

Call = Callable[[int], Any]
"""Does the work so many times, and waits for the last one."""


def ours(item: Item, place: Path) -> tuple[Call, dict[str, float]]:
    """What does the work, and the seconds that initialisation and the first call took; of a step on an
    accelerator also its operations."""
    import jax
    from flax.traverse_util import flatten_dict

    from cannoise_jax.bench.operations import operations
    from cannoise_jax.sampling import make_model, sample_noise
    from cannoise_jax.training.state import init_state, make_networks
    from cannoise_jax.training.step import make_train_step

    config = config_of(item)
    start = time.perf_counter()
    state: Any = jax.block_until_ready(init_state(config, item.batch))
    begun = time.perf_counter() - start
    parts = {name: getattr(state, name) for name in ("generator", "encoder", "critic")}
    arrays: dict[str, Any] = {n: np.asarray(v) for n, v in flatten_dict(parts, sep="/").items()}
    unfinished = place.with_suffix(".partial.npz")
    np.savez(unfinished, **arrays)
    unfinished.replace(place)  # the other engine may wait for it
    known: dict[str, float] = {}
    if item.kind == "step":
        step: Any = make_train_step(config, item.batch)
        data = jax.device_put(batch_of(item))
        if item.accelerator:  # tracing a second time costs seconds
            known["operations"] = operations(step, state, data)

        def call(times: int) -> None:
            nonlocal state
            for _ in range(times):
                state, _ = step(state, data)
            jax.block_until_ready(state)

    else:
        networks = make_networks(config)
        encoder: Any = networks.encoder
        model = make_model(
            networks.generator, dict(state.generator), encoder, dict(state.encoder), level=config.level
        )
        sample, (clean, reference), key = jax.jit(sample_noise), images_of(item), jax.random.key(0)

        def call(times: int) -> None:
            for _ in range(times):
                noise = sample(model, key, clean, reference, NLF)
            jax.block_until_ready(noise)

    return call, {"init": begun, "first": _timed(call)["s"], **known}


def peer(item: Item, place: Path) -> tuple[Call, dict[str, float]]:
    """The same in PyTorch, with the weights that ours began with."""
    import torch
    from flax.traverse_util import unflatten_dict

    if device := os.environ.get("CANNOISE_BENCH_TORCH_DEVICE"):
        torch.set_default_device(device)
    from cannoise_jax.bench import torch_networks, torch_step
    from cannoise_jax.bench.torch_layers import folded, spectral_in_order, weights

    while not place.exists():  # until ours has written them, or was given up
        if not place.parent.exists():
            sys.exit(1)
        time.sleep(0.2)
    with np.load(place, allow_pickle=False) as file:
        parts = unflatten_dict({name: file[name] for name in file.files}, sep="/")
    config = config_of(item)
    start = time.perf_counter()
    g, e, d = (weights(spectral_in_order(parts[n])) for n in ("generator", "encoder", "critic"))

    def image(x):
        return torch.tensor(np.ascontiguousarray(np.moveaxis(x, -1, 1)))

    if item.kind == "step":
        state = torch_step.trained(g, e, d, config)
        begun = time.perf_counter() - start
        data = {n: image(v) if v.ndim == 4 else torch.tensor(v) for n, v in batch_of(item).items()}

        def call(times: int) -> None:
            for _ in range(times):
                torch_step.step(state, data, config)
            if device:
                torch.cuda.synchronize()

    else:
        g, e = folded(g), folded(e)
        begun = time.perf_counter() - start
        clean, reference = images_of(item)
        level = [torch.full((item.batch, 4), v) for v in NLF]

        def call(times: int) -> None:
            for _ in range(times):
                with torch.no_grad():
                    images = image(clean)
                    latent = torch_networks.encoder(e, image(reference[None]), train=False)
                    n_init = torch_step.poisson_gaussian(images, *level)
                    told = latent.expand(item.batch, -1)
                    made = torch_networks.generator(g, images, n_init, told, train=False)
                    made.permute(0, 2, 3, 1).contiguous().cpu().numpy()

    return call, {"init": begun, "first": _timed(call)["s"]}


def _timed(call: Call, times: int = 1) -> dict[str, float]:
    wall, cpu = time.perf_counter(), time.process_time()
    call(times)
    spent = {"s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}
    return {name: value / times for name, value in spent.items()}


def _forget_peak() -> None:
    """Lets the greatest memory begin anew, where the system can."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def peak_mib(engine: str) -> float:
    """The greatest resident memory since it began anew, MiB; of an accelerator's memory where one works."""
    if engine == "torch" and os.environ.get("CANNOISE_BENCH_TORCH_DEVICE"):
        return sys.modules["torch"].cuda.max_memory_allocated() / 2**20
    if engine == "ours" and (known := sys.modules["jax"].local_devices()[0].memory_stats()):
        return known["peak_bytes_in_use"] / 2**20
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main(engine: str, name: str, place: str) -> None:
    """Starts, warms up with one more call, and then answers."""
    cores = int(os.environ.get("CANNOISE_BENCH_CORES", 0))
    if cores and hasattr(os, "sched_setaffinity"):  # before either engine is loaded and asks
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[-cores:])
    call, started = {"ours": ours, "torch": peer}[engine](ITEMS[name], Path(place))
    most = peak_mib(engine)
    call(1)
    _forget_peak()
    print(json.dumps({**started, "start_mib": most}), flush=True)
    for line in sys.stdin:
        print(json.dumps({**_timed(call, int(line)), "mib": peak_mib(engine)}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
