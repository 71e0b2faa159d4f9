"""Checkpoints of the combined state: the newest and the best, resumed bit-exactly.

A thin layer over Orbax. What is stored is the state's pytree as it is (typed key included); it is restored
into an abstract state of the same structure, never by guessing.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp
from orbax.checkpoint import checkpoint_managers

from cannoise_jax.recordings.recording import BadInput
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
            self._manager = ocp.CheckpointManager(self.folder, options=options)
        except OSError as error:
            raise _unwritable(self.folder, error) from error

    def newest(self) -> int | None:
        """The step of the newest checkpoint, None where there is none."""
        return self._manager.latest_step()

    def best(self) -> int | None:
        """The step with the lowest validation KL among those kept; the newest where none has been scored."""
        scores = {
            step: metrics[SCORE]
            for step in self._manager.all_steps()
            if (metrics := self._manager.metrics(step)) and SCORE in metrics
        }
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
        try:
            with _without_logs():
                self._manager.save(
                    step,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardSave(state._asdict()),
                        iterator=ocp.args.JsonSave(dict(iterator)),
                    ),
                    metrics=None if score is None else {SCORE: float(score)},
                )
                self._manager.wait_until_finished()
        except (OSError, ValueError) as error:
            if not _is_disk_error(error):
                raise
            _without_late_callbacks()
            raise _unwritable(self.folder, error) from error

    def restore(self, like: State, step: int) -> tuple[State, dict[str, Any]]:
        """The state and the iterator's state of a step; `like` gives shapes and dtypes.

        Raises BadInput where the checkpoint does not fit, which a config of other sizes causes.
        """
        abstract = jax.tree.map(ocp.utils.to_shape_dtype_struct, like._asdict())
        try:
            found = self._manager.restore(
                step,
                args=ocp.args.Composite(
                    state=ocp.args.StandardRestore(abstract), iterator=ocp.args.JsonRestore()
                ),
            )
        except (ValueError, KeyError, FileNotFoundError) as error:
            reason = " ".join(str(error).split())[:200]
            raise BadInput(
                f"{self.path(step)}: cannot be restored ({reason}): use another workdir"
            ) from error
        return State(**found["state"]), found["iterator"]

    def close(self) -> None:
        """Waits for the manager's threads."""
        self._manager.close()


@contextmanager
def _without_logs() -> Iterator[None]:
    """Orbax's threads log the traceback of an error that is raised here as well."""
    logger, hook = logging.getLogger("absl"), sys.excepthook
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    sys.excepthook = lambda *_: None  # a late callback of its storage layer is printed through this one
    try:
        yield
    finally:
        logger.setLevel(level)
        sys.excepthook = hook


def _without_late_callbacks() -> None:
    """From here on the tasks of a write that failed end in silence: Python would print their tracebacks, and
    that their event loop is gone, whenever it comes upon them, around the line that says what is wrong."""
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)
    before = sys.unraisablehook

    def hook(dropped):
        if "Event loop is closed" not in str(dropped.exc_value):
            before(dropped)

    sys.unraisablehook = hook


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
