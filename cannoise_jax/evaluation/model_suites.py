"""Suites that take a trained model apart: its references, its cameras and settings, its parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from cannoise_jax.evaluation.evaluators import scale, structure
from cannoise_jax.evaluation.latents import latent_maps
from cannoise_jax.evaluation.noise_models import Bench, estimated_draw, fitted_levels, learned
from cannoise_jax.evaluation.suites import (
    Cell,
    Outcome,
    Request,
    Table,
    cell,
    drawn,
    kl_by_unit,
    noise_suite,
    over_seeds,
    samples_of,
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
    """Models that lack one thing each, against the whole one: same patches, references and draws.

    The networks after the branches are left out of the trained models themselves; what else is lacking was
    lacking in training.
    """
    if not request.models:
        return Outcome([], [], ["ablation: needs a trained model: --model"])
    lacking: dict[str, Sequence[Any]] = dict(request.ablations)
    if all(m.generator_module.physics and m.generator_module.residue for m in request.models):
        lacking = {"U-Net left out": [_branches_alone(m) for m in request.models], **lacking}
    if not lacking:
        return Outcome([], [], ["ablation: needs --ablation NAME=RUN[,RUN...] for each part left out"])
    bench = request.bench
    truth = kl_by_unit(bench, drawn(request, "truth", [request.draws["truth"]]).noise)
    rows: dict[str, dict[str, Any]] = {}
    base = None
    for name, models in {"whole": request.models, **lacking}.items():
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


def _branches_alone(model):
    """A trained model without its U-Net and what follows it."""
    return model.replace(generator_module=model.generator_module.clone(residue=False))


SUITES: dict[str, Callable[[Request], Outcome]] = {
    "noise": noise_suite,
    "ablation": ablation_suite,
    "encoder": encoder_suite,
    "cameras": cameras_suite,
    "iso": iso_suite,
}
