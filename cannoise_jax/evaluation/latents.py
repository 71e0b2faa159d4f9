"""What the encoder makes of single noisy patches: maps of the latents, and how well cameras part in them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from cannoise_jax.evaluation.noise_models import Bench
from cannoise_jax.evaluation.tsne import same_among_nearest, tsne
from cannoise_jax.sampling import _latent

_NEAREST = 5


def latents(model: Any, bench: Bench) -> Float[np.ndarray, "n d"]:
    """The latent of every test patch by itself."""
    noisy = bench.test.noisy
    return np.concatenate([np.asarray(_latent(model, noisy[i : i + 1])) for i in range(len(noisy))])


def latent_maps(
    bench: Bench, models: Mapping[str, Sequence[Any]], over_seeds: Callable[[Bench, Sequence[float]], Any]
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """A table with the share of the nearest latents that are of the same camera, and a map by t-SNE of each
    model's first seed. Models without an encoder are left out."""
    rows: dict[str, dict[str, Any]] = {}
    figures = []
    camera = np.asarray(bench.test.camera)
    for name, trained in models.items():
        if any(m.encoder_module is None for m in trained):
            continue
        found = [latents(m, bench) for m in trained]
        share = [float(same_among_nearest(points, camera, _NEAREST).mean()) for points in found]
        rows[name] = {f"same camera among the {_NEAREST} nearest": over_seeds(bench, share)}
        places = tsne(found[0])
        data = {c.name: places[camera == i].tolist() for i, c in enumerate(bench.cameras)}
        figures.append({"title": f"Latents of single patches, t-SNE: {name}", "kind": "points", "data": data})
    if not rows:
        return [], []
    chance = float(np.mean([(camera == c).mean() for c in camera]))
    note = (
        f"Of single patches; by chance {chance:.2f}. An ablation without the triplet loss stands beside it."
    )
    columns = list(next(iter(rows.values())))
    return [{"title": "Latents", "note": note, "columns": columns, "rows": rows}], figures
