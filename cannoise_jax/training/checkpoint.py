"""Checkpoints of the combined state: the newest and the best, resumed bit-exactly.

A thin layer over Orbax. What is stored is the state's pytree as it is (typed key included); it is restored
into an abstract state of the same structure, never by guessing. With it goes a record of the data iterator,
the score, and the SHA-256 of every number: a checkpoint that was damaged on disk is refused, never resumed.
"""

from __future__ import annotations

import hashlib
import inspect
import json
import logging
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
from jax.sharding import Sharding, SingleDeviceSharding
from orbax.checkpoint import checkpoint_managers

from cannoise_jax.recordings.recording import BadInput
from cannoise_jax.training.devices import on_arrays
from cannoise_jax.training.state import State

SCORE = "validation_kl"


class Checkpoints:
    """The checkpoints of one workdir. Writing is synchronous: when `save` returns, the state is on disk."""

    def __init__(self, workdir: Path):
        self.folder = Path(workdir).absolute() / "checkpoints"
        best = checkpoint_managers.BestN(
            get_metric_fn=lambda metrics: metrics[SCORE],
            reverse=True,
            n=1,
            keep_checkpoints_without_metrics=False,
        )
        options = ocp.CheckpointManagerOptions(
            preservation_policy=checkpoint_managers.AnyPreservationPolicy(
                [checkpoint_managers.LatestN(1), best]
            ),
            best_fn=lambda metrics: metrics[SCORE],  # without it scores are not stored
            best_mode="min",
            enable_async_checkpointing=False,
            cleanup_tmp_directories=True,
        )
        try:
            with _without_logs():
                self._manager = ocp.CheckpointManager(self.folder, options=options)
        except OSError as error:
            raise _unwritable(self.folder, error) from error
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise _damaged(self.folder, _short(error)) from error

    def newest(self) -> int | None:
        """The step of the newest checkpoint, None where there is none."""
        return self._manager.latest_step()

    def best(self) -> int | None:
        """The step with the lowest validation KL among those kept; the newest where none has been scored.

        Raises BadInput for a checkpoint that is damaged.
        """
        records = {step: self._record(step) for step in self._manager.all_steps()}
        scores = {step: record["score"] for step, record in records.items() if record["score"] is not None}
        return min(scores, key=lambda step: (scores[step], -step)) if scores else self.newest()

    def path(self, step: int | None) -> str:
        """Where a checkpoint lies, for messages."""
        return "none" if step is None else str(self.folder / str(step))

    def save(self, state: State, iterator: Mapping[str, Any], score: float | None = None) -> None:
        """Stores the state and the data iterator's, unless this step is stored already.

        Raises BadInput when the disk is full or not writable; earlier checkpoints stay as they are.
        """
        step = int(state.step)
        if step in self._manager.all_steps():
            return
        kept = None if score is None else float(score)
        record = {"iterator": dict(iterator), "score": kept, "state_sha256": _state_sha256(state)}
        record["sha256"] = _record_sha256(record)
        try:
            with _without_logs():
                self._manager.save(
                    step,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardSave(state._asdict()),
                        iterator=ocp.args.JsonSave(record),
                    ),
                    metrics=None if kept is None else {SCORE: kept},
                )
                self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            if not _is_disk_error(error):
                raise
            _without_late_callbacks()
            raise _unwritable(self.folder, error) from error

    def restore(self, like: State, step: int, where: Sharding | None = None) -> tuple[State, dict[str, Any]]:
        """The state and the iterator's state of a step; `like` gives shapes and dtypes.

        where: the devices that shall hold it, whichever held it when it was stored; None: bound to none, as
          a first state, so that what was compiled for that serves it too.
        Raises BadInput where the checkpoint does not fit, which a config of other sizes causes, and where it
        is damaged: every number is held against its checksum before anything is returned.
        """
        placed = {"sharding": where or SingleDeviceSharding(jax.local_devices()[0])}
        abstract = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, **placed), like._asdict())
        record = self._record(step)
        try:
            with _without_logs():
                found = self._manager.restore(
                    step, args=ocp.args.Composite(state=ocp.args.StandardRestore(abstract))
                )
            state = State(**found["state"])
        except (ValueError, KeyError) as error:
            _without_late_callbacks()
            if not _is_misfit(error):
                raise _damaged(self.folder / str(step), _short(error)) from error
            raise BadInput(
                f"{self.path(step)}: cannot be restored ({_short(error)}): use another workdir"
            ) from error
        except Exception as error:  # the storage layers raise whatever damage leads them to
            _without_late_callbacks()
            raise _damaged(self.folder / str(step), _short(error)) from error
        if _state_sha256(state) != record["state_sha256"]:
            raise _damaged(self.folder / str(step), "its numbers do not match their checksum")
        if where is None:
            state = on_arrays(lambda x: jnp.array(np.asarray(x)), state)
        return state, record["iterator"]

    def _record(self, step: int) -> dict[str, Any]:
        """What goes with a step: iterator, score, checksums. Raises BadInput where it is damaged."""
        folder = self.folder / str(step)
        try:
            with _without_logs():
                found = self._manager.restore(step, args=ocp.args.Composite(iterator=ocp.args.JsonRestore()))
            record = dict(found["iterator"])
            stored = record.pop("sha256")
            if stored != _record_sha256(record):
                raise ValueError("its record does not match its checksum")
            return record
        except Exception as error:  # see above
            _without_late_callbacks()
            raise _damaged(folder, _short(error)) from error

    def close(self) -> None:
        """Waits for the manager's threads."""
        self._manager.close()


