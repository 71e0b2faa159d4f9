"""What bin/bench speed times, and the numbers that both engines are given."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


class Item(NamedTuple):
    """One piece of work. kind: "step", one training step; "sample", noise for a batch of clean images. base:
    of the configs, "paper" with the paper's tables or "default". side: packed pixels. compute: as in a
    config. accelerator: too much for a few CPU cores."""

    name: str
    title: str
    kind: str
    base: str
    width: float
    batch: int
    side: int
    compute: str = "float32"
    accelerator: bool = False


_LISTED = (
    Item("step_full", "training step, paper, full width, batch 8", "step", "paper", 1.0, 8, 64),
    Item("step_quarter", "training step, paper, width 1/4, batch 16", "step", "paper", 0.25, 16, 64),
    Item("step_default", "training step, default (width 1/16, batch 16)", "step", "default", 1 / 16, 16, 32),
    Item("sample_one", "`sample_noise`, paper, 64x64, batch 1", "sample", "paper", 1.0, 1, 64),
    Item("sample_batch", "`sample_noise`, paper, 64x64, batch 16", "sample", "paper", 1.0, 16, 64),
    Item("sample_image", "`sample_noise`, default, 512x512", "sample", "default", 1 / 16, 1, 512),
    *(
        Item(f"step_{base}_{name}", f"training step, {base}, full width, batch 64, {compute}", "step", base,
             1.0, 64, 64, compute, True)
        for base in ("paper", "default") for name, compute in (("64", "float32"), ("64_bf16", "bfloat16"))
    ),
    Item("sample_image_full", "`sample_noise`, default at full width, 512x512", "sample", "default",
         1.0, 1, 512, accelerator=True),
)  # fmt: skip
ITEMS = {item.name: item for item in _LISTED}
NLF = (1e-3, 1e-6)
"""Shot and read noise of every image, normalised units."""
REFERENCE = 64


def config_of(item: Item) -> Any:
    """The training config of an item."""
    package = Path(__file__).resolve().parents[1]
    folders = (package.parent / "configs", package / "configs")
    folder = next(f for f in folders if (f / "default.py").is_file())
    config = runpy.run_path(str(folder / f"{item.base}.py"))["get_config"]()
    config.update({"width": item.width, "batch_size": item.batch, "compute": item.compute})
    if item.kind == "step":
        config.patch = item.side
    return config


def batch_of(item: Item) -> dict[str, Any]:
    """Random patches of the shapes that the config's own data have."""
    rng, count = np.random.default_rng(0), item.batch
    anchors = (count, 2) if item.base == "default" else (count,)
    sides = {"clean": item.side, "noisy": item.side, "positive": REFERENCE, "negative": REFERENCE}
    data: dict[str, Any] = {n: rng.uniform(0, 1, (count, s, s, 4)) for n, s in sides.items()}
    data["anchor"] = rng.uniform(0, 1, (*anchors, REFERENCE, REFERENCE, 4))
    data |= {"shot": np.full((count, 4), NLF[0]), "read": np.full((count, 4), NLF[1])}
    if item.base == "default":
        del data["negative"]  # of a batch's own cameras
        shares = {"row": 0.02, "slow_row": 0.02, "column": 0.01, "blend": 0.05, "tail": 0.1}
        parts = {n: np.full(count, v, np.float32) for n, v in shares.items()}
        levels = {n: data[n].astype(np.float32) for n in ("shot", "read")}
        data["shown"] = np.full(count, 2.0)
    data = {n: v.astype(np.float32) for n, v in data.items()}
    data["camera"] = np.arange(count, dtype=np.int32) // 2
    return data | ({"truth": levels | parts} if item.base == "default" else {})


def images_of(item: Item) -> tuple[np.ndarray, np.ndarray]:
    """Clean images and a noisy reference."""
    rng = np.random.default_rng(0)
    clean = rng.uniform(0.1, 0.5, (item.batch, 1, 1, 4)) + np.zeros((1, item.side, item.side, 1))
    reference = 0.3 + 0.02 * rng.normal(size=(REFERENCE, REFERENCE, 4))
    return clean.astype(np.float32), reference.astype(np.float32)
