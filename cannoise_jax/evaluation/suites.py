"""The paper's experiments as suites with one contract: from a bench and noise models to tables and figures.

A suite is `run(Request) -> Outcome`. Every number of a table is a `Cell`: a value with its 90 % interval over
seeds (draws, references, training) and scenes, both drawn again, and how many seeds and patches it is from.
Excess KL is that of a model minus that of new draws of the true camera on the same patches: the floor of a
perfect model, rows, offsets and all, which a histogram drawn again from itself is not.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from cannoise_jax.evaluation import kl
from cannoise_jax.evaluation.denoising import paired_interval
from cannoise_jax.evaluation.evaluators import Samples, scale, structure
from cannoise_jax.evaluation.latents import latent_maps
from cannoise_jax.evaluation.noise_models import (
    KNOWS,
    Bench,
    Draw,
    draw_key,
    estimated_draw,
    fitted_levels,
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


def encoder_suite(request: Request) -> Outcome:
    """What references tell: right ones, another setting's, another camera's; one, two, five; the latents."""
    if not request.models:
        return Outcome([], [], ["encoder: needs a trained model: --model"])
    bench, own = request.bench, [learned(request.bench, m) for m in request.models]
    truth = kl_by_unit(bench, drawn(request, "truth", [request.draws["truth"]]).noise)
    rows: dict[str, dict[str, Any]] = {}
    base = None
    for title, kind in (
        ("(A|i) same setting", "same"),
        ("(A|j) other setting", "setting"),
        ("(B|i)", "camera"),
    ):
        d = drawn(request, "model", own, kind)
        values = kl_by_unit(bench, d.noise)
        base = values if base is None else base
        rows[title] = {
            "excess KL": cell(bench, values, truth),
            "over (A|i)": cell(bench, values, base),
            "std ratio": over_seeds(bench, [scale(samples_of(bench, n))["std_ratio"] for n in d.noise]),
        }
    counts: dict[str, dict[str, Any]] = {}
    for count in sorted({1, 2, 5, request.references}):
        values = kl_by_unit(bench, drawn(request, "model", own, "same", count).noise)
        plain = kl_by_unit(
            bench, drawn(request, "pg_estimated", [request.draws["pg_estimated"]], count=count).noise
        )
        counts[str(count)] = {
            "model": cell(bench, values, truth),
            "pg_estimated": cell(bench, plain, truth),
            "model - pg_estimated": cell(bench, values, plain),
        }
    found, figures = latent_maps(bench, {"model": request.models, **request.ablations}, over_seeds)
    tables = [
        {"title": "Which references", "note": "", "columns": list(rows["(B|i)"]), "rows": rows},
        {
            "title": "How many references", "note": "Excess KL, nats.",
            "columns": ["model", "pg_estimated", "model - pg_estimated"], "rows": counts,
        },
    ]  # fmt: skip
    return Outcome(tables + found, figures, [])


def cameras_suite(request: Request) -> Outcome:
    """The five virtual cameras one by one: the model against what needs no training."""
    if not request.models:
        return Outcome([], [], ["cameras: needs a trained model: --model"])
    bench = request.bench
    plain = ("truth", "pg", "pg_estimated", "pg_recalibrated")
    made = {n: drawn(request, n, [request.draws[n]]).noise for n in plain}
    own = [learned(bench, m) for m in request.models]
    made["model"] = drawn(request, "model", own).noise
    made["model, 1 reference"] = drawn(request, "model", own, count=1).noise
    alone = drawn(request, "pg_estimated", [request.draws["pg_estimated"]], count=1).noise
    made["pg_estimated, 1 reference"] = alone
    if all(getattr(m, "level", "both") == "both" for m in request.models):
        told = tuple(np.repeat(v[:, None], 4, 1) for v in fitted_levels(bench).T)
        by_level = [learned(bench, m, given=told) for m in request.models]
        made["model, level given"] = drawn(request, "model", by_level).noise
    own_names = [n for n in made if n.startswith("model")]
    rows: dict[str, dict[str, Any]] = {}
    for c, camera in enumerate([*bench.cameras, None]):
        here = np.asarray(bench.test.camera) == c if camera else np.ones(bench.size, bool)
        values = {n: kl_by_unit(bench, noise, here) for n, noise in made.items()}
        patches = int(here.sum())
        row: dict[str, Any] = {"floor": cell(bench, values["truth"], None, patches)}
        row |= {n: cell(bench, v, values["truth"], patches) for n, v in values.items() if n != "truth"}
        for ending in ("", ", 1 reference"):
            ours, plain_one = (values[n + ending] for n in ("model", "pg_estimated"))
            row[f"model - pg_estimated{ending}"] = cell(bench, ours, plain_one, patches)
        samples = {n: [samples_of(bench, noise, here) for noise in made[n]] for n in own_names}
        for n in own_names:
            row[f"std ratio, {n}"] = over_seeds(bench, [scale(s)["std_ratio"] for s in samples[n]])
        numbers = [structure(s) for s in samples["model"]]
        for title, name in (("row spectrum", "row_spectrum"), ("kurtosis", "excess_kurtosis")):
            row[title] = over_seeds(bench, [n[name] for n in numbers])
            row[f"{title}, real"] = Cell(float(numbers[0][name + "_real"]), None, None, 1, patches)
        rows[camera.name if camera else "all"] = row
    ratio = rows["all"]["model"].value / rows["all"]["pg"].value
    note = (
        "KL over that of new draws of the true camera (floor: theirs), nats. Model over published PG's: "
        f"{ratio:.2f} (the paper's ratio: 0.16)."
    )
    return Outcome([{"title": "Cameras", "note": note, "columns": list(rows["all"]), "rows": rows}], [], [])


def iso_suite(request: Request) -> Outcome:
    """Does the level follow the setting of the references? Generated over real standard deviation by ISO,
    and of gains and read noises that no training saw."""
    bench = request.bench
    made = {n: drawn(request, n, [request.draws[n]]).noise for n in ("pg", "pg_estimated", "pg_recalibrated")}
    if request.models:
        made["model"] = drawn(request, "model", [learned(bench, m) for m in request.models]).noise
    isos = np.unique(np.asarray(bench.test.iso)).tolist()
    rows: dict[str, dict[str, Any]] = {}
    lines: dict[str, list] = {n: [] for n in made}
    for iso in isos:
        here = np.asarray(bench.test.iso) == iso
        rows[f"ISO {iso}"] = {}
        for name, noise in made.items():
            ratios = [scale(samples_of(bench, n, here))["std_ratio"] for n in noise]
            rows[f"ISO {iso}"][name] = over_seeds(bench, ratios)._replace(patches=int(here.sum()))
            lines[name].append([float(iso), float(np.mean(ratios))])
    return Outcome(
        [
            {
                "title": "Level by ISO",
                "note": "Standard deviation, model over real.",
                "columns": list(made),
                "rows": rows,
            },
            *([_beyond(request, request.beyond)] if request.beyond else []),
        ],
        [{"title": "Standard deviation over the real one", "kind": "lines", "data": lines}],
        [] if request.models else ["iso: no trained model was given: --model"],
    )


def _beyond(request: Request, bench: Bench) -> Table:
    """Levels of cameras beyond the prior, with one reference and with all."""
    there = replace(request, bench=bench)
    rows: dict[str, dict[str, Any]] = {camera.name: {} for camera in bench.cameras}
    for count in sorted({1, request.references}):
        made = {"pg_estimated": drawn(there, "pg_estimated", [estimated_draw(bench)], count=count).noise}
        if request.models:
            made["model"] = drawn(
                there, "model", [learned(bench, m) for m in request.models], count=count
            ).noise
        for name, noise in made.items():
            for c, camera in enumerate(bench.cameras):
                here = np.asarray(bench.test.camera) == c
                ratios = [scale(samples_of(bench, n, here))["std_ratio"] for n in noise]
                column = f"{name}, {count} reference{'s' * (count > 1)}"
                rows[camera.name][column] = over_seeds(bench, ratios)._replace(patches=int(here.sum()))
    note = "Standard deviation over the real one. Training has shot 1e-4 to 2.5e-2, read noise 0.25 to 10 e-."
    return {
        "title": "Cameras beyond the prior", "note": note, "columns": list(next(iter(rows.values()))),
        "rows": rows,
    }  # fmt: skip


def ablation_suite(request: Request) -> Outcome:
    """Trained models that lack one thing each, against the whole one: same patches, references and draws."""
    if not request.models or not request.ablations:
        return Outcome(
            [], [], ["ablation: needs --model and --ablation NAME=RUN[,RUN...] for each part left out"]
        )
    bench = request.bench
    truth = kl_by_unit(bench, drawn(request, "truth", [request.draws["truth"]]).noise)
    rows: dict[str, dict[str, Any]] = {}
    base = None
    for name, models in {"whole": request.models, **request.ablations}.items():
        d = drawn(request, "model", [learned(bench, m) for m in models])
        values = kl_by_unit(bench, d.noise)
        base = values if base is None else base
        rows[name] = {
            "excess KL": cell(bench, values, truth), "over the whole": cell(bench, values, base),
            "trained seeds": str(len(models)),
            "std ratio": over_seeds(bench, [scale(samples_of(bench, n))["std_ratio"] for n in d.noise]),
        }  # fmt: skip
    note = (
        "Seeds of training are paired with seeds of draws; of one trained model the interval says nothing of "
        "training."
    )
    return Outcome(
        [{"title": "Ablation", "note": note, "columns": list(rows["whole"]), "rows": rows}], [], []
    )


SUITES: dict[str, Callable[[Request], Outcome]] = {
    "noise": noise_suite,
    "ablation": ablation_suite,
    "encoder": encoder_suite,
    "cameras": cameras_suite,
    "iso": iso_suite,
}
