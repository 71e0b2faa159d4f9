"""The paper's experiments as suites with one contract: from a bench and noise models to tables and figures.

A suite is `run(Request) -> Outcome`. Every number of a table is a `Cell`: a value with its 90 % interval over
seeds (draws, references, training) and scenes, both drawn again, and how many seeds and patches it is from.
Excess KL is that of a model minus that of new draws of the true camera on the same patches: the floor of a
perfect model, rows, offsets and all, which a histogram drawn again from itself is not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.evaluation import kl
from cannoise_jax.evaluation.denoising import paired_interval
from cannoise_jax.evaluation.evaluators import Samples, scale, structure
from cannoise_jax.evaluation.noise_models import (
    KNOWS,
    Bench,
    Draw,
    draw_key,
    learned,
    references_of,
)
from cannoise_jax.evaluation.panels import panels
from cannoise_jax.evaluation.texture import TEXTURE


class Cell(NamedTuple):
    """A number with its 90 % interval; without one where it is of a single seed and no scenes."""

    value: float
    low: float | None
    high: float | None
    seeds: int
    patches: int


Table = dict[str, Any]
"""title, note, columns, and rows: name -> column -> Cell or text."""


@dataclass(frozen=True)
class Request:
    """What the suites are run on. models: of each seed of training one. draws: noise models by name.

    area: (samples, group, scene, seed) -> area under the curve of a two-sample test, as
    `discovery.patch_area.two_sample_area` gives it; None: not run. also: more trained models by name, for
    the table of noise models. beyond: patches of cameras outside the prior of training.
    """

    bench: Bench
    draws: Mapping[str, Draw]
    models: Sequence[Any] = ()
    seeds: int = 3
    references: int = 8
    ablations: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    area: Callable[..., float | None] | None = None
    also: Mapping[str, Sequence[Any]] = field(default_factory=dict)
    beyond: Bench | None = None
    tell: Callable[[str], None] = lambda text: None


class Outcome(NamedTuple):
    """tables; figures: title, kind ('bars', 'points', 'lines') and data; notes: what was not run, and why."""

    tables: list[Table]
    figures: list[dict[str, Any]]
    notes: list[str]


class Drawn(NamedTuple):
    """A noise model's draws of all seeds, and the seconds of one."""

    noise: list[Float[np.ndarray, "n h w 4"]]
    seconds: float


def drawn(request: Request, name: str, draws: Sequence[Draw], kind: str = "same", count: int = 0) -> Drawn:
    """Noise by every seed; of several trained models seed s uses model s. Same seed, same draws and
    references, whatever the model."""
    request.tell(f"{name}{'' if kind == 'same' else ' ' + kind}")
    out, started = [], time.monotonic()
    for seed in range(request.seeds):
        references = references_of(request.bench, count or request.references, seed, kind)
        label = "model" if name.startswith("model") else name
        out.append(draws[seed % len(draws)](draw_key(seed, label), references))
        if not np.isfinite(out[-1]).all():
            raise FloatingPointError(f"{name}: drew values that are not finite")
    return Drawn(out, (time.monotonic() - started) / request.seeds)


def kl_by_unit(bench: Bench, noise: Sequence[np.ndarray], only: np.ndarray | None = None) -> np.ndarray:
    """Mean KL of the patches of every camera and scene, `[seeds, units]`."""
    chosen = np.arange(bench.size) if only is None else np.flatnonzero(only)
    real = kl.clipped_noise(bench.test.noisy - bench.test.clean, bench.test.clean)
    counts = {i: kl.histogram(real[i]) for i in chosen}
    unit = bench.unit[chosen]
    rows = []
    for made in noise:
        values = np.array([kl.kl_of_counts(counts[i], kl.histogram(made[i])) for i in chosen])
        rows.append([values[unit == u].mean() for u in np.unique(unit)])
    return np.array(rows)


def pooled_kl(bench: Bench, noise: np.ndarray) -> float:
    """KL of one histogram for every camera and setting, mean over them."""
    real = kl.clipped_noise(bench.test.noisy - bench.test.clean, bench.test.clean)
    groups = [bench.group == g for g in np.unique(bench.group)]
    return float(np.mean([kl.kl_divergence(real[g], noise[g]) for g in groups]))


def cell(bench: Bench, values: np.ndarray, base: np.ndarray | None = None, patches: int = 0) -> Cell:
    """Of numbers by seed and unit; of their difference from `base`, paired."""
    found = paired_interval(values, base)
    return Cell(found.value, found.low, found.high, values.shape[0], patches or bench.size)


def over_seeds(bench: Bench, values: Sequence[float]) -> Cell:
    """Of one number by seed: the interval is over seeds alone."""
    found = paired_interval(np.array(values)[:, None])
    alone = len(values) < 2
    low, high = (None, None) if alone else (found.low, found.high)
    return Cell(found.value, low, high, len(values), bench.size)


