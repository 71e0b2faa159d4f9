"""The shape of the dark noise and how pixels and rows hang together: what a Poisson-Gaussian leaves out.

Rules. Kurtosis and correlations are those of differences of successive frames, where fixed patterns cancel;
differences beyond eight robust standard deviations are left out of the clipped kurtosis. For correlations row
and column means are taken out of every difference. Intervals come from leaving out one difference at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float
from scipy import stats

from cannoise_jax.physics.robust import median, robust_std
from cannoise_jax.physics.transfer.estimate import (
    Z90,
    Estimate,
    jackknife_estimate,
    normal_estimate,
    root,
    variance_estimate,
)
from cannoise_jax.physics.transfer.fit import median_quotient
from cannoise_jax.physics.transfer.frames import FrameStatistics
from cannoise_jax.physics.transfer.quantities import Quantity
from cannoise_jax.physics.transfer.spatial import temporal_mean_square
from cannoise_jax.physics.transfer.views import left_in_lines
from cannoise_jax.recordings.metadata import chunks
from cannoise_jax.recordings.packing import site
from cannoise_jax.recordings.recording import DARK

_LAGS = ((0, 1), (0, 2), (1, 0), (1, 1))
"""Rows down and columns across: the neighbours beside, below and aslant, and the next of the same colour."""
_CLIP = 8.0
"""Robust standard deviations: a normal law has none beyond in 1e15 values, so that its kurtosis keeps
zero."""
_NOISY = (2.0, 3.0)
"""Noise over the median's, above which pixels are counted."""


def shape_quantities(dark: FrameStatistics) -> list[Quantity]:
    """Lines for the table, all channels together, from repeated darks. Needs three frames."""
    if dark.total is None or dark.recording.count < 3:
        return []
    sigma, dof = np.sqrt(dark.total), dark.recording.count - 1.0
    middle = float(median(sigma))
    spread = 1.2533 * float(sigma.std()) / np.sqrt(sigma.size)
    # The median of what few frames show of one noise lies below it.
    below = float(np.sqrt(median_quotient(dof)))
    note = (
        f"median over pixels, over the {below:.3f} that {dark.recording.count} frames of Gaussian noise show"
    )
    out = [Quantity("typical pixel noise", "DN", "all", _plain(middle, spread).scaled(1 / below), note)]
    for factor in _NOISY:
        share = float(np.mean(sigma > factor * middle))
        chance = float(stats.chi2.sf((factor * below) ** 2 * dof, dof))
        error = np.sqrt(max(share, chance) * (1 - share) / sigma.size)
        low, high = (max(share - chance + Z90 * side * error, 0.0) for side in (-1, 1))
        found = Estimate(max(share - chance, 0.0), float(error), (low, float(high))).scaled(100.0)
        note = f"s of a pixel against its median, {100 * chance:.2g} % by chance taken out"
        out.append(Quantity(f"pixels above {factor:g} x typical", "%", "all", found, note))
    out += _moments(dark)
    out += _rows(dark)
    out += _fixed_pattern(dark)
    return out


def dark_lines(statistics: Sequence[FrameStatistics]) -> list[list[str]]:
    """Cells of a table of darks over exposure: level, noise and tail, DN, all channels together."""
    lines = [["exposure s", "frames", "median", "mean", "noise", "pixels > +200", "99.9 %", "frame jumps"]]
    darks = [s for s in statistics if s.recording.kind in DARK]
    for s in sorted(darks, key=lambda s: s.recording.exposure_s or 0.0):
        level = float(median(s.mean))
        noise = "" if s.variance is None else f"{np.sqrt(median(s.variance) / median_quotient(s.dof)):.1f}"
        jumps = s.frame_means.mean(1)
        exposure = s.recording.exposure_s
        lines.append([
            "" if exposure is None else f"{exposure:g}", str(s.recording.count), f"{level:.1f}",
            f"{s.mean.mean():.1f}", noise, f"{100 * np.mean(s.mean > level + 200):.2f} %",
            f"{np.quantile(s.mean, 0.999) - level:+z.0f}", f"{np.ptp(jumps):.2f}",
        ])  # fmt: skip
    return lines if len(lines) > 2 else []


def lamp_notes(statistics: Sequence[FrameStatistics]) -> list[str]:
    """How the light of every flat that stands well above black moved: the first frame against the rest, and
    the spread of the others."""
    notes = []
    flats = [s for s in statistics if s.recording.kind == "flat" and s.recording.count >= 3 and s.relative]
    for s in sorted(flats, key=lambda s: float(s.mean.mean())):
        level = np.mean(s.frame_means - np.asarray(s.recording.black_level), axis=1)
        first, rest = level[0] / level[1:].mean() - 1, level[1:].std(ddof=1) / level[1:].mean()
        notes.append(
            f"flat at {level.mean():.0f} DN: frame 1 is {100 * first:+z.1f} % against the others, "
            f"which vary by {100 * rest:.2f} %"
        )
    return notes


def _plain(value: float, error: float) -> Estimate:
    return Estimate(value, error, (value - Z90 * error, value + Z90 * error))


def _differences(dark: FrameStatistics) -> Iterator[Float[np.ndarray, "H W"]]:
    """Differences of successive frames, each less its mean per channel."""
    previous: np.ndarray | None = None
    for part in chunks(dark.recording.frames):
        for frame in part:
            values = frame.astype(np.float64)
            if previous is not None:
                rest = values - previous
                for c in range(4):
                    site(rest, c)[...] -= site(rest, c).mean()
                yield rest
            previous = values


