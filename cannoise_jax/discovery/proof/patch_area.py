"""The two-sample test on pairs of real and generated noise: can a small network tell which is which?"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int

from cannoise_jax.discovery.proof.patch_network import SIDE, Patches, train
from cannoise_jax.discovery.proof.twosample import area
from cannoise_jax.evaluation.evaluators import Samples
from cannoise_jax.evaluation.texture import standardised


def two_sample_area(
    samples: Samples, group: Int[np.ndarray, "n"], scene: Int[np.ndarray, "n"], seed: int = 0
) -> float | None:
    """Can a network that knows no physics tell real patches of 32 x 32 mosaic pixels from generated ones?

    Trained on every other scene and judged on the rest, either way round; areas within each group (camera and
    setting), averaged; 0.5: it cannot. None where a group has one scene only, or patches are too small.
    """
    parts = np.searchsorted(np.unique(scene), scene) % 2
    rng = np.random.default_rng(seed)
    order = rng.permutation(2)
    areas = []
    groups = [g for g in np.unique(group) if len(np.unique(parts[group == g])) == 2]
    if not groups or min(samples.real.shape[1:3]) < SIDE // 2:
        return None
    kept = np.isin(group, groups)
    for first in order:
        learn, judge = kept & (parts == first), kept & (parts != first)
        real, fake = (
            _tiles(n[learn], samples.sigma[learn], group[learn]) for n in (samples.real, samples.fake)
        )
        network = train(real, fake)
        real, fake = (
            _tiles(n[judge], samples.sigma[judge], group[judge]) for n in (samples.real, samples.fake)
        )
        told, plain = network.scores(real), network.scores(fake)
        for g in groups:
            own = real.recording == g
            areas.append(area(told[own], plain[fake.recording == g]))
    return float(np.mean(areas))


def _tiles(noise: np.ndarray, sigma: np.ndarray, group: np.ndarray) -> Patches:
    """Mosaics of packed patches, cut into squares of the network's side, in units of sigma."""
    z = standardised(noise, sigma)
    count, height, width, _ = z.shape
    mosaic = (
        z.reshape(count, height, width, 2, 2).transpose(0, 1, 3, 2, 4).reshape(count, 2 * height, 2 * width)
    )
    rows, columns = (n // SIDE for n in mosaic.shape[1:])
    cut = mosaic[:, : rows * SIDE, : columns * SIDE].reshape(count, rows, SIDE, columns, SIDE)
    values = np.clip(cut.transpose(0, 1, 3, 2, 4).reshape(-1, SIDE, SIDE), -8, 8).astype(np.float32)
    frame = np.repeat(np.arange(count), rows * columns)
    return Patches(values, frame, np.repeat(group, rows * columns))