def samples_of(bench: Bench, noise: np.ndarray, only: np.ndarray | None = None) -> Samples:
    """Real and generated noise in the evaluators' terms; sigma: of the published function."""
    test = bench.test
    chosen = np.arange(bench.size) if only is None else np.flatnonzero(only)
    clean = test.clean[chosen]
    real = kl.clipped_noise(test.noisy[chosen] - clean, clean)
    shot, read = (np.asarray(v)[chosen][:, None, None, :] for v in (test.shot, test.read))
    return Samples(real, noise[chosen], clean, np.sqrt(shot * np.maximum(clean, 0) + np.maximum(read, 1e-9)))


def every_number(
    bench: Bench, made: Drawn, truth: Drawn, area: Callable[..., float | None] | None = None
) -> dict[str, Cell]:
    """The row of a noise model: divergences over their floor, level, and what histograms do not see."""
    values, floor = (kl_by_unit(bench, d.noise) for d in (made, truth))
    row = {"KL": cell(bench, values), "excess KL": cell(bench, values, floor)}
    row["pooled KL"] = over_seeds(bench, [pooled_kl(bench, n) for n in made.noise])
    numbers: dict[str, list[float]] = {}
    for seed, noise in enumerate(made.noise):
        samples = samples_of(bench, noise)
        found = scale(samples) | structure(samples)
        for evaluator in TEXTURE:
            found |= evaluator.run(samples)
        told = area and area(samples, bench.group, np.asarray(bench.test.scene), seed)
        if told is not None:
            found["area"] = told
        for name, number in found.items():
            numbers.setdefault(name, []).append(number)
    wanted = {
        "std ratio": "std_ratio", "two-sample area": "area", "row spectrum": "row_spectrum",
        "column spectrum": "column_spectrum", "lags, rms off": "lags_rms", "kurtosis": "excess_kurtosis",
    }  # fmt: skip
    for title, name in wanted.items():
        if name in numbers:
            row[title] = over_seeds(bench, numbers[name])
    row["seconds a draw"] = Cell(made.seconds, None, None, len(made.noise), bench.size)
    return row


def noise_suite(request: Request) -> Outcome:
    """Every noise model on every camera: KL, two-sample area, spectra, lags, tails."""
    bench = request.bench
    truth = drawn(request, "truth", [request.draws["truth"]])
    made = {name: drawn(request, name, [d]) for name, d in request.draws.items() if name != "truth"}
    if request.models:
        made["model"] = drawn(request, "model", [learned(bench, m) for m in request.models])
    for name, models in request.also.items():
        made[name] = drawn(request, f"model {name}", [learned(bench, m) for m in models])
    rows: dict[str, dict[str, Any]] = {}
    cameras: dict[str, dict[str, Any]] = {}
    for name, d in {**made, "truth": truth}.items():
        request.tell(f"measuring {name}")
        rows[name] = {"is told": KNOWS.get(name.split("+")[0], "")} | every_number(
            bench, d, truth, request.area
        )
        cameras[name] = {}
        for c, camera in enumerate(bench.cameras):
            own = np.asarray(bench.test.camera) == c
            values, floor = (kl_by_unit(bench, x.noise, own) for x in (d, truth))
            cameras[name][camera.name] = cell(bench, values, floor, int(own.sum()))
    real = samples_of(bench, truth.noise[0])
    numbers = structure(real) | {k: v for e in TEXTURE for k, v in e.run(real).items()}
    note = (
        f"Real noise: row spectrum {numbers['row_spectrum_real']:.2f}, column spectrum "
        f"{numbers['column_spectrum_real']:.2f}, kurtosis {numbers['excess_kurtosis_real']:.2f}. Excess KL: "
        "over new draws of the true camera. Area: 0.5 cannot be told. The model sees "
        f"{request.references} references of the setting."
    )
    names = [n.name for n in bench.cameras]
    columns = ["is told", *(k for k in rows["truth"] if k != "is told")]
    test = bench.test
    shown = {"real": kl.clipped_noise(test.noisy - test.clean, test.clean)}
    shown |= {name: made[name].noise[0] for name in made}
    bars = {name: row["excess KL"] for name, row in rows.items() if name != "truth"}
    return Outcome(
        [
            {"title": "Noise models", "note": note, "columns": columns, "rows": rows},
            {"title": "Excess KL by camera", "note": "", "columns": names, "rows": cameras},
        ],
        [{"title": "Excess KL, nats", "kind": "bars", "data": bars}, *panels(bench.test, names, shown)],
        [] if request.models else ["no trained model was given: --model names one or several (its seeds)"],
    )
