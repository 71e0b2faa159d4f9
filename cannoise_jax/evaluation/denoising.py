"""PSNR and SSIM of denoisers, and what one noise model gains over another with its paired interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from skimage.metrics import structural_similarity

_RESAMPLED = 2000


class Interval(NamedTuple):
    """A mean and its 90 % interval."""

    value: float
    low: float
    high: float


def psnr(clean: Float[np.ndarray, "h w c"], image: Float[np.ndarray, "h w c"]) -> float:
    """10 log10(1 / mean square error), dB; the range is 1, nothing is clipped. Infinite for equal images."""
    error = float(np.mean(np.square(np.asarray(image, np.float64) - clean)))
    return float(10 * np.log10(1 / error)) if error > 0 else float("inf")


def ssim(clean: Float[np.ndarray, "h w c"], image: Float[np.ndarray, "h w c"]) -> float:
    """Structural similarity in 7x7 windows, mean over the four packed channels; the range is 1."""
    return float(structural_similarity(np.asarray(clean), np.asarray(image), data_range=1.0, channel_axis=-1))


def paired_interval(
    first: Float[np.ndarray, "s n"], second: Float[np.ndarray, "s n"] | None = None, seed: int = 0
) -> Interval:
    """Mean of first - second (or of first alone) with its 90 % interval over seeds s and scenes n.

    Both were trained with the same seeds and measured on the same scenes, so only differences are resampled.
    Seeds and scenes are drawn again independently (Owen 2007), of n as n - 1 weighing n / (n - 1), which is
    without bias for the variance of a mean however few there are (Rao and Wu 1988).
    """
    values = first if second is None else first - second
    rng = np.random.default_rng(seed)
    seeds, scenes = (_weights(rng, size, _RESAMPLED) for size in values.shape)
    means = np.einsum("rs,sn,rn->r", seeds, values, scenes) / values.size
    low, high = np.quantile(means, (0.05, 0.95))
    return Interval(float(values.mean()), float(low), float(high))


def _weights(rng: np.random.Generator, size: int, count: int) -> Float[np.ndarray, "r n"]:
    """Weights of `size` items drawn again, `count` times; one alone cannot be drawn again."""
    if size == 1:
        return np.ones((count, 1))
    drawn = rng.multinomial(size - 1, np.full(size, 1 / size), size=count)
    return drawn * size / (size - 1)


def gap_closed(
    ours: Float[np.ndarray, "s n"], base: Float[np.ndarray, "s n"], best: Float[np.ndarray, "s n"]
) -> float:
    """The share of the way from `base` to `best` that `ours` goes; nan where there is no way to go."""
    way = float(best.mean() - base.mean())
    return float((ours.mean() - base.mean()) / way) if way > 0 else float("nan")


def summary(
    numbers: Mapping[str, Float[np.ndarray, "s n"]], base: str, best: str | None = None
) -> dict[str, dict[str, object]]:
    """For every noise model its mean with interval, its gain over `base`, and the share of the gap closed.

    numbers: of each noise model, by seed and scene. The keys `base` and `best` may be missing.
    """
    out: dict[str, dict[str, object]] = {}
    for name, values in numbers.items():
        row: dict[str, object] = {"mean": paired_interval(values)._asdict()}
        row["by_seed"] = [round(float(v), 4) for v in values.mean(axis=1)]
        if base in numbers and name != base:
            row[f"over_{base}"] = paired_interval(values, numbers[base])._asdict()
            # Where the way is not told from none, a share of it is a number without a meaning.
            way = numbers.get(best) if best is not None else None
            if way is not None and paired_interval(way, numbers[base]).low > 0:
                row["gap_closed"] = gap_closed(values, numbers[base], way)
        out[name] = row
    return out


def in_order(
    numbers: Mapping[str, Float[np.ndarray, "s n"]], names: Sequence[str]
) -> list[dict[str, object]]:
    """Whether each noise model of `names` is above the one before: the difference and what its interval
    says."""
    out: list[dict[str, object]] = []
    present = [name for name in names if name in numbers]
    for lower, upper in zip(present, present[1:], strict=False):
        gain = paired_interval(numbers[upper], numbers[lower])
        said = "above" if gain.low > 0 else "below" if gain.high < 0 else "not told apart"
        out.append({"lower": lower, "upper": upper, "difference": gain._asdict(), "outcome": said})
    return out
