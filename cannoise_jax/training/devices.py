"""One training run on several devices: parameters on all of them, each batch shared out among them.

A mesh of one axis is all there is to say; without one everything stays on the default device. Processes of
one run, on one machine or many, see each other's devices between `join` and `leave`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from cannoise_jax.recordings.recording import BadInput

_AXIS = "batch"


def join(coordinator: str | None, processes: int | None = None, process: int | None = None) -> None:
    """Joins the processes of a run; nothing of JAX may have been computed before.

    coordinator: HOST:PORT of process 0; "auto" where SLURM or Open MPI tells; None for a process alone.
    Raises BadInput where they do not come together.
    """
    if coordinator is None:
        if (processes, process) != (None, None):
            raise BadInput("--coordinator: missing beside --processes and --process")
        return
    address = None if coordinator == "auto" else coordinator
    if address and (processes is None or process is None or ":" not in address):
        raise BadInput(
            f"--coordinator: {coordinator}: give HOST:PORT with --processes and --process, or auto"
        )
    try:
        jax.distributed.initialize(address, processes, process)
    except (RuntimeError, ValueError) as error:
        raise BadInput(f"--coordinator: {coordinator}: {' '.join(str(error).split())[:200]}") from error


def leave() -> None:
    """Parts from the other processes, once all are here: what follows is for one alone, and may take long."""
    if jax.distributed.is_initialized():
        jax.distributed.shutdown()


def make_mesh(devices: int, batch_size: int) -> Mesh | None:
    """The mesh of a run, processes in their order; None for one device.

    devices: how many of every process, 0: all. Raises BadInput where there are fewer, or where they do not
    divide the batch.
    """
    by_process = [jax.local_devices(process_index=n) for n in range(jax.process_count())]
    fewest = min(map(len, by_process))
    if devices > fewest:
        raise BadInput(f"--devices: {devices} asked for, {fewest} here")
    chosen = [device for own in by_process for device in own[: devices or fewest]]
    if batch_size % len(chosen):
        raise BadInput(
            f"config.batch_size: {batch_size}: {len(chosen)} devices share a batch: use a multiple of that"
        )
    return Mesh(np.array(chosen), (_AXIS,)) if len(chosen) > 1 else None


def is_first() -> bool:
    """Whether this process writes what a run leaves behind."""
    return jax.process_index() == 0


def everywhere(mesh: Mesh) -> NamedSharding:
    """The same numbers on every device."""
    return NamedSharding(mesh, PartitionSpec())


def on_arrays(function: Callable[[jax.Array], jax.Array], tree: Any) -> Any:
    """The tree with `function` of every array, of typed keys that of their numbers."""

    def one(x: jax.Array) -> jax.Array:
        if jax.dtypes.issubdtype(x.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(function(jax.random.key_data(x)), impl=jax.random.key_impl(x))
        return function(x)

    return jax.tree.map(one, tree)


def copied(tree: Any, mesh: Mesh | None) -> Any:
    """The first process's numbers on every device."""
    if mesh is None:
        return tree

    def copy(x: jax.Array) -> jax.Array:
        alike = multihost_utils.broadcast_one_to_all(np.asarray(x))
        return jax.make_array_from_process_local_data(everywhere(mesh), np.asarray(alike))

    return on_arrays(copy, tree)


def shared_out(batch: dict[str, Any], mesh: Mesh | None) -> dict[str, Any]:
    """The batch, whose rows here are this process's own, over the devices of all processes."""
    if mesh is None:
        return batch
    rows = NamedSharding(mesh, PartitionSpec(_AXIS))
    return jax.tree.map(lambda x: jax.make_array_from_process_local_data(rows, np.asarray(x)), batch)


def own_copy(tree: Any, mesh: Mesh | None) -> Any:
    """Numbers that are the same everywhere, as arrays of one device of this process."""
    return jax.tree.map(lambda x: x.addressable_data(0), tree) if mesh else tree


def any_process(flag: bool) -> bool:
    """Whether the flag is set in any process; all must ask."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))
