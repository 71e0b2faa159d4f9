"""The true size of the search: many capture sets without an effect, each recorded, fitted and looked at."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from cannoise_jax.blind.judge import count
from cannoise_jax.blind.sets import draw_design, record
from cannoise_jax.discovery.report.document import plain
from cannoise_jax.recordings.recording import CaptureSet
from cannoise_jax.trials.analysis import ALPHA, fingerprint, located
from cannoise_jax.trials.lines import adding, read

_OTHER = "of another seed, size or analysis: choose a new folder"


def replicate(seed: int, number: int, size: tuple[int, int]) -> dict[str, Any]:
    """What the search says of one capture set without an effect: its p-value, and what it rejects."""
    rng = np.random.default_rng([seed, number])
    recordings = record(draw_design(rng, size=size), (), rng)
    report = located(CaptureSet("camera", tuple(recordings), None), ())
    return {
        "number": number,
        "p_value": report["battery_p_value"],
        "rejected": [f["signature"] for f in report["findings"]],
    }


def true_size(
    out: Path,
    seed: int,
    replicates: int,
    size: tuple[int, int],
    shard: tuple[int, int],
    tell: Callable[[int, int], None],
) -> dict[str, Any]:
    """Share of capture sets without an effect in which the search at `ALPHA` finds one, over all shards whose
    lines are below `out` by now. Replicates that are there already are not drawn again.

    Raises BadInput when `out` holds those of other settings or another analysis.
    """
    out.mkdir(parents=True, exist_ok=True)
    asked = {"seed": seed, "size": list(size), "code_sha256": fingerprint()}
    part, parts = shard
    path = out / f"size_{part}_of_{parts}.jsonl"
    done = {line["number"] for file in out.glob("size_*.jsonl") for line in read(file, asked, _OTHER)}
    with adding(path, asked) as add:
        mine = range(part - 1, replicates, parts)
        for n, number in enumerate(mine):
            if number not in done:
                add(plain(replicate(seed, number, size)))
            tell(n + 1, len(mine))
    lines = [line for file in sorted(out.glob("size_*.jsonl")) for line in read(file, asked, _OTHER)]
    return summary([line for line in lines if line["number"] < replicates])


def summary(lines: list[dict[str, Any]]) -> dict[str, Any]:
    """Alarms among the replicates with the Clopper-Pearson interval, which signatures gave them, and the
    Kolmogorov-Smirnov p of uniform p-values."""
    values = [line["p_value"] for line in lines if line["p_value"] is not None]
    names = [name for line in lines for name in line["rejected"]]
    return {
        "alpha": ALPHA,
        "size": count(bool(line["rejected"]) for line in lines),
        "signatures": {name: names.count(name) for name in sorted(set(names))},
        "uniform_ks_p": float(stats.kstest(values, "uniform").pvalue) if values else None,
    }