def _moments(dark: FrameStatistics) -> list[Quantity]:
    """Kurtosis, and correlations of pixels: what taking out the means of rows and columns does to those of
    white noise, (1 - 1/n) to a pixel with itself and -1/n to others of its line of n, is put back."""
    sums: dict[str, list[np.ndarray]] = {"excess kurtosis": [], "excess kurtosis, clipped": []}
    names = {lag: f"correlation of pixels {lag}" for lag in _LAGS}
    sums |= {name: [] for name in names.values()}
    height, width = dark.recording.size
    scale = 0.0
    for rest in _differences(dark):
        scale = scale or robust_std(rest, 0)
        inside = rest[np.abs(rest) < _CLIP * scale]
        for name, values in (("excess kurtosis", rest), ("excess kurtosis, clipped", inside)):
            sums[name].append(np.array([values.size, np.sum(values**2), np.sum(values**4)]))
        bare = rest - rest.mean(1, keepdims=True)
        bare = bare - bare.mean(0)
        power = float(np.mean(bare**2))
        for dy, dx in _LAGS:
            product = bare[: height - dy, : width - dx] * bare[dy:, dx:]
            sums[names[dy, dx]].append(np.array([1.0, power, float(product.mean())]))
    own, other = -1 / (height - 1), -1 / (width - 1)
    taken = {names[dy, dx]: -(own if dy else 1.0) * (other if dx else 1.0) for dy, dx in _LAGS}
    out = []
    for name, parts in sums.items():
        count, second, fourth = np.array(parts).T
        kurtosis = name.startswith("excess")

        def value(n: np.ndarray, s: np.ndarray, f: np.ndarray, kurtosis: bool = kurtosis) -> np.ndarray:
            return f * n / s**2 - 3 if kurtosis else f / s

        totals = [v.sum() for v in (count, second, fourth)]
        without = value(*(t - v for t, v in zip(totals, (count, second, fourth), strict=True)))
        note = f"differences of frames, within {_CLIP:g} robust sigma" if "clipped" in name else ""
        found = jackknife_estimate(float(value(*totals)), without).shifted(taken.get(name, 0.0))
        out.append(Quantity(name, "1", "all", _of_shared_frames(found), note))
    return out


def _of_shared_frames(found: Estimate) -> Estimate:
    """The error of a mean over differences of which each shares a frame with the next: squares of neighbours
    correlate by 1/4 each way (fourth powers by less), which leaving out one at a time does not see."""
    low, high = (found.value + 1.5**0.5 * (end - found.value) for end in found.ci90)
    return Estimate(found.value, 1.5**0.5 * found.stderr, (low, high))


def _rows(dark: FrameStatistics) -> list[Quantity]:
    """Temporal row means against what white noise leaves in them, and how alike the next row is: a quotient
    of what is in the frames, nothing of which is taken for row noise (see `line_noise`)."""
    means = dark.row_means.mean(-1)
    square, dof = temporal_mean_square(means)
    white = float(np.mean(dark.total)) * left_in_lines(dark, 0) if dark.total is not None else np.nan
    rest = means - means.mean(0)
    rest = rest - rest.mean(1, keepdims=True)
    power, product = np.mean(rest**2, 1), np.mean(rest[:, 1:] * rest[:, :-1], 1)
    without = (product.sum() - product) / (power.sum() - power)
    alike = jackknife_estimate(float(product.sum() / power.sum()), without)
    excess = variance_estimate(square, dof).shifted(-white).scaled(1 / white)
    return [
        Quantity("row noise over the share of white noise", "1", "all", excess),
        Quantity("correlation of next rows", "1", "all", alike),
    ]


def _fixed_pattern(dark: FrameStatistics) -> list[Quantity]:
    """The fixed pattern of the whole mosaic, channel means out, and its whole rows and columns: what the
    averages of the odd and of the even frames have in common, so that no temporal noise has to be known."""
    halves = [np.zeros(dark.mean.shape) for _ in range(2)]
    at = 0
    for part in chunks(dark.recording.frames):
        for frame in part:
            halves[at % 2] += frame
            at += 1
    for k, half in enumerate(halves):
        half /= (at + 1 - k) // 2
        for c in range(4):
            site(half, c)[...] -= site(half, c).mean()
    height, width = dark.mean.shape
    total = _common(halves[0], halves[1])
    rows, columns = (_common(halves[0].mean(a), halves[1].mean(a)) for a in (1, 0))
    parts = (
        ("fixed pattern", total),
        ("fixed pattern, whole rows", rows.shifted(-max(total.value, 0.0) / width)),
        ("fixed pattern, whole columns", columns.shifted(-max(total.value, 0.0) / height)),
    )
    # What a profile of the average frame shows, temporal row noise over the root of the frames included.
    profile = 0.5 * (halves[0] + halves[1]).mean(1)
    plain = root(variance_estimate(float(profile.var(ddof=1)), height - 1.0))
    note = "temporal row noise included"
    return [
        *(Quantity(name, "DN", "all", root(e)) for name, e in parts),
        Quantity("spread of row means of the average", "DN", "all", plain, note),
    ]


def _common(first: Float[np.ndarray, "*n"], second: Float[np.ndarray, "*n"]) -> Estimate:
    """Mean product of two independent measurements of one pattern."""
    product = (first * second).ravel()
    return normal_estimate(float(product.mean()), float(product.std() / np.sqrt(product.size)))