def _state_sha256(state: State) -> str:
    """SHA-256 over names, types, shapes and bytes of every array of the state."""
    whole = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_flatten_with_path(state._asdict())[0]:
        is_key = jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        values = np.asarray(jax.random.key_data(leaf) if is_key else leaf)
        whole.update(f"{jax.tree_util.keystr(path)} {leaf.dtype} {values.shape} ".encode())
        whole.update(np.ascontiguousarray(values).tobytes())
    return whole.hexdigest()


def _record_sha256(record: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()


def _short(error: BaseException) -> str:
    """The start of what an error says: the storage layers go on for pages."""
    return " ".join(str(error).split())[:120] or type(error).__name__


def _is_misfit(error: BaseException) -> bool:
    """Whether a restore failed because the shapes or names asked for are not those stored."""
    text = str(error)
    return any(sign in text for sign in ("shape", "tree structures do not match", "Dict key mismatch"))


def _damaged(folder: Path, reason: str) -> BadInput:
    return BadInput(
        f"{folder}: damaged ({reason}): remove it and run again; it goes on from the checkpoint before it, "
        "or from the start"
    )


@contextmanager
def _without_logs() -> Iterator[None]:
    """Orbax and its storage layer print the traceback of an error that is raised here as well: through logs,
    from threads, and from callbacks that come late."""
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    levels = [logger.level for logger in loggers]
    hooks = sys.excepthook, sys.unraisablehook, threading.excepthook
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    sys.excepthook, sys.unraisablehook, threading.excepthook = (lambda *_: None,) * 3
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)
        sys.excepthook, sys.unraisablehook, threading.excepthook = hooks


def _without_late_callbacks() -> None:
    """From here on tasks of a failed transfer end in silence: Python would print their tracebacks, and that
    their event loop is gone, whenever it comes upon them, around the line that says what is wrong."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    before, uncaught = sys.unraisablehook, sys.excepthook
    if getattr(before, "__name__", "") == "quiet_unraisable":
        return

    def quiet_unraisable(dropped):
        if not (inspect.iscoroutine(dropped.object) or "Event loop is closed" in str(dropped.exc_value)):
            before(dropped)

    def quiet_uncaught(kind, error, trace):  # the storage layer prints those of its own threads through it
        if "Event loop is closed" not in str(error):
            uncaught(kind, error, trace)

    sys.unraisablehook, sys.excepthook = quiet_unraisable, quiet_uncaught


def _is_disk_error(error: BaseException) -> bool:
    """Orbax reports some failed writes as ValueError with the system's message inside."""
    text = str(error).lower()
    signs = (
        "no space", "enospc", "resource_exhausted", "disk quota", "read-only", "permission denied",
        "os_error_code",
    )  # fmt: skip
    return isinstance(error, OSError) or any(sign in text for sign in signs)


def _unwritable(folder: Path, error: BaseException) -> BadInput:
    reason = " ".join(str(error).split())[:200]
    return BadInput(f"{folder}: cannot be written ({reason}): free some space and run again; it will resume")
