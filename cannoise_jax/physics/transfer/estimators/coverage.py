"""How often 90 % intervals hold the truth: every estimator on recordings simulated with its mechanism.

The simulator is `SensorModel`, so that a strength means the same to both. Each simulation has its own camera
unit and its own noise. A calibrated interval holds the truth in 90 % of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from cannoise_jax.physics.core.sensor import SensorModel, Settings
from cannoise_jax.physics.transfer.baseline import Baseline
from cannoise_jax.physics.transfer.estimate import NotMeasurable
from cannoise_jax.physics.transfer.estimators import ESTIMATORS
from cannoise_jax.physics.transfer.frames import frame_statistics
from cannoise_jax.recordings.recording import Kind, Recording, per_channel

GAIN, READ_E, BLACK, WHITE = 2.0, 3.0, 200.0, 16383.0
SIZE = (64, 96)
CALIBRATED = (0.85, 0.95)


class Shot(NamedTuple):
    """One recording of a case. level: of an even light, normalised. scene: a smooth texture instead, given to
    the estimator as reference."""

    kind: Kind
    level: float = 0.0
    frames: int = 8
    exposure_s: float = 1.0
    scene: bool = False


@dataclass(frozen=True)
class Case:
    """Truth and recordings for one mechanism. exact: a value of the code lattice, without an error."""

    mechanism: str
    truth: dict[str, float]
    shots: tuple[Shot, ...]
    exact: bool = False
    note: str = field(default="")


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


_DARK = (Shot("dark"),)
_FLAT = (Shot("dark"), Shot("flat", 0.3))
_SERIES = tuple(Shot("dark", exposure_s=t) for t in (0.01, 3.0, 6.0, 10.0))
_LONG = (Shot("dark", exposure_s=0.01), Shot("dark", exposure_s=10.0))
_LADDER = (
    *(Shot("dark", exposure_s=seconds) for seconds in (0.2, 0.8)),
    *(Shot("flat", level, exposure_s=level) for level in (0.2, 0.4, 0.6, 0.8)),
)

CASES: tuple[Case, ...] = (
    Case("gain_error", {"error": 0.1}, _FLAT),
    Case("read_noise_error", {"error": 0.1}, _DARK),
    Case("prnu", {"sigma": 0.005}, _FLAT),
    Case("dsnu", {"sigma_dn": 0.5}, _DARK),
    Case("column_gain", {"sigma": 0.002}, _FLAT),
    Case("nonlinearity", {"loss": 0.03}, _LADDER),
    Case("saturation", {"full_well_e": 5000.0}, (*_FLAT, Shot("flat", 0.9))),
    Case("black_clipping", {"level_dn": -3.0}, _DARK, exact=True),
    Case("crosstalk", {"fraction": 0.03}, _FLAT),
    Case("dark_current", {"e_per_s": 2.0}, _SERIES),
    Case("amp_glow", {"e_per_s": 3.0, "length": 0.2}, _LONG),
    Case("hot_pixels", {"e_per_s": 50.0, "fraction": 0.02}, _LONG),
    Case("hot_pixels", {"e_per_s": 300.0, "fraction": 0.05}, _LONG, note="strong"),
    Case("heavy_tails", {"tukey_lambda": -0.05}, _DARK),
    Case("pixel_read_noise_map", {"spread": 0.2}, _DARK),
    Case("pixel_read_noise_map", {"spread": 0.8}, _DARK, note="strong"),
    Case("rts", {"jump_dn": 40.0, "fraction": 0.03, "rate": 0.2}, (Shot("dark", frames=16),)),
    Case("row_noise", {"sigma_dn": 1.0}, _DARK),
    Case("row_noise", {"sigma_dn": 0.1}, _DARK, note="near zero"),
    Case("column_noise", {"sigma_dn": 1.0}, _DARK),
    Case("row_fpn", {"sigma_dn": 1.0}, _DARK),
    Case("column_fpn", {"sigma_dn": 1.0}, _DARK),
    Case("pink_noise", {"sigma_dn": 2.0, "exponent": 1.0}, _DARK),
    Case("row_pink_noise", {"sigma_dn": 2.0, "exponent": 1.0}, _DARK),
    Case("banding", {"amplitude_dn": 1.0, "frequency": 0.12345}, _DARK),
    Case("offset_drift", {"sigma_dn": 0.3}, _DARK),
    Case("channel_offset", {"sigma_dn": 1.0}, _DARK),
    Case("amplifier_mismatch", {"step_dn": 1.0}, _DARK),
    Case("green_imbalance", {"sigma": 0.01}, _FLAT),
    Case("quantization", {"step_dn": 4.0}, _DARK, exact=True),
    Case("missing_codes", {"period": 8.0}, _FLAT, exact=True),
    Case("in_camera_denoising", {"weight": 0.15}, _DARK),
    Case("in_camera_denoising", {"weight": 0.45}, _DARK, note="strong"),
    # On eighths of a code rounding happens to be white: intervals that allow for other weights are too wide.
    Case("in_camera_denoising", {"weight": 0.5}, _DARK, note="eighths of a code"),
    Case("flicker", {"amplitude": 0.02, "frequency": 0.06}, _FLAT),
    Case("illumination_drift", {"sigma": 0.01}, _FLAT),
    Case(
        "reference_error",
        {"sigma_dn": 3.0, "blur": 0.05, "shift_y": 0.1, "shift_x": -0.05, "scale": 0.01},
        (Shot("scene", scene=True),),
    ),
    Case("bookkeeping", {"black_dn": 2.0}, _DARK),
    Case("bookkeeping", {"white_error": -0.05}, (Shot("dark"), Shot("flat", 1.2)), exact=True, note="white"),
)


def coverage(case: Case, simulations: int, seed: int = 0) -> list[Row]:
    """Coverage of the 90 % intervals of every parameter of one case.

    A simulation whose estimator finds nothing to measure counts as missed.
    """
    estimator = ESTIMATORS[case.mechanism]
    found: dict[str, list[tuple[float, float, float, float]]] = {name: [] for name in case.truth}
    for recordings in simulate(case, simulations, seed):
        outcome = estimator([frame_statistics(r) for r in recordings], assumed_baseline())
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
                case.mechanism, name, truth, float(np.nanmean(value)), float(np.nanstd(value)),
                float(np.nanmedian(stderr)), float(inside.mean()), simulations, case.exact,
            )
        )  # fmt: skip
    return rows


def simulate(case: Case, simulations: int, seed: int = 0) -> Iterator[list[Recording]]:
    """The recordings of every simulation of a case."""
    base = SensorModel.poisson_gaussian(GAIN, READ_E, BLACK, WHITE, "RGGB")
    truth: dict[str, Any] = dict(case.truth)
    model = base.with_mechanism(case.mechanism, **truth)
    cleans = [_texture() if s.scene else np.full(SIZE, s.level, np.float32) for s in case.shots]
    root = jax.random.fold_in(jax.random.key(seed), sum(map(ord, case.mechanism)))
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
    return Baseline(per_channel(GAIN), per_channel(GAIN * READ_E), per_channel(BLACK), WHITE, 1.0)


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
