"""How often 90 % intervals hold the truth: every estimator on recordings simulated with its mechanism.

The simulator is `SensorModel`, so that a strength means the same to both. Each simulation has its own camera
unit and its own noise. A calibrated interval holds the truth in 90 % of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from cannoise_jax.mechanisms.entry import Case, Entry
from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Recording, per_channel

GAIN, READ_E, BLACK, WHITE = 2.0, 3.0, 200.0, 16383.0
"""The plain camera that a mechanism is added to: DN/e-, e-, DN, DN."""
SIZE = (64, 96)
"""Rows and columns of its frames: chosen small, since a case is drawn hundreds of times."""
CALIBRATED = (0.85, 0.95)
"""Coverage of 90 % intervals that counts as right."""


class Row(NamedTuple):
    """Coverage of one parameter. spread: std of the estimates; stderr: their median stated error."""

    mechanism: str
    parameter: str
    truth: float
    mean: float
    spread: float
    stderr: float
    coverage: float
    simulations: int
    exact: bool

    @property
    def calibrated(self) -> bool:
        """Whether the coverage lies in 85 to 95 %; exact values: whether all are right."""
        low, high = CALIBRATED
        return self.coverage == 1.0 if self.exact else low <= self.coverage <= high


def coverage(entry: Entry, case: Case, simulations: int, seed: int = 0) -> list[Row]:
    """Coverage of the 90 % intervals of every parameter of one case of a mechanism.

    A simulation whose estimator finds nothing to measure counts as missed. Raises ValueError where the
    mechanism has no estimator.
    """
    if entry.estimator is None:
        raise ValueError(f"{entry.id}: has no estimator")
    found: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in case.truth}
    for recordings in simulate(entry, case, simulations, seed):
        outcome = entry.estimator([frame_statistics(r) for r in recordings], assumed_baseline())
        for name in case.truth:
            if isinstance(outcome, NotMeasurable):
                found[name].append((np.nan, np.nan, np.nan, np.nan))
            else:
                e = outcome[name]
                found[name].append((e.value, e.stderr, *e.ci90))
    rows = []
    for name, truth in case.truth.items():
        value, stderr, low, high = np.array(found[name]).T
        inside = (low <= truth) & (truth <= high)
        rows.append(
            Row(
                entry.id, name, truth, float(np.nanmean(value)), float(np.nanstd(value)),
                float(np.nanmedian(stderr)), float(inside.mean()), simulations, case.exact,
            )
        )  # fmt: skip
    return rows


def simulate(entry: Entry, case: Case, simulations: int, seed: int = 0) -> Iterator[list[Recording]]:
    """The recordings of every simulation of a case."""
    base = SensorModel.poisson_gaussian(GAIN, READ_E, BLACK, WHITE, "RGGB")
    truth: dict[str, Any] = dict(case.truth)
    model = base.with_mechanism(entry, **truth)
    cleans = [_texture() if s.scene else np.full(SIZE, s.level, np.float32) for s in case.shots]
    root = jax.random.fold_in(jax.random.key(seed), sum(map(ord, entry.id)))
    for key in jax.random.split(root, simulations):
        unit, *keys = jax.random.split(key, 1 + len(case.shots))
        camera = model.with_unit(unit)
        out = []
        for shot, clean, own in zip(case.shots, cleans, keys, strict=True):
            settings = Settings(exposure_s=shot.exposure_s, frames=shot.frames)
            frames = np.asarray(camera.sample(own, clean, settings))
            out.append(
                Recording(
                    frames, "RGGB", per_channel(BLACK), WHITE, camera="simulated", kind=shot.kind,
                    exposure_s=shot.exposure_s, clean=clean if shot.scene else None,
                    code_step=None if case.exact else 1.0,
                )
            )  # fmt: skip
        yield out


def assumed_baseline() -> Baseline:
    """The baseline that the simulated recordings are described with."""

    def same(value: float) -> np.ndarray:
        return np.full(4, value)

    return Baseline(
        gain=same(GAIN),
        read_noise=same(GAIN * READ_E),
        black_level=same(BLACK),
        gain_stderr=same(0.0),
        read_stderr=same(0.0),
        white_level=WHITE,
        code_step=1.0,
    )


def format_rows(rows: Sequence[Row]) -> str:
    """Plain text in fixed columns. spread: std of the estimates; stated: the median of their errors."""
    lines = [["mechanism", "parameter", "truth", "mean", "spread", "stated", "coverage", "sims", ""]]
    for r in rows:
        verdict = ("exact" if r.exact else "ok") if r.calibrated else "OUTSIDE 85-95 %"
        numbers = [f"{v:.4g}" for v in (r.truth, r.mean, r.spread, r.stderr)]
        lines.append(
            [r.mechanism, r.parameter, *numbers, f"{100 * r.coverage:.1f} %", str(r.simulations), verdict]
        )
    widths = (21, 13, 9, 10, 10, 10, 9, 5, 16)
    return "\n".join(
        "  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in lines
    )


def _texture() -> Float[np.ndarray, "H W"]:
    """A smooth scene between 0.1 and 0.5 of white with structure of some ten pixels in both directions."""
    y, x = np.mgrid[: SIZE[0], : SIZE[1]]
    waves = np.sin(y / 5.0) * np.cos(x / 7.0) + np.sin((x + 2 * y) / 11.0)
    return (0.3 + 0.1 * waves).astype(np.float32)
